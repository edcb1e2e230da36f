"""Headers of image files."""

import struct
import zlib
from pathlib import Path

import numpy as np
import pytest
from PIL import Image, PngImagePlugin

from rdstitch.io.metadata import read_metadata


def _png(file: Path, late: bytes | None = None, exif: Image.Exif | None = None) -> Path:
    """A PNG; with EXIF of another writer behind its pixels, where that is given."""
    Image.fromarray(np.random.default_rng(0).integers(0, 255, (40, 60, 3), dtype=np.uint8)).save(
        file, exif=exif or Image.Exif()
    )
    if late is not None:
        chunk = b"eXIf" + late
        end = struct.pack(">I", len(late)) + chunk + struct.pack(">I", zlib.crc32(chunk))
        content = file.read_bytes()
        file.write_bytes(content[:-12] + end + content[-12:])
    return file


def _exif() -> Image.Exif:
    exif = Image.Exif()
    exif[0x010F], exif[0x0112] = "Maker", 6
    return exif


def test_the_pixels_of_a_png_are_not_decoded_for_its_header(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    plain, early = _png(tmp_path / "plain.png"), _png(tmp_path / "early.png", exif=_exif())
    monkeypatch.setattr(PngImagePlugin.PngImageFile, "load", lambda _: pytest.fail("decoded"))
    assert read_metadata(plain).size == (60, 40)
    assert read_metadata(plain).exif == b""
    assert (read_metadata(early).make, read_metadata(early).size) == ("Maker", (40, 60))


def test_exif_behind_the_pixels_of_a_png_is_found(tmp_path: Path) -> None:
    found = read_metadata(_png(tmp_path / "late.png", late=_exif().tobytes()[6:]))
    assert (found.make, found.orientation, found.size) == ("Maker", 6, (40, 60))


def test_a_png_that_ends_early_is_no_image_without_metadata(tmp_path: Path) -> None:
    file = _png(tmp_path / "cut.png")
    file.write_bytes(file.read_bytes()[:-40])
    with pytest.raises(Exception, match="cut"):
        read_metadata(file)
