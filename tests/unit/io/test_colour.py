"""Colour spaces that a decoder can hand over, against Pillow with profiles."""

import struct
from pathlib import Path

import numpy as np
import pytest
import tifffile
from numpy.typing import NDArray
from PIL import Image, ImageCms

from rdstitch.io.colour import colour_space
from rdstitch.io.read import read_image

COLOURS = np.array([(200, 60, 60), (60, 200, 60), (40, 60, 200), (128, 128, 128), (250, 240, 200), (20, 25, 30)])
PATCHES = np.repeat(np.repeat(COLOURS[None], 16, axis=0), 8, axis=1).astype(np.uint8)


def lab() -> NDArray[np.uint8]:
    """The patches in CIELAB as TIFF stores it, a* and b* with a sign."""
    profiles = ImageCms.createProfile("sRGB"), ImageCms.createProfile("LAB")
    image = ImageCms.profileToProfile(Image.fromarray(PATCHES), *profiles, outputMode="LAB")
    assert image is not None
    return np.asarray(image)


@pytest.mark.parametrize("kind", ["cielab", "icclab"])
@pytest.mark.parametrize("bits", [8, 16])
def test_cielab(tmp_path: Path, kind: str, bits: int) -> None:
    samples = lab().astype(np.uint16)
    if kind == "icclab":
        samples[..., 1:] ^= 128
    if bits == 16:
        samples *= 256
        samples[..., 0] = samples[..., 0] // 256 * (257 if kind == "cielab" else 256)
    tifffile.imwrite(tmp_path / "lab.tif", samples.astype(f"u{bits // 8}"), photometric=kind)
    found = read_image(tmp_path / "lab.tif")
    assert found.pixels.dtype == f"u{bits // 8}"
    assert np.abs(found.pixels / (257.0 if bits == 16 else 1.0) - PATCHES).max() <= 2.0
    assert found.metadata.icc_profile == b""


def ink_profile() -> bytes:
    """A profile of inks of a kind that no formula guesses: cyan is green, yellow violet, paper a light grey."""
    lab_of = np.zeros((2, 2, 2, 2, 3))
    for c, m, y, k in np.ndindex(2, 2, 2, 2):
        lab_of[c, m, y, k] = (90 - 22 * c - 24 * m - 14 * y - 24 * k) * (1 - 0.8 * k), 40 * (m - c), 30 * (c - y)
    steps = bytes(range(256))
    table = np.rint((lab_of + np.array([0, 128, 128])) * [2.55, 1, 1]).astype(np.uint8).tobytes()
    identity = b"".join(struct.pack(">i", 65536 * (i % 4 == 0)) for i in range(9))
    lut = b"mft1\0\0\0\0" + bytes([4, 3, 2, 0]) + identity + steps * 4 + table + steps * 3
    white = b"XYZ \0\0\0\0" + struct.pack(">3i", 63190, 65536, 54061)
    offset = 128 + 4 + 2 * 12
    tags = struct.pack(">I", 2)
    tags += struct.pack(">4sII", b"A2B0", offset, len(lut)) + struct.pack(">4sII", b"wtpt", offset + len(lut), 20)
    size = offset + len(lut) + len(white)
    header = struct.pack(">I4sI4s4s4s", size, b"none", 0x02400000, b"prtr", b"CMYK", b"Lab ") + bytes(12) + b"acsp"
    head = header.ljust(68, b"\0") + struct.pack(">3i", 63190, 65536, 54061).ljust(60, b"\0")
    return b"".join([head, tags, lut, white])


@pytest.mark.parametrize("name", ["inks.jpg", "inks.tif"])
def test_inks_become_what_their_profile_says(tmp_path: Path, name: str) -> None:
    inks = Image.fromarray(PATCHES).convert("CMYK")
    inks.save(tmp_path / name, icc_profile=ink_profile(), quality=100)
    with Image.open(tmp_path / name) as stored:
        expected = ImageCms.profileToProfile(
            stored, ImageCms.getOpenProfile(_file(tmp_path)), ImageCms.createProfile("sRGB"), outputMode="RGB"
        )
    found = read_image(tmp_path / name)
    np.testing.assert_array_equal(found.pixels, np.asarray(expected))
    assert np.abs(found.pixels.astype(float) - PATCHES).max() > 50.0
    assert (found.metadata.icc_profile, found.metadata.profile_lost) == (b"", "")


def _file(folder: Path) -> str:
    path = folder / "inks.icc"
    path.write_bytes(ink_profile())
    return str(path)


def test_inks_without_a_profile_that_can_be_used(tmp_path: Path) -> None:
    inks = Image.fromarray(PATCHES).convert("CMYK")
    inks.save(tmp_path / "plain.tif")
    inks.save(tmp_path / "broken.tif", icc_profile=ink_profile()[:300])
    plain, broken = (read_image(tmp_path / name) for name in ("plain.tif", "broken.tif"))
    np.testing.assert_array_equal(plain.pixels, PATCHES)
    np.testing.assert_array_equal(broken.pixels, PATCHES)
    assert "cannot be used" in broken.metadata.profile_lost
    tifffile.imwrite(tmp_path / "deep.tif", np.asarray(inks).astype(np.uint16) * 257, photometric="separated")
    np.testing.assert_array_equal(read_image(tmp_path / "deep.tif").pixels, PATCHES)


def _with_curve(gamma: float) -> bytes:
    """The profile of sRGB, still called so, with another curve."""
    profile = bytearray(ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes())
    (count,) = struct.unpack_from(">I", profile, 128)
    for k in range(count):
        name, place, _ = struct.unpack_from(">4sII", profile, 132 + 12 * k)
        if name in (b"rTRC", b"gTRC", b"bTRC"):
            struct.pack_into(">4sIHHi", profile, place, b"para", 0, 0, 0, round(gamma * 65536))
    assert b"s\0R\0G\0B" in profile
    return bytes(profile)


def test_samples_proportional_to_light_are_no_srgb_whatever_their_profile_is_called() -> None:
    assert colour_space(b"") == colour_space(_with_curve(2.2)) == b""
    assert colour_space(_with_curve(1.0)) == _with_curve(1.0)
    assert colour_space(b"sRGB but no profile") == b""
