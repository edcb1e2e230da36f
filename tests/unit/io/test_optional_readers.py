"""HEIC, AVIF, TGA and raw files: read where their packages are, else named with the extra to install."""

import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tifffile
from PIL import ExifTags, Image, features

from rdstitch.errors import InputError
from rdstitch.inputs.find import find_images
from rdstitch.io import read_image, read_metadata


def _smooth() -> Image.Image:
    ramp = np.add.outer(np.arange(96), np.arange(128))
    return Image.fromarray(np.stack([ramp, ramp[::-1], 223 - ramp], axis=-1).astype(np.uint8))


@pytest.mark.parametrize("suffix", [".heic", ".avif", ".tga"])
def test_formats_of_phones_in_a_folder(tmp_path: Path, suffix: str) -> None:
    if suffix == ".avif" and not features.check("avif"):
        pytest.skip("this Pillow reads no AVIF")
    file = tmp_path / f"a{suffix}"
    exif = Image.Exif()
    exif[ExifTags.Base.Model] = "Phone"
    exif.get_ifd(ExifTags.IFD.Exif)[ExifTags.Base.FocalLengthIn35mmFilm] = 26
    if suffix == ".heic":
        heif = pytest.importorskip("pillow_heif")
        heif.from_pillow(_smooth()).save(file, quality=95, exif=exif.tobytes())
    else:
        given: dict[str, Any] = {"quality": 95, "exif": exif} if suffix == ".avif" else {}
        _smooth().save(file, **given)
    assert [frame.path for frame in find_images([tmp_path]).frames] == [file]
    image, metadata = read_image(file), read_metadata(file)
    assert metadata.size == (128, 96)
    if suffix != ".tga":
        assert metadata.model == "Phone"
        assert metadata.focal_px == pytest.approx(26 / np.hypot(36, 24) * np.hypot(128, 96))
    assert image.pixels.dtype == np.uint8
    assert np.abs(image.pixels.astype(float) - np.asarray(_smooth())).mean() < 4.0


def test_raw_files(tmp_path: Path) -> None:
    pytest.importorskip("rawpy")
    file = _dng(tmp_path / "a.dng")
    image, metadata = read_image(file), read_metadata(file)
    assert image.pixels.dtype == np.uint16
    assert image.pixels.shape[1::-1] == metadata.size
    assert metadata.bit_depth == 16
    assert metadata.model == "Model"
    levels = image.pixels[..., 1].astype(float).mean(axis=0)
    assert np.corrcoef(levels, np.arange(len(levels)))[0, 1] > 0.9


@pytest.mark.parametrize(("name", "package", "extra"), [("a.heic", "pillow_heif", "heif"), ("a.CR3", "rawpy", "raw")])
def test_what_is_missing_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str, package: str, extra: str
) -> None:
    monkeypatch.setitem(sys.modules, package, None)
    (tmp_path / name).write_bytes(b"image")
    for read in (read_image, read_metadata):
        with pytest.raises(InputError, match=rf"rdstitch\[{extra}\]"):
            read(tmp_path / name)


@pytest.mark.parametrize("name", ["a.heic", "a.dng"])
def test_damaged_files_are_named(tmp_path: Path, name: str) -> None:
    pytest.importorskip("pillow_heif" if name == "a.heic" else "rawpy")
    (tmp_path / name).write_bytes(b"no image at all")
    for read in (read_image, read_metadata):
        with pytest.raises(InputError, match=name):
            read(tmp_path / name)


def test_of_an_image_in_two_formats_the_usual_one_is_taken(tmp_path: Path) -> None:
    _smooth().save(tmp_path / "a.jpg")
    (tmp_path / "a.heic").write_bytes(b"the same")
    assert [frame.path.name for frame in find_images([tmp_path]).frames] == ["a.jpg"]


def _dng(file: Path) -> Path:
    """A mosaic of a grey ramp, as the simplest DNG."""
    width, height = 256, 192
    ramp = np.tile(np.linspace(200, 3800, width), (height, 1)).astype(np.uint16)
    rational = (10000, 10000, 0, 10000, 0, 10000, 0, 10000, 10000, 10000, 0, 10000, 0, 10000, 0, 10000, 10000, 10000)
    tags = [
        (271, 2, 0, "Maker", True),
        (272, 2, 0, "Model", True),
        (33421, 3, 2, (2, 2), True),
        (33422, 1, 4, b"\x00\x01\x01\x02", True),
        (50706, 1, 4, b"\x01\x04\x00\x00", True),
        (50708, 2, 0, "Maker Model", True),
        (50714, 3, 1, 0, True),
        (50717, 3, 1, 4095, True),
        (50721, 10, 9, rational, True),
        (50728, 5, 3, (1, 1, 1, 1, 1, 1), True),
        (50778, 3, 1, 21, True),
    ]
    tifffile.imwrite(file, ramp, photometric=32803, metadata=None, extratags=tags)
    return file
