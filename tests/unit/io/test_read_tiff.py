"""TIFF means by its tags what it means, whatever its compression, sample type and orientation."""

from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tifffile
from numpy.typing import NDArray

from rdstitch.geometry.exif_orientation import inverse, turned
from rdstitch.io.metadata import read_metadata
from rdstitch.io.read import read_image

Samples = NDArray[Any]
H, W = 20, 30
PROFILE = b"\0" * 16 + b"RGB " + b"\0" * 180
ALPHA, PREMULTIPLIED, DATA = "unassalpha", "assocalpha", "unspecified"
FULL: dict[Any, float] = {np.uint8: 255, np.uint16: 65535, np.float32: 1.0}


def _bands(count: int, kind: Any) -> Samples:
    """Smooth bands that differ, so that JPEG keeps them; not symmetric, so that turning them shows."""
    v, u = np.mgrid[:H, :W] / max(H, W)
    values = [(0.2 + 0.1 * n) + 0.5 * u * (1.0 - 0.2 * n) + 0.2 * v for n in range(count)]
    scaled = np.clip(np.stack(values, axis=-1), 0, 1) * FULL[kind]
    return np.asarray(np.rint(scaled) if kind != np.float32 else scaled, dtype=kind)


def _write(file: Path, samples: Samples, orientation: int, planes: str, **options: Any) -> None:
    """Store upright samples as a camera would that was held so."""
    stored = turned(samples, inverse(orientation))
    stored = np.moveaxis(stored, -1, 0) if planes == "separate" else stored
    tags = [(274, 3, 1, orientation, True), (271, 2, 0, "Maker", True)]
    if samples.shape[2] > 1:
        options["planarconfig"] = planes
    else:
        stored = stored.squeeze()
    tifffile.imwrite(file, np.ascontiguousarray(stored), metadata=None, extratags=tags, iccprofile=PROFILE, **options)


@pytest.mark.parametrize("compression", [None, "zlib", "lzw", "packbits", "zstd", "jpeg"])
@pytest.mark.parametrize(
    ("photometric", "extra"),
    [
        *product(("minisblack", "miniswhite", "rgb"), ((), (ALPHA,), (PREMULTIPLIED,), (DATA,), (DATA, ALPHA))),
        ("rgb", (DATA, DATA)),
    ],
)
def test_what_a_band_is(tmp_path: Path, photometric: str, extra: tuple[str, ...], compression: str | None) -> None:
    colours = 1 if photometric.startswith("minis") else 3
    bands = colours + len(extra)
    jpeg = compression == "jpeg"
    if jpeg and extra:
        pytest.skip("tifffile does not write that")
    for number, (kind, planes) in enumerate(product(FULL, ("contig", "separate"))):
        if (jpeg and kind != np.uint8) or (planes == "separate" and (bands == 1 or jpeg)):
            continue
        orientation, what = (number + bands) % 8 + 1, f"{kind.__name__} {planes}"
        full, samples = FULL[kind], _bands(bands, kind)
        alphas = [colours + n for n, meaning in enumerate(extra) if meaning != DATA]
        stored, wanted = samples.copy(), np.delete(samples, alphas, axis=2)
        share = np.ones((H, W, 1))
        if alphas:
            alpha = stored[..., alphas[0]] = np.broadcast_to(np.arange(W) % 4 * (full / 3), (H, W)).astype(kind)
            share = alpha[..., None] / full
        if photometric == "miniswhite":
            stored[..., 0] = full - stored[..., 0] if kind != np.float32 else -stored[..., 0]
        if PREMULTIPLIED in extra:
            product_ = stored[..., :colours] * share
            stored[..., :colours] = product_ if kind == np.float32 else np.rint(product_)
        extras = {"extrasamples": extra} if extra else {}
        _write(
            tmp_path / "a.tif", stored, orientation, planes, photometric=photometric, compression=compression, **extras
        )
        image, metadata = read_image(tmp_path / "a.tif"), read_metadata(tmp_path / "a.tif")
        assert (image.pixels.dtype, image.pixels.ndim) == (kind, 2 if wanted.shape[2] == 1 else 3), what
        # A level of what was multiplied by one third is three levels.
        most = 0.03 if jpeg else 1.501 / full if PREMULTIPLIED in extra and kind != np.float32 else 1e-6
        error = np.abs(image.pixels.reshape(wanted.shape).astype(float) - wanted)[share[..., 0] > 0]
        assert error.max() <= most * full, what
        if alphas:
            np.testing.assert_allclose(image.alpha, share[..., 0] * 255.0, atol=0.51, err_msg=what)
        else:
            assert image.alpha is None, what
        assert (metadata.size, metadata.orientation, metadata.make) == ((W, H), orientation, "Maker"), what
        assert (metadata.icc_profile, metadata.channels) == (PROFILE, bands), what


@pytest.mark.parametrize("compression", [None, "zlib", "lzw", "jpeg"])
@pytest.mark.parametrize("bigtiff", [False, True])
def test_an_internal_mask_counts_in_any_compression(tmp_path: Path, compression: str | None, bigtiff: bool) -> None:
    samples, shown = _bands(3, np.uint8), np.arange(W) > 7
    mask = np.broadcast_to(shown, (H, W))
    with tifffile.TiffWriter(tmp_path / "a.tif", bigtiff=bigtiff) as tiff:
        tags = [(271, 2, 0, "Maker", True)]
        tiff.write(samples, photometric="rgb", compression=compression, metadata=None, extratags=tags)
        tiff.write(samples[::2, ::2], photometric="rgb", subfiletype=1, metadata=None)
        tiff.write(mask, photometric="mask", subfiletype=4, compression=None if compression == "jpeg" else compression)
    image = read_image(tmp_path / "a.tif")
    np.testing.assert_array_equal(image.alpha, np.where(mask, 255, 0))
    assert image.metadata.make == "Maker"


@pytest.mark.parametrize(
    ("kind", "bands", "nodata", "value", "counts"),
    [
        (np.float32, 1, "-9999", -9999.0, True),
        (np.float32, 1, "-3.4028234663852886e+38", np.finfo(np.float32).min, True),
        (np.float32, 3, "-9999", -9999.0, True),
        (np.int16, 1, "-32768", -32768, True),
        (np.uint8, 3, "0", 0, True),
        (np.uint16, 1, "65535 ", 65535, True),
        (np.uint8, 1, "-9999", 3, False),
        (np.uint8, 1, "nan", 3, False),
        (np.uint8, 1, "none", 3, False),
    ],
)
def test_nodata_is_empty(tmp_path: Path, kind: Any, bands: int, nodata: str, value: float, counts: bool) -> None:
    samples = np.full((H, W, bands), 7, kind)
    samples[3:5] = value
    # In one band it is a colour's part where samples are counts, and lacking where they are measured.
    samples[10, 10, 0] = value
    partial = bands == 1 or kind == np.float32
    wanted = np.isin(np.arange(H), (3, 4))[:, None].repeat(W, axis=1)
    wanted[10, 10] = partial
    options: dict[str, Any] = {"extratags": [(42113, 2, 0, nodata, True)], "metadata": None, "compression": "lzw"}
    tifffile.imwrite(
        tmp_path / "a.tif", samples.squeeze(), photometric="rgb" if bands == 3 else "minisblack", **options
    )
    alpha = read_image(tmp_path / "a.tif").alpha
    assert (alpha is None) if not counts else ((alpha == 0) == wanted).all()


def test_nodata_is_looked_for_in_what_is_no_alpha(tmp_path: Path) -> None:
    samples = np.full((H, W, 4), 200, np.uint8)
    samples[:5, :, :3] = 0
    options: dict[str, Any] = {"extratags": [(42113, 2, 0, "0", True)], "extrasamples": [ALPHA], "metadata": None}
    tifffile.imwrite(tmp_path / "a.tif", samples, photometric="rgb", **options)
    alpha = read_image(tmp_path / "a.tif").alpha
    np.testing.assert_array_equal(alpha, np.where(np.arange(H) < 5, 0, 200)[:, None].repeat(W, axis=1))


def test_few_bits_fill_the_range_and_palettes_are_colours(tmp_path: Path) -> None:
    levels = np.arange(16, dtype=np.uint8).reshape(4, 4)
    table = np.stack([np.arange(256) * 256, np.full(256, 65535), np.zeros(256)]).astype(np.uint16)
    for compression in (None, "lzw"):
        tifffile.imwrite(tmp_path / "p.tif", levels, photometric="palette", colormap=table, compression=compression)
        image = read_image(tmp_path / "p.tif")
        np.testing.assert_array_equal(image.pixels, np.stack([levels, np.full_like(levels, 255), 0 * levels], axis=-1))
        tifffile.imwrite(tmp_path / "b.tif", levels > 6, photometric="miniswhite", compression=compression)
        np.testing.assert_array_equal(read_image(tmp_path / "b.tif").pixels, np.where(levels > 6, 0, 255))
    # Four bits a sample, by hand.
    packed = (levels[:, ::2] << 4 | levels[:, 1::2]).tobytes()
    tifffile.imwrite(tmp_path / "four.tif", levels[:, :2], photometric="minisblack", metadata=None)
    data = bytearray((tmp_path / "four.tif").read_bytes())
    with tifffile.TiffFile(tmp_path / "four.tif") as tiff:
        tags, offset = tiff.pages.first.tags, tiff.pages.first.dataoffsets[0]
        for code, value in ((256, 4), (258, 4)):
            at = tags[code].valueoffset
            data[at : at + 2] = value.to_bytes(2, "little")
        data[offset : offset + 8] = packed
    (tmp_path / "four.tif").write_bytes(data)
    np.testing.assert_array_equal(read_image(tmp_path / "four.tif").pixels, levels * 17)


def test_the_header_of_the_first_page_is_read_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    tifffile.imwrite(tmp_path / "a.tif", np.zeros((3, 5, 7), np.uint8), photometric="minisblack")
    monkeypatch.setattr(tifffile.TiffPages, "__len__", lambda _: pytest.fail("all pages were looked for"))
    assert read_metadata(tmp_path / "a.tif").size == (7, 5)
