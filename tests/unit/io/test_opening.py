"""Opening files: of which kind they are, by which reader, and what decoders leave behind."""

import logging
import os
import struct
import sys
import tracemalloc
import warnings
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import cv2
import imagecodecs
import numpy as np
import pytest
import tifffile
from numpy.typing import NDArray
from PIL import ExifTags, Image, features
from PIL.PngImagePlugin import PngInfo

from rdstitch.errors import InputError
from rdstitch.geometry.exif_orientation import turned
from rdstitch.inputs.find import find_images
from rdstitch.inputs.frame import Frame, as_inputs
from rdstitch.io import read as reading
from rdstitch.io.deepzoom import MAX_TILE_PROFILE
from rdstitch.io.metadata import MAX_PROFILE, read_metadata
from rdstitch.io.opening import MAX_IMAGE_GB
from rdstitch.io.read import read_image
from rdstitch.io.write import write_image
from rdstitch.system.file_access import open_regular, read_beginning, read_limited, read_text

_RGB = np.random.default_rng(0).integers(0, 256, (40, 60, 3), dtype=np.uint8)


@pytest.mark.parametrize("function", [read_image, read_metadata])
@pytest.mark.parametrize(
    "content",
    [
        b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 100 100\n%%EndComments\nshowpage\n",
        b"\x01\xda\x01\x01\x00\x03" + bytes(600),  # SGI
        b"\x0a\x05\x01\x08" + bytes(200),  # PCX
        b"<svg xmlns='http://www.w3.org/2000/svg'/>",
        b"RIFF\x24\0\0\0WAVEfmt ",
    ],
)
def test_other_formats(tmp_path: Path, content: bytes, function: object, monkeypatch: pytest.MonkeyPatch) -> None:
    def started(*arguments: object, **options: object) -> None:
        raise AssertionError("a program was started")

    monkeypatch.setattr("subprocess.Popen", started)
    (tmp_path / "a.jpg").write_bytes(content)
    with pytest.raises(InputError, match=r"a\.jpg: not an image"):
        function(tmp_path / "a.jpg")  # type: ignore[operator]


def test_xmp_beyond_its_limit_is_not_searched(tmp_path: Path) -> None:
    for padding, found in ((1000, 500.0), (2**20, None)):
        info = PngInfo()
        info.add_itxt("XML:com.adobe.xmp", " " * padding + "<a drone-dji:CalibratedFocalLength='500'/>")
        Image.new("L", (400, 300)).save(tmp_path / "a.png", pnginfo=info)
        assert read_metadata(tmp_path / "a.png").focal_px == found


def _exif(kind: int, count: int, value: bytes) -> bytes:
    """EXIF with the orientation as a value of any type."""
    rest = value[4:] and value
    entry = struct.pack("<HHI", 0x0112, kind, count) + (struct.pack("<I", 26) if rest else value.ljust(4, b"\0"))
    return b"Exif\0\0II*\0\x08\0\0\0\x01\0" + entry + bytes(4) + rest


@pytest.mark.parametrize("suffix", ["jpg", "png", "webp"])
@pytest.mark.parametrize(
    ("exif", "orientation"),
    [
        (_exif(3, 1, struct.pack("<H", 6)), 6),
        (_exif(2, 2, b"6\0"), 6),
        (_exif(11, 1, struct.pack("<f", 6.0)), 6),
        (_exif(12, 1, struct.pack("<d", 6.0)), 6),
        (_exif(5, 1, struct.pack("<II", 6, 1)), 6),
        (_exif(2, 4, b"top\0"), 1),
        (_exif(11, 1, struct.pack("<f", float("nan"))), 1),
        (_exif(11, 1, struct.pack("<f", 6.5)), 1),
        (_exif(3, 1, struct.pack("<H", 77)), 1),
    ],
)
def test_orientation_of_any_type(tmp_path: Path, suffix: str, exif: bytes, orientation: int) -> None:
    Image.fromarray(_RGB).save(tmp_path / f"a.{suffix}", exif=exif)
    image = read_image(tmp_path / f"a.{suffix}")
    assert image.metadata.orientation == orientation
    assert image.pixels.shape[:2] == ((60, 40) if orientation == 6 else (40, 60))
    Image.Exif().load(image.metadata.exif)


def _profile(size: int, space: bytes = b"RGB ") -> bytes:
    return (bytes(16) + space).ljust(size, b"x")


def test_large_profiles_are_left_out(tmp_path: Path) -> None:
    for size, kept in ((3000, True), (MAX_PROFILE, True), (8_000_000, False)):
        Image.fromarray(_RGB).save(tmp_path / "in.jpg", icc_profile=_profile(size))
        metadata = read_metadata(tmp_path / "in.jpg")
        assert (len(metadata.icc_profile) == size, metadata.profile_lost == "") == (kept, kept)
        for name in ("a.png", "a.jpg", "a.tif", "a.dzi"):
            write_image(tmp_path / name, _RGB, metadata=metadata)
        for name in ("a.png", "a.jpg", "a.tif"):
            assert read_metadata(tmp_path / name).icc_profile == metadata.icc_profile
        in_tiles = {read_metadata(tile).icc_profile for tile in (tmp_path / "a_files").rglob("*.jpg")}
        assert in_tiles == {metadata.icc_profile if size <= MAX_TILE_PROFILE else b""}
    Image.fromarray(_RGB).convert("CMYK").save(tmp_path / "ink.jpg", icc_profile=_profile(3000, b"CMYK"))
    assert "inks" in read_metadata(tmp_path / "ink.jpg").profile_lost


def test_only_regular_files_are_opened(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    for path in (tmp_path / "pipe", Path("/dev/zero"), tmp_path):
        with pytest.raises(OSError, match=r"is not a regular file|is a folder"):
            open_regular(path)
        with pytest.raises(InputError, match=r"is not a regular file|is a folder"):
            read_text(path)
    (tmp_path / "file").write_bytes(b"abc")
    assert read_limited(tmp_path / "file", 3) == b"abc"
    with pytest.raises(OSError, match="too large"):
        read_limited(tmp_path / "file", 2)


def test_a_file_is_read_whole_and_takes_no_more_memory_than_it_has_bytes(tmp_path: Path) -> None:
    (tmp_path / "file").write_bytes(b"abc")
    tracemalloc.start()
    assert read_limited(tmp_path / "file", 2**31) == b"abc"
    assert tracemalloc.get_traced_memory()[1] < 2**23
    tracemalloc.stop()
    content = bytes(range(256)) * 2**15  # several blocks
    (tmp_path / "file").write_bytes(content)
    assert read_limited(tmp_path / "file", len(content)) == content
    with pytest.raises(OSError, match="too large"):
        read_limited(tmp_path / "file", len(content) - 1)


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


def _write_deep(file: Path, samples: NDArray[np.uint16]) -> None:
    """Samples of the bits that a file of this name holds, without loss where it can do that."""
    if file.suffix == ".heic":
        heif = pytest.importorskip("pillow_heif")
        mode = "RGBA;16" if samples.shape[2] == 4 else "RGB;16"
        heif.from_bytes(mode, samples.shape[1::-1], samples.tobytes()).save(file, quality=100, chroma=444)
    elif file.suffix == ".ppm":
        assert cv2.imwrite(str(file), samples[..., ::-1])
    elif file.suffix == ".avif":
        file.write_bytes(imagecodecs.avif_encode(samples >> 6, level=100, bitspersample=10))
    else:
        file.write_bytes(imagecodecs.jpeg2k_encode(samples, level=0, codecformat=file.suffix[1:]))


@pytest.mark.parametrize(("suffix", "channels", "bits"), [(".heic", 3, 10), (".heic", 4, 10), (".avif", 3, 10),
                         (".avif", 4, 10), (".jp2", 3, 16), (".j2k", 3, 16), (".ppm", 3, 16)])  # fmt: skip
def test_deep_colours_are_read_in_full(tmp_path: Path, suffix: str, channels: int, bits: int) -> None:
    samples = np.linspace(0, 65535, 96 * 128).astype(np.uint16).reshape(96, 128, 1).repeat(channels, 2)
    samples[:48, :, 1:] = samples[48:, ::-1, 1:]
    _write_deep(tmp_path / f"a{suffix}", samples)
    image = read_image(tmp_path / f"a{suffix}")
    assert (image.metadata.bit_depth, image.metadata.channels) == (bits, channels)
    assert image.pixels.dtype == np.uint16
    shown = image.pixels if channels == 3 else image.pixels[image.alpha > 200]
    error = np.abs(shown.astype(int) - (samples if channels == 3 else samples[image.alpha > 200])[..., :3])
    assert error.max() < 65536 * 5 / 2**bits
    assert image.pixels.max() == 65535
    if suffix != ".heic":
        with Image.open(tmp_path / f"a{suffix}") as opened:
            [frame] = as_inputs(opened)
        assert isinstance(frame, Frame)
        assert frame.decoded().pixels.dtype == np.uint8
        assert frame.decoded().metadata.bit_depth == 8


def test_a_portable_pixmap_of_16_bits_needs_all_its_samples(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "text.ppm").write_bytes(b"P3 2 1 65535\n0 1 2 3 4 65535")
    assert read_image(tmp_path / "text.ppm").pixels.tolist() == [[[0, 1, 2], [3, 4, 65535]]]
    (tmp_path / "cut.ppm").write_bytes(b"P6 40 30 65535\n" + bytes(100))
    with pytest.raises(InputError, match="not enough image data"):
        read_image(tmp_path / "cut.ppm")
    assert capfd.readouterr().err == ""


@pytest.mark.parametrize(("bits", "channels", "stored"), [(20, 3, 8), (12, 1, 16)])
def test_other_depths_of_jpeg_2000_are_those_that_pillow_gives(
    tmp_path: Path, bits: int, channels: int, stored: int
) -> None:
    kind = np.uint32 if bits > 16 else np.uint16
    samples = np.linspace(0, 2**bits - 1, 64 * 48).astype(kind).reshape(48, 64, 1).repeat(channels, 2)
    encoded = imagecodecs.jpeg2k_encode(samples, level=0, codecformat="jp2", bitspersample=bits)
    (tmp_path / "a.jp2").write_bytes(encoded)
    image = read_image(tmp_path / "a.jp2")
    assert (image.metadata.bit_depth, 8 * image.pixels.itemsize) == (stored, stored)


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


@pytest.mark.parametrize("orientation", range(1, 9))
def test_raw_files_are_turned_by_their_orientation(tmp_path: Path, orientation: int) -> None:
    pytest.importorskip("rawpy")
    stored, file = read_image(_dng(tmp_path / "a.dng")), _dng(tmp_path / "b.dng", orientation)
    image, metadata = read_image(file), read_metadata(file)
    np.testing.assert_array_equal(image.pixels, turned(stored.pixels, orientation))
    assert (metadata.orientation, metadata.size) == (orientation, image.pixels.shape[1::-1])


@pytest.mark.parametrize(("orientation", "size"), [(1, (6000, 4000)), (3, (6000, 4000)), (8, (4000, 6000))])
def test_the_focal_length_of_a_raw_file_holds_for_its_image_too(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, orientation: int, size: tuple[int, int]
) -> None:
    """Its tags count pixels of the sensor, however the camera was held; and of a camera without a name too."""
    tag = ExifTags.Base
    exif = Image.Exif()
    photo: dict[int, float] = {tag.FocalLength: 50.0, tag.FocalPlaneXResolution: 4000.0}
    exif.get_ifd(ExifTags.IFD.Exif).update(photo | {tag.ExifImageWidth: 6000, tag.ExifImageHeight: 4000})
    monkeypatch.setattr("rdstitch.io.metadata.raw_exif", lambda _: exif)
    monkeypatch.setattr("rdstitch.io.metadata.raw_size", lambda _: ((6000, 4000), orientation))
    (tmp_path / "a.cr2").write_bytes(b"raw")
    metadata = read_metadata(tmp_path / "a.cr2")
    write_image(tmp_path / "a.jpg", np.zeros((size[1], size[0]), np.uint8), None, metadata)
    focal = [metadata.focal_px, read_metadata(tmp_path / "a.jpg").focal_px]
    assert focal == pytest.approx([50.0 / 25.4 * 4000.0] * 2)
    assert (metadata.size, metadata.channels, metadata.orientation) == (size, 3, orientation)


@pytest.mark.parametrize(("name", "package"), [("a.heic", "pillow_heif"), ("a.CR3", "rawpy")])
def test_what_is_missing_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str, package: str) -> None:
    monkeypatch.setitem(sys.modules, package, None)
    (tmp_path / name).write_bytes(b"image")
    for read in (read_image, read_metadata):
        with pytest.raises(InputError, match=f"pip install {package.replace('_', '-')}"):
            read(tmp_path / name)


@pytest.mark.parametrize("name", ["a.heic", "a.dng"])
def test_damaged_files_are_named(tmp_path: Path, name: str) -> None:
    pytest.importorskip("pillow_heif" if name == "a.heic" else "rawpy")
    (tmp_path / name).write_bytes(b"no image at all")
    for read in (read_image, read_metadata):
        with pytest.raises(InputError, match=name):
            read(tmp_path / name)


@pytest.mark.parametrize(("name", "shape"), [("a.png", (100, 100, 4)), ("a.tif", (60, 100, 200))])
def test_the_limit_of_memory_knows_channels_and_depth(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str, shape: tuple[int, int, int]
) -> None:
    """By the header alone; the limit can be raised."""
    file, samples = tmp_path / name, np.zeros(shape, np.uint16)
    if file.suffix == ".png":
        file.write_bytes(cv2.imencode(".png", samples)[1].tobytes())
    else:
        tifffile.imwrite(file, samples, planarconfig="contig", photometric="minisblack")
    for setting, message in (
        (str(0.9 * samples.nbytes / 1e9), f"100 x {shape[0]} pixels take .* set {MAX_IMAGE_GB}"),
        ("much", f"{MAX_IMAGE_GB}=much: expected a number"),
    ):
        monkeypatch.setenv(MAX_IMAGE_GB, setting)
        for read in (read_metadata, read_image):
            with pytest.raises(InputError, match=message):
                read(file)
    monkeypatch.setenv(MAX_IMAGE_GB, str(1.1 * samples.nbytes / 1e9))
    assert read_image(file).pixels.dtype == np.uint16


def _dng(file: Path, orientation: int = 1) -> Path:
    """A mosaic of a grey ramp, as the simplest DNG."""
    width, height = 256, 192
    ramp = np.tile(np.linspace(200, 3800, width), (height, 1)).astype(np.uint16)
    rational = (10000, 10000, 0, 10000, 0, 10000, 0, 10000, 10000, 10000, 0, 10000, 0, 10000, 0, 10000, 10000, 10000)
    tags = [
        (271, 2, 0, "Maker", True),
        (272, 2, 0, "Model", True),
        (274, 3, 1, orientation, True),
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


def _state() -> tuple[object, ...]:
    handlers = [list(logging.getLogger(name).handlers) for name in (None, "PIL", "tifffile")]
    return list(warnings.filters), warnings.showwarning, handlers, cv2.utils.logging.getLogLevel(), cv2.getNumThreads()


def test_reading_in_threads_leaves_the_process_as_it_was(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    for number in range(10):
        deep = rng.integers(0, 65536, (64, 64, 3), dtype=np.uint16)
        write_image(tmp_path / f"{number}.png", deep)
        Image.fromarray((deep // 257).astype(np.uint8)).save(tmp_path / f"{number}.jpg")
        (tmp_path / f"{number}.webp").write_bytes(b"RIFF\x10\0\0\0WEBP" + rng.bytes(40))

    def read(path: Path) -> None:
        if path.suffix == ".webp":
            with pytest.raises(InputError):
                read_metadata(path)
        else:
            read_image(path)

    before = _state()
    with ThreadPoolExecutor(4) as pool:
        list(pool.map(read, sorted(tmp_path.iterdir()) * 10))
    assert _state() == before


def test_what_a_decoder_warns_of_reaches_the_host(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def bit_depth(image: Image.Image) -> int:
        warnings.warn("an odd file", UserWarning, stacklevel=1)
        return 8

    Image.new("L", (8, 8)).save(tmp_path / "a.png")
    monkeypatch.setattr("rdstitch.io.metadata.stored_bits", bit_depth)
    with pytest.warns(UserWarning, match="an odd file"):
        read_metadata(tmp_path / "a.png")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        with pytest.raises(InputError, match=r"a\.png: .*an odd file"):
            read_metadata(tmp_path / "a.png")


@pytest.mark.parametrize(("name", "bits"), [("a.jpg", 8), ("a.png", 16)])
def test_the_rest_is_not_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str, bits: int) -> None:
    """A hole of 2 GB, which takes no room on the disk, or a phone's video."""
    file, samples = tmp_path / name, np.full((40, 60, 3), 2**bits - 1, np.uint16 if bits == 16 else np.uint8)
    file.write_bytes(cv2.imencode(file.suffix, samples)[1].tobytes())
    with file.open("r+b") as stream:
        stream.truncate(2**31)
    taken: list[int] = []

    def counted(path: Path, most: int) -> bytes:
        taken.append(most)
        return read_beginning(path, most)

    monkeypatch.setattr(reading, "read_beginning", counted)
    np.testing.assert_allclose(read_image(file).pixels, samples, atol=1)
    assert max(taken) < 2**27
