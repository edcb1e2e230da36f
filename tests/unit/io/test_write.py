"""Writing images: whole or not at all, the same bytes for the same image, nothing lost."""

import errno
import itertools
import os
import re
import shutil
import subprocess
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import tifffile
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from PIL import ExifTags, Image

from rdstitch.errors import ArgumentError, LimitError, OutputError
from rdstitch.io.formats import FORMATS
from rdstitch.io.metadata import Metadata
from rdstitch.io.read import read_image
from rdstitch.io.strips import ImageSpec
from rdstitch.io.write import write_image, write_strips
from rdstitch.system.output_checks import WRITABLE_SUFFIXES

Pixels = NDArray[Any]


def _image(height: int, width: int, channels: int, dtype: type, seed: int = 0) -> Pixels:
    """Smooth colours with some texture."""
    rng = np.random.default_rng(seed)
    coarse = rng.integers(0, 256, (max(2, height // 16), max(2, width // 16), channels)).astype(np.float32)
    smooth = np.asarray(cv2.resize(coarse, (width, height))).reshape(height, width, channels)
    full = np.iinfo(dtype).max if np.issubdtype(dtype, np.integer) else 1.0
    pixels = np.clip(smooth / 255 + rng.normal(0, 0.02, smooth.shape), 0, 1) * full
    return pixels.astype(dtype) if channels > 1 else pixels[..., 0].astype(dtype)


@pytest.mark.parametrize("suffix", ["png", "tif"])
@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
@pytest.mark.parametrize("channels", [1, 3])
@pytest.mark.parametrize("transparent", [False, True])
def test_lossless_formats(tmp_path: Path, suffix: str, dtype: type, channels: int, transparent: bool) -> None:
    pixels = _image(300, 257, channels, dtype)
    alpha = np.full((300, 257), 255, np.uint8)
    alpha[:70, 30:] = 0
    write_image(tmp_path / f"a.{suffix}", pixels, alpha if transparent else None)
    back = read_image(tmp_path / f"a.{suffix}")
    same = back.pixels if back.pixels.ndim == pixels.ndim else back.pixels[..., 0]
    np.testing.assert_array_equal(same, pixels)
    if transparent:
        np.testing.assert_array_equal(back.alpha, alpha)
    else:
        assert back.alpha is None


@pytest.mark.parametrize("channels", [1, 3])
def test_jpeg_from_strips_is_what_one_piece_gives(tmp_path: Path, channels: int) -> None:
    pixels = _image(256 * 9 + 37, 333, channels, np.uint8)
    write_image(tmp_path / "a.jpg", pixels)
    bgr = np.ascontiguousarray(pixels[..., ::-1]) if channels == 3 else pixels
    done, data = cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, 95])
    assert done
    whole = cv2.imdecode(data, cv2.IMREAD_UNCHANGED)
    joined = cv2.imread(str(tmp_path / "a.jpg"), cv2.IMREAD_UNCHANGED)
    np.testing.assert_array_equal(joined, whole)
    with Image.open(tmp_path / "a.jpg") as image:
        assert image.size == (333, 256 * 9 + 37)
        image.load()


@pytest.mark.parametrize("suffix", ["jpg", "png", "tif"])
@settings(max_examples=8, deadline=None)
@given(data=st.data())
def test_strips_do_not_matter(tmp_path_factory: pytest.TempPathFactory, suffix: str, data: st.DataObject) -> None:
    folder = tmp_path_factory.mktemp("strips")
    height, width = data.draw(st.integers(1, 1400)), data.draw(st.integers(1, 300))
    pixels = _image(height, width, 3, np.uint8)
    alpha = np.where(pixels[..., 0] > 60, 255, 0).astype(np.uint8)
    write_image(folder / f"whole.{suffix}", pixels, alpha)
    metadata, workers = Metadata((width, height)), data.draw(st.integers(1, 3))
    layout = ImageSpec((width, height), 3, np.dtype(np.uint8), transparent=True, metadata=metadata)
    starts = [0]
    while starts[-1] < height:
        starts.append(starts[-1] + 256 * data.draw(st.integers(1, 3)))
    strips = [(pixels[a:b], alpha[a:b]) for a, b in itertools.pairwise(starts)]
    write_strips(folder / f"strips.{suffix}", layout, strips, workers=workers)
    if suffix == "png":  # the compressor may cut its output elsewhere; the pixels may not differ
        np.testing.assert_array_equal(read_image(folder / "whole.png").pixels, read_image(folder / "strips.png").pixels)
    else:
        a, b = (read_image(folder / f"{name}.{suffix}") for name in ("whole", "strips"))
        np.testing.assert_array_equal(a.pixels, b.pixels)


@pytest.mark.parametrize("opaque", [False, True])
@pytest.mark.parametrize("suffix", ["jpg", "png", "tif", "ome.tif", "webp"])
def test_same_bytes_every_time(tmp_path: Path, suffix: str, opaque: bool) -> None:
    pixels, written = _image(600, 700, 3, np.uint8), set()
    alpha = np.full(pixels.shape[:2], 255, np.uint8)
    alpha[:90], alpha[:, 640:] = 0, 0
    for write in range(8):
        write_image(tmp_path / f"a.{suffix}", pixels, None if opaque else alpha)
        written.add((tmp_path / f"a.{suffix}").read_bytes())
        # Whatever the compressor finds in memory must not matter.
        np.random.default_rng(write).bytes(300_000 + 10_000 * write)
    assert len(written) == 1


@pytest.mark.parametrize("channels", [1, 3])
def test_same_bytes_by_any_number_of_threads(tmp_path: Path, channels: int) -> None:
    height, width = 700, 1100
    pixels, alpha = (
        _image(height, width, channels, np.uint8).reshape(height, width, channels),
        np.full((height, width), 255, np.uint8),
    )
    alpha[:300, 200:] = 0
    spec = ImageSpec((width, height), channels, pixels.dtype, transparent=True, metadata=Metadata((width, height)))
    written = []
    for workers in (1, 3):
        file = tmp_path / f"{workers}.tif"
        strips = ((pixels[top : top + 256], alpha[top : top + 256]) for top in range(0, height, 256))
        write_strips(file, spec, strips, workers=workers)
        written.append(file.read_bytes())
    assert written[0] == written[1]


def test_other_images_have_another_identity(tmp_path: Path) -> None:
    identities = set()
    for grey in (0, 1):
        write_image(tmp_path / "a.ome.tif", np.full((30, 40), grey, np.uint8))
        with tifffile.TiffFile(tmp_path / "a.ome.tif") as tiff:
            identities |= set(re.findall('UUID="([^"]+)"', str(tiff.ome_metadata)))
    assert len(identities) == 2


@pytest.mark.parametrize("suffix", ["jpg", "png", "tif", "ome.tif", "webp"])
def test_profile_and_exif_are_kept(tmp_path: Path, suffix: str) -> None:
    exif = Image.Exif()
    exif[0x010F], exif[0x0110] = "Maker", "Model"
    profile = bytes(range(256)) * 400
    metadata = Metadata((64, 64), dpi=(150.0, 150.0), exif=exif.tobytes(), icc_profile=profile)
    write_image(tmp_path / f"a.{suffix}", _image(64, 64, 3, np.uint8), None, metadata)
    back = read_image(tmp_path / f"a.{suffix}").metadata
    assert back.icc_profile == profile
    assert (back.make, back.model) == ("Maker", "Model")
    if suffix not in ("webp", "ome.tif"):
        assert back.dpi == pytest.approx((150, 150), abs=0.02)


def _photo() -> bytes:
    exif = Image.Exif()
    exif[ExifTags.Base.Model], exif[ExifTags.Base.DateTime] = "Model", "2020:01:02 03:04:05"
    tag = ExifTags.Base
    exif.get_ifd(ExifTags.IFD.Exif).update({tag.ExposureTime: 0.004, tag.FNumber: 2.8, tag.ISOSpeedRatings: 100})
    exif.get_ifd(ExifTags.IFD.Exif).update({tag.DateTimeOriginal: "2020:01:02 03:04:05", tag.FocalLengthIn35mmFilm: 36})
    exif.get_ifd(ExifTags.IFD.Exif)[ExifTags.IFD.Interop] = {1: "R03"}
    exif.get_ifd(ExifTags.IFD.GPSInfo).update({1: "N", 2: (41.0, 25.0, 43.5), 3: "W", 4: (81.0, 36.0, 21.25), 6: 250.5})
    return exif.tobytes()


@pytest.mark.filterwarnings("ignore:Dataset has no geotransform")
@pytest.mark.parametrize(("large", "shape"), [(False, (400, 600, 3)), (True, (400, 600, 3)), (False, (40, 60))])
def test_tiff_says_what_jpeg_says_of_camera_time_and_place(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, large: bool, shape: tuple[int, ...]
) -> None:
    if large:
        monkeypatch.setattr("rdstitch.io.tiff._BIGTIFF_FROM", 0)
    pixels = np.random.default_rng(0).integers(0, 255, shape, np.uint8)
    for name in ("a.tif", "a.jpg"):
        write_image(tmp_path / name, pixels, metadata=Metadata((shape[1], shape[0]), exif=_photo()))
    tiff, jpeg = (read_image(tmp_path / name).metadata for name in ("a.tif", "a.jpg"))
    assert tiff.gps is not None
    for field in ("focal_px", "gps", "timestamp", "exposure", "model"):
        assert getattr(tiff, field) == getattr(jpeg, field) is not None, field
    with Image.open(tmp_path / "a.tif") as by_pillow, Image.open(tmp_path / "a.jpg") as photo:
        blocks = [
            [dict(image.getexif().get_ifd(block)) for block in (ExifTags.IFD.GPSInfo, ExifTags.IFD.Interop)]
            for image in (by_pillow, photo)
        ]
        assert blocks[0] == blocks[1]
        np.testing.assert_array_equal(np.asarray(by_pillow), pixels)
    with tifffile.TiffFile(tmp_path / "a.tif") as by_tifffile:
        tags = by_tifffile.pages.first.tags
        assert [tag.code for tag in tags] == sorted(tag.code for tag in tags)
        assert tags["ExifTag"].value["FocalLengthIn35mmFilm"] == 36
        assert tags["DateTime"].value == tags["ExifTag"].value["DateTimeOriginal"] == "2020:01:02 03:04:05"
        assert tags["GPSTag"].value["GPSLatitudeRef"] == "N"
    by_opencv = cv2.imread(str(tmp_path / "a.tif"), cv2.IMREAD_UNCHANGED)
    np.testing.assert_array_equal(by_opencv[..., ::-1] if len(shape) == 3 else by_opencv, pixels)
    with pytest.importorskip("rasterio").open(tmp_path / "a.tif") as by_gdal:
        np.testing.assert_array_equal(np.moveaxis(by_gdal.read(), 0, -1).reshape(shape), pixels)
        # GDAL reads EXIF of no BigTIFF.
        assert large or by_gdal.tags(ns="EXIF")["EXIF_DateTimeOriginal"] == "2020:01:02 03:04:05"
    assert [path.name for path in sorted(tmp_path.iterdir())] == ["a.jpg", "a.tif"]


def test_tiff_has_overviews_of_half_the_size(tmp_path: Path) -> None:
    pixels = _image(1301, 1003, 3, np.uint8)
    alpha = np.full(pixels.shape[:2], 255, np.uint8)
    alpha[:200] = 0
    write_image(tmp_path / "a.tif", pixels, alpha)
    with tifffile.TiffFile(tmp_path / "a.tif") as tiff:
        shapes = [page.shape for page in tiff.pages]
        assert shapes == [(1301, 1003, 4), (651, 502, 4), (326, 251, 4), (163, 126, 4)]
        assert [level.shape for level in tiff.series[0].levels] == shapes
        half = tiff.pages[1].asarray()
    expected = pixels[200:1300, :1002].astype(float).reshape(550, 2, 501, 2, 3).mean(axis=(1, 3))
    np.testing.assert_allclose(half[100:650, :501, :3], expected, atol=0.51)
    assert (half[:100, :, 3] == 0).all()


def test_every_format_has_its_limits() -> None:
    assert tuple(FORMATS) == WRITABLE_SUFFIXES


def test_floats_need_tiff(tmp_path: Path) -> None:
    pixels = _image(40, 50, 3, np.float32)
    write_image(tmp_path / "a.tif", pixels)
    np.testing.assert_array_equal(read_image(tmp_path / "a.tif").pixels, pixels)
    with pytest.raises(OutputError, match=r"\.tif"):
        write_image(tmp_path / "a.png", pixels)
    assert not (tmp_path / "a.png").exists()


def test_background_of_jpeg(tmp_path: Path) -> None:
    pixels = np.full((64, 64, 3), 128, np.uint8)
    alpha = np.full((64, 64), 255, np.uint8)
    alpha[:, 32:] = 0
    for grey in (0, 255):
        write_image(tmp_path / "a.jpg", pixels, alpha, background=grey)
        back = read_image(tmp_path / "a.jpg").pixels
        assert abs(int(back[32, 60, 0]) - grey) < 4
        assert abs(int(back[32, 4, 0]) - 128) < 4
    write_image(tmp_path / "a.jpg", np.zeros((4, 1), np.uint8), np.zeros((4, 1), np.uint8), background=200)
    assert (abs(read_image(tmp_path / "a.jpg").pixels.astype(int) - 200) < 4).all()


def test_too_large_for_the_format(tmp_path: Path) -> None:
    with pytest.raises(LimitError, match=r"write a \.tif"):
        write_image(tmp_path / "a.jpg", np.zeros((1, 70_000), np.uint8))
    with pytest.raises(LimitError):
        write_image(tmp_path / "a.webp", np.zeros((17_000, 2), np.uint8))
    assert list(tmp_path.iterdir()) == []


def test_wrong_arguments(tmp_path: Path) -> None:
    with pytest.raises(ArgumentError):
        write_image(tmp_path / "a.png", np.zeros((4, 4), np.int32))
    with pytest.raises(ArgumentError):
        write_image(tmp_path / "a.png", np.zeros((4, 4), np.uint8), np.zeros((4, 5), np.uint8))
    with pytest.raises(OutputError):
        write_image(tmp_path / "a.xyz", np.zeros((4, 4), np.uint8))
    layout = ImageSpec((4, 10), 1, np.dtype(np.uint8), metadata=Metadata((4, 10)))
    with pytest.raises(ArgumentError, match="rows"):
        write_strips(tmp_path / "a.png", layout, [(np.zeros((9, 4, 1), np.uint8), None)])
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.float32])
def test_grey_with_alpha_is_shown_by_other_readers(tmp_path: Path, dtype: type[np.number[Any]]) -> None:
    full = np.iinfo(dtype).max if issubclass(dtype, np.integer) else 1.0
    pixels = (np.add.outer(np.arange(500), np.arange(700)) % 256 * (full / 255)).astype(dtype)
    alpha = np.full(pixels.shape, 255, np.uint8)
    alpha[:90] = 0
    file = tmp_path / "grey.tif"
    write_image(file, pixels, alpha)
    seen = cv2.imread(str(file), cv2.IMREAD_GRAYSCALE | cv2.IMREAD_ANYDEPTH)
    assert seen.dtype == dtype
    np.testing.assert_array_equal(seen, pixels)  # tiles of grey and alpha would be read as stripes
    with Image.open(file) as image:
        assert image.mode == {np.uint8: "L", np.uint16: "I;16", np.float32: "F"}[dtype]
        np.testing.assert_array_equal(np.asarray(image), pixels)
    with tifffile.TiffFile(file) as tiff:
        np.testing.assert_array_equal(tiff.asarray(), pixels)
        np.testing.assert_array_equal(tiff.pages[1].asarray() * np.uint8(255), alpha)
        assert len(tiff.series[0].levels) > 1
    ours = read_image(file)
    np.testing.assert_array_equal(ours.pixels, pixels)
    np.testing.assert_array_equal(ours.alpha, alpha)
    if shutil.which("gdalinfo"):
        told = subprocess.run(["gdalinfo", "-stats", file], capture_output=True, text=True, check=True)
        assert told.stderr == ""


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.float32])
@pytest.mark.filterwarnings("ignore:Dataset has no geotransform")
def test_gdal_sees_where_there_is_an_image_at_every_size(tmp_path: Path, dtype: type[np.number[Any]]) -> None:
    rasterio = pytest.importorskip("rasterio")
    pixels, alpha = np.full((600, 1100), 1, dtype), np.zeros((600, 1100), np.uint8)
    alpha[100:500, 200:] = 255
    write_image(tmp_path / "grey.tif", pixels, alpha)
    with rasterio.open(tmp_path / "grey.tif") as seen:
        np.testing.assert_array_equal(seen.read(1), pixels)
        np.testing.assert_array_equal(seen.dataset_mask(), alpha)
        assert seen.overviews(1) == [2, 4, 8]
        small = seen.dataset_mask(out_shape=(150, 275))
        np.testing.assert_array_equal(small, alpha[2::4, 2::4])


@pytest.mark.filterwarnings("ignore:Dataset has no geotransform")
@pytest.mark.parametrize("large", [False, True])
@pytest.mark.parametrize("channels", [1, 3])
def test_tiff_is_cloud_optimized(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, channels: int, large: bool) -> None:
    """Directories from the image to the smallest overview, then tiles from the smallest overview to the image."""
    if large:
        monkeypatch.setattr("rdstitch.io.tiff._BIGTIFF_FROM", 0)
    pixels = np.random.default_rng(0).integers(0, 255, (700, 1100, channels), np.uint8)
    alpha = np.full(pixels.shape[:2], 255, np.uint8)
    alpha[:130] = 0
    exif = Image.Exif()
    exif[ExifTags.Base.Make], exif[ExifTags.Base.Model] = "Maker of camera\0\0\0", "Camera 1\0"  # as cameras pad them
    write_image(tmp_path / "a.tif", pixels, alpha, Metadata((1100, 700), exif=exif.tobytes(), dpi=(300.0, 300.0)))
    with tifffile.TiffFile(tmp_path / "a.tif") as tiff:
        pages = list(tiff.pages)
        assert tiff.is_bigtiff == large
        assert pages[0].offset == (16 if large else 8)
        assert len(pages) == (8 if channels == 1 else 4)
        at = [page.offset for page in pages]
        assert at == sorted(at)
        first = [min(page.dataoffsets) for page in pages]
        assert first == sorted(first, reverse=True)
        assert at[-1] < first[-1]
        assert all(offset % 2 == 0 for page in pages for offset in (page.offset, *page.dataoffsets))
        tags = tiff.pages.first.tags
        assert tags["Make"].count == len("Maker of camera\0")
        assert [tags[name].value for name in ("Make", "Model")] == ["Maker of camera", "Camera 1"]
        assert b"Maker of camera\0\0" not in (tmp_path / "a.tif").read_bytes()
        assert tags["XResolution"].value == (300, 1)
        np.testing.assert_array_equal(
            tiff.asarray()[..., :channels] if channels > 1 else tiff.asarray(), pixels.squeeze()
        )
        for page in pages[1:]:
            assert page.asarray().any()
    back = read_image(tmp_path / "a.tif")
    np.testing.assert_array_equal(back.alpha, alpha)
    assert [path.name for path in tmp_path.iterdir()] == ["a.tif"]
    cogeo = pytest.importorskip("rio_cogeo.cogeo")
    assert cogeo.cog_validate(tmp_path / "a.tif", quiet=True) == (True, [], [])


@pytest.mark.parametrize("dpi", [(4294967295 * 2.54,) * 2, (-72.0, -72.0), (1e-12, 72.0)])
@pytest.mark.parametrize("suffix", ["jpg", "png", "tif"])
def test_an_impossible_resolution_costs_no_image(tmp_path: Path, suffix: str, dpi: tuple[float, float]) -> None:
    pixels = _image(30, 40, 3, np.uint8)
    write_image(tmp_path / f"a.{suffix}", pixels, metadata=Metadata((40, 30), dpi=dpi))
    assert read_image(tmp_path / f"a.{suffix}").pixels.shape == pixels.shape


def test_a_disk_that_is_full_when_a_tiff_is_ordered_costs_the_order_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pixels = _image(700, 600, 3, np.uint8)
    spec = ImageSpec((600, 700), 3, np.dtype(np.uint8), transparent=False, metadata=Metadata((600, 700)))

    def full(*_: object) -> bytes:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    with monkeypatch.context() as patch:
        patch.setattr("rdstitch.io.tiff_order._directory", full)
        _, (message,) = write_strips(tmp_path / "a.tif", spec, [(pixels, None)])
    assert "No space left on device" in message.text
    assert [path.name for path in tmp_path.iterdir()] == ["a.tif"]
    np.testing.assert_array_equal(read_image(tmp_path / "a.tif").pixels, pixels)
    assert write_strips(tmp_path / "b.tif", spec, [(pixels, None)])[1] == []
