"""Reading images and their metadata."""

import struct
import tracemalloc
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tifffile
from numpy.typing import NDArray
from PIL import Image, PngImagePlugin

from rdstitch.geometry.camera import Camera
from rdstitch.geometry.lens_model import LensModel
from rdstitch.io.attitude import CONVENTIONS
from rdstitch.io.lens_correction import corrected
from rdstitch.io.metadata import Metadata, read_metadata
from rdstitch.io.read import DecodedImage, read_image
from rdstitch.io.write import write_image

Samples = NDArray[Any]


@pytest.fixture
def colours() -> Samples:
    """A small image whose every pixel differs, with 8 bits."""
    v, u = np.mgrid[:23, :31]
    return np.stack([u * 8, v * 11, (u * v) % 256], axis=-1).astype(np.uint8)


@pytest.mark.parametrize("orientation", range(1, 9))
def test_orientation_is_applied(tmp_path: Path, colours: Samples, orientation: int) -> None:
    exif = Image.Exif()
    exif[0x0112] = orientation
    upright = Image.fromarray(colours)
    # What a camera held that way stores: the inverse of what a reader must do.
    stored = {
        1: upright,
        2: upright.transpose(Image.Transpose.FLIP_LEFT_RIGHT),
        3: upright.transpose(Image.Transpose.ROTATE_180),
        4: upright.transpose(Image.Transpose.FLIP_TOP_BOTTOM),
        5: upright.transpose(Image.Transpose.TRANSPOSE),
        6: upright.transpose(Image.Transpose.ROTATE_90),
        7: upright.transpose(Image.Transpose.TRANSVERSE),
        8: upright.transpose(Image.Transpose.ROTATE_270),
    }[orientation]
    stored.save(tmp_path / "a.png", exif=exif)
    image = read_image(tmp_path / "a.png")
    np.testing.assert_array_equal(image.pixels, colours)
    assert image.metadata.orientation == orientation
    assert image.metadata.size == (31, 23)
    assert Image.Exif().get(0x0112) is None
    kept = Image.Exif()
    kept.load(image.metadata.exif)
    assert kept[0x0112] == 1


def test_sixteen_bits_stay_sixteen(tmp_path: Path, colours: Samples) -> None:
    deep = colours.astype(np.uint16) * 257 + 3
    tifffile.imwrite(tmp_path / "a.tif", deep, photometric="rgb")
    np.testing.assert_array_equal(read_image(tmp_path / "a.tif").pixels, deep)
    Image.fromarray(deep[..., 0]).save(tmp_path / "grey.png")
    np.testing.assert_array_equal(read_image(tmp_path / "grey.png").pixels, deep[..., 0])
    assert read_metadata(tmp_path / "grey.png").bit_depth == 16


def test_five_bands(tmp_path: Path) -> None:
    bands = np.random.default_rng(0).integers(0, 60000, (5, 9, 13), dtype=np.uint16)
    tifffile.imwrite(tmp_path / "a.tif", bands, photometric="minisblack", planarconfig="separate")
    np.testing.assert_array_equal(read_image(tmp_path / "a.tif").pixels, np.moveaxis(bands, 0, -1))
    assert read_metadata(tmp_path / "a.tif").size == (13, 9)


def test_not_a_number_becomes_transparent(tmp_path: Path) -> None:
    values = np.linspace(0, 1, 12, dtype=np.float32).reshape(3, 4)
    values[1, 2], values[2, 0] = np.nan, np.inf
    tifffile.imwrite(tmp_path / "a.tif", values)
    image = read_image(tmp_path / "a.tif")
    assert image.alpha is not None
    assert np.isfinite(image.pixels).all()
    np.testing.assert_array_equal(image.alpha == 0, ~np.isfinite(values))


@pytest.mark.parametrize("mode", ["1", "L", "LA", "P", "CMYK", "YCbCr", "LAB", "I", "F", "I;16"])
def test_every_mode_becomes_grey_or_rgb(tmp_path: Path, colours: Samples, mode: str) -> None:
    image = Image.fromarray(colours).convert("L" if mode in ("I;16", "F") else "RGB").convert(mode)
    image.save(tmp_path / "a.tif")
    decoded = read_image(tmp_path / "a.tif")
    assert decoded.pixels.shape[:2] == (23, 31)
    assert decoded.pixels.ndim == 2 or decoded.pixels.shape[2] == 3
    assert decoded.pixels.dtype in (np.uint8, np.uint16, np.float32)


@pytest.mark.parametrize("deep", [False, True])
def test_a_grey_that_stands_for_nothing_is_transparent_and_counted(tmp_path: Path, deep: bool) -> None:
    grey = np.arange(20 * 30).reshape(20, 30) * 100
    image = Image.fromarray(grey.astype(np.uint16) if deep else (grey % 256).astype(np.uint8))
    image.save(tmp_path / "a.png", transparency=300 if deep else 44)
    decoded = read_image(tmp_path / "a.png")
    assert decoded.pixels.ndim == 2
    assert decoded.alpha is not None
    assert ((decoded.alpha == 0) == (grey == 300 if deep else grey % 256 == 44)).all()
    assert read_metadata(tmp_path / "a.png").channels == 2


def test_the_header_knows_whether_there_are_colours(tmp_path: Path, colours: Samples) -> None:
    for mode, suffix in (
        ("L", "png"),
        ("P", "png"),
        ("P", "gif"),
        ("P", "tif"),
        ("RGB", "jpg"),
        ("L", "jpg"),
        ("CMYK", "jpg"),
        ("1", "tif"),
    ):
        for coloured in (True, False):
            image = Image.fromarray(colours if coloured else colours[..., 0]).convert(mode)
            image.save(tmp_path / f"a.{suffix}")
            bands = read_image(tmp_path / f"a.{suffix}").pixels.shape[2:]
            assert read_metadata(tmp_path / f"a.{suffix}").channels == (bands[0] if bands else 1), (mode, suffix)


def test_first_image_of_several(tmp_path: Path, colours: Samples) -> None:
    frames = [Image.fromarray(colours), Image.fromarray(255 - colours)]
    for name in ("a.gif", "a.png", "a.webp", "a.tif"):
        frames[0].save(tmp_path / name, save_all=True, append_images=frames[1:])
        pixels = read_image(tmp_path / name).pixels
        assert np.abs(pixels.astype(int) - colours).mean() < 12


_CALIBRATED, _MIDDLE = 'drone-dji:CalibratedFocalLength="268.0"', ' drone-dji:CalibratedOpticalCenterX="{}"'


class TestMetadata:
    """What drones and cameras write."""

    @pytest.mark.parametrize(
        ("width", "tags", "xmp", "focal"),
        [
            (400, {0xA405: 28}, "", 500 * 28 / np.hypot(36, 24)),
            # 5 mm, 800 pixels per mm at a width of 4000 pixels; the file was made smaller since.
            (1000, {0x920A: 5.0, 0xA20E: 800.0, 0xA210: 4, 0xA002: 4000}, "", 1000.0),
            # Calibrated, as the drone wrote it, with a middle that is not quite there; reduced, by EXIF's width or by
            # the middle.
            (400, {0xA002: 400}, _CALIBRATED + _MIDDLE.format(203.0), 268.0),
            (400, {0xA002: 1600}, _CALIBRATED, 67.0),
            (400, {0xA002: 400}, _CALIBRATED + _MIDDLE.format(800.0), 67.0),
            (400, {}, _CALIBRATED + _MIDDLE.format(800.0), 67.0),
            # Nothing says that it was reduced, but what 35 mm film would have says so; that it was, and by how much.
            (400, {0xA405: 6}, _CALIBRATED, None),
            (400, {0xA405: 6}, _CALIBRATED + _MIDDLE.format(800.0), 67.0),
        ],
    )
    def test_a_focal_length_is_that_of_the_pixels_there_are(
        self, tmp_path: Path, width: int, tags: dict[int, Any], xmp: str, focal: float | None
    ) -> None:
        exif = Image.Exif()
        exif[0x8769] = tags
        told: dict[str, Any] = {"xmp": f"<rdf:Description {xmp}/>".encode()} if xmp else {}
        Image.new("L", (width, width * 3 // 4)).save(tmp_path / "a.jpg", exif=exif, **told)
        assert read_metadata(tmp_path / "a.jpg").focal_px == pytest.approx(focal)

    @pytest.mark.parametrize(("reference", "sign"), [(b"\0", 1), (b"\1", -1), (b"\2", 1), (b"\3", -1)])
    def test_altitudes_below_the_sea(self, tmp_path: Path, reference: bytes, sign: int) -> None:
        exif = Image.Exif()
        exif[0x8825] = {1: "N", 2: (31.0, 30.0, 0.0), 3: "E", 4: (35.0, 30.0, 0.0), 5: reference, 6: 430.0}
        Image.new("L", (8, 8)).save(tmp_path / "a.jpg", exif=exif)
        assert read_metadata(tmp_path / "a.jpg").gps.altitude == sign * 430.0

    @pytest.mark.parametrize(("orientation", "dpi"), [(1, (300, 150)), (3, (300, 150)), (6, (150, 300))])
    def test_dpi_are_turned_with_the_image(self, tmp_path: Path, orientation: int, dpi: tuple[int, int]) -> None:
        exif = Image.Exif()
        exif[0x0112] = orientation
        Image.new("L", (8, 6)).save(tmp_path / "a.jpg", exif=exif, dpi=(300, 150))
        assert read_metadata(tmp_path / "a.jpg").dpi == dpi

    @pytest.mark.parametrize("suffix", ["jpg", "png", "webp", "tif", "ome.tif"])
    @pytest.mark.parametrize("coding", ["utf-8", "latin-1"])
    def test_names_keep_their_bytes(self, tmp_path: Path, suffix: str, coding: str) -> None:
        author, exif = "© Jürgen Müller".encode(coding), Image.Exif()
        exif[0x013B] = exif[0x8298] = author
        exif.get_ifd(0x8769)[0x9003] = "2024:05:06 07:08:09"
        Image.new("L", (8, 8)).save(tmp_path / "a.jpg", exif=exif)
        metadata = read_metadata(tmp_path / "a.jpg")
        for written in (metadata, metadata.of_composite()):
            write_image(tmp_path / f"b.{suffix}", np.zeros((8, 8), np.uint8), metadata=written)
            with Image.open(tmp_path / f"b.{suffix}") as image:
                tags = image.getexif()
                time = tags.get_ifd(0x8769).get(0x9003)
            assert [tags[tag].encode("latin-1") for tag in (0x013B, 0x8298)] == [author, author]
            assert time == (None if suffix == "ome.tif" else "2024:05:06 07:08:09")  # a text, and no bytes

    def test_place_and_attitude(self, tmp_path: Path) -> None:
        exif = Image.Exif()
        exif[0x010F], exif[0x0110] = "Maker", "Model"
        exif[0x8825] = {1: "S", 2: (33.0, 30.0, 36.0), 3: "W", 4: (70.0, 15.0, 0.0), 5: b"\x01", 6: 12.5}
        xmp = (
            '<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:Description drone-dji:GimbalYawDegree="+31.5" '
            'drone-dji:GimbalPitchDegree="-89.90" drone-dji:FlightYawDegree="1">'
            "<drone-dji:GimbalRollDegree>+0.25</drone-dji:GimbalRollDegree><drone-dji:RtkStdLon>0.03</drone-dji:RtkStdLon>"
            "<drone-dji:RtkStdLat>0.04</drone-dji:RtkStdLat><drone-dji:RtkStdHgt>0.06</drone-dji:RtkStdHgt>"
            "</rdf:Description></x:xmpmeta>"
        )
        Image.new("L", (8, 8)).save(tmp_path / "a.jpg", exif=exif, xmp=xmp.encode())
        metadata = read_metadata(tmp_path / "a.jpg")
        assert (metadata.gps.latitude, metadata.gps.longitude) == pytest.approx((-33.51, -70.25))
        assert metadata.gps.altitude == -12.5
        assert metadata.gps.std == pytest.approx((0.05 / 2**0.5, 0.06))
        assert (metadata.attitude.yaw, metadata.attitude.pitch, metadata.attitude.roll) == (31.5, -89.9, 0.25)
        assert metadata.attitude.convention == CONVENTIONS["dji-gimbal"]
        assert (metadata.make, metadata.model) == ("Maker", "Model")

    def test_a_hemisphere_that_is_not_told_is_not_guessed(self, tmp_path: Path) -> None:
        exif = Image.Exif()
        exif[0x8825] = {2: (33.0, 30.0, 36.0), 3: "W", 4: (70.0, 15.0, 0.0)}
        Image.new("L", (8, 8)).save(tmp_path / "a.jpg", exif=exif)
        metadata = read_metadata(tmp_path / "a.jpg")
        assert metadata.gps is None
        assert "whether north or south" in metadata.gps_problem

    def test_real_drone_image(self, shared_data: Callable[[str], Path]) -> None:
        (path,) = (p for p in shared_data("textures_cc0").iterdir() if p.suffix == ".JPG")
        metadata = read_metadata(path)
        assert metadata.focal_px == pytest.approx(3641.79, abs=0.01)
        assert metadata.attitude.convention == CONVENTIONS["pix4d-camera"]
        assert metadata.serial == "PI040378AA6C000032"
        assert metadata.gps.latitude == pytest.approx(41.429198, abs=1e-6)


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


def test_correction_of_a_lens_keeps_nothing() -> None:
    model = LensModel((1500.0, 1500.0), (1000.0, 600.0), (-0.1, 0.01, 0.0, 0.0, 0.0))
    camera = Camera((2000, 1200), -0.1, lens_model=model)
    image = DecodedImage(np.zeros((1200, 2000), np.uint8), None, Metadata((2000, 1200)))
    tracemalloc.start()
    try:
        corrected(image, camera, 1)
        assert tracemalloc.get_traced_memory()[0] < 2**17
    finally:
        tracemalloc.stop()
