"""What attacks a reader: other formats in disguise, pipes, blocks that take long or much."""

import os
import struct
import tracemalloc
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from PIL.PngImagePlugin import PngInfo

from rdstitch.errors import InputError
from rdstitch.file_access import open_regular, read_limited, read_text
from rdstitch.io import read_image, read_metadata, write_image
from rdstitch.io.deepzoom import MAX_TILE_PROFILE
from rdstitch.io.metadata import MAX_PROFILE

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
def test_only_the_documented_formats_are_opened(
    tmp_path: Path, content: bytes, function: object, monkeypatch: pytest.MonkeyPatch
) -> None:
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
        in_tile = read_metadata(tmp_path / "a_files" / "6" / "0_0.jpg").icc_profile
        assert in_tile == (metadata.icc_profile if size <= MAX_TILE_PROFILE else b"")
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


def test_a_small_file_takes_little_memory_whatever_the_limit(tmp_path: Path) -> None:
    (tmp_path / "file").write_bytes(b"abc")
    tracemalloc.start()
    assert read_limited(tmp_path / "file", 2**31) == b"abc"
    assert tracemalloc.get_traced_memory()[1] < 2**23
    tracemalloc.stop()


def test_a_file_of_several_blocks_is_read_whole(tmp_path: Path) -> None:
    content = bytes(range(256)) * 2**15
    (tmp_path / "file").write_bytes(content)
    assert read_limited(tmp_path / "file", len(content)) == content
    with pytest.raises(OSError, match="too large"):
        read_limited(tmp_path / "file", len(content) - 1)
