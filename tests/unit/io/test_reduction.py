"""JPEG decoded by more than one decoder, and reduced while it is decoded."""

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

from rdstitch.features import FeatureOptions, View, detect, detect_view
from rdstitch.io.metadata import Metadata
from rdstitch.io.read import decoded_jpeg, read_image
from rdstitch.io.reduction import block_mean, halved, reduced_size
from rdstitch.io.write import write_image
from rdstitch.options.feature_options import CLOSER
from rdstitch.synthetic import ground

SIZE = (203, 149)


@pytest.fixture(scope="module")
def pixels() -> NDArray[np.uint8]:
    """Ground, as sharp as a lens leaves it."""
    colour = np.asarray(cv2.GaussianBlur(ground(SIZE, 3, 3).region(0, 0, *SIZE), (0, 0), 1.5))
    return np.asarray(np.clip(np.rint(colour * 255), 0, 255), np.uint8)


def _by_pillow(file: Path, factor: int) -> NDArray[np.uint8]:
    with Image.open(file) as image:
        image.draft(None, (image.size[0] // factor, image.size[1] // factor))
        return np.asarray(image)


@pytest.mark.parametrize("factor", [1, 2, 4, 8])
@pytest.mark.parametrize("options", [{}, {"progressive": True}, {"subsampling": 0}, {"quality": 30}], ids=str)
@pytest.mark.parametrize("grey", [False, True])
def test_it_decodes_what_pillow_does(
    tmp_path: Path, pixels: NDArray[np.uint8], factor: int, options: dict[str, Any], grey: bool
) -> None:
    file = tmp_path / "a.jpg"
    Image.fromarray(pixels).convert("L" if grey else "RGB").save(file, **options)
    found, complaint = decoded_jpeg(file, SIZE, factor, grey=grey)
    assert complaint == ""
    assert found.shape[1::-1] == reduced_size(SIZE, factor)
    np.testing.assert_array_equal(found, _by_pillow(file, factor))
    np.testing.assert_array_equal(read_image(file, factor).pixels, found)


def test_complaints_are_left_to_pillow(tmp_path: Path, pixels: NDArray[np.uint8]) -> None:
    file, cut, padded = (tmp_path / name for name in ("a.jpg", "cut.jpg", "padded.jpg"))
    Image.fromarray(pixels).save(file)
    data = file.read_bytes()
    cut.write_bytes(data[: len(data) // 2])
    padded.write_bytes(data[:-2] + bytes(100) + data[-2:])
    found, complaint = decoded_jpeg(cut, SIZE, 1, grey=False)
    assert (found, "Premature end" in complaint) == (None, True)
    assert decoded_jpeg(file, (SIZE[0] + 8, SIZE[1]), 1, grey=False) == (None, "")
    read = read_image(padded)
    np.testing.assert_array_equal(read.pixels, read_image(file).pixels)
    assert read.damage == ""


def test_damage_is_named(tmp_path: Path, pixels: NDArray[np.uint8]) -> None:
    file = tmp_path / "a.jpg"
    Image.fromarray(pixels).save(file)
    assert read_image(file).damage == ""
    data = file.read_bytes()
    file.write_bytes(data[: len(data) // 2] + data[len(data) // 2 + 400 :])
    for factor in (1, 2):
        damaged = read_image(file, factor)
        assert "orrupt JPEG data" in damaged.damage
        assert damaged.pixels.shape[1::-1] == reduced_size(SIZE, factor)


WIDTH, HEIGHT = SIZE


@pytest.mark.parametrize("factor", [1, 2, 3, 8])
def test_blocks_become_px(tmp_path: Path, pixels: NDArray[np.uint8], factor: int) -> None:
    alpha = np.full((HEIGHT, WIDTH), 255, np.uint8)
    alpha[40:50, 60:90] = 0
    write_image(tmp_path / "a.png", pixels, alpha)
    image = read_image(tmp_path / "a.png", factor)
    rows, columns = -(-HEIGHT // factor), -(-WIDTH // factor)
    assert image.pixels.shape == (rows, columns, 3)
    assert image.metadata.size == (WIDTH, HEIGHT)
    for y, x in ((0, 0), (45 // factor, 75 // factor), (rows - 1, columns - 1)):
        block = np.s_[y * factor : (y + 1) * factor, x * factor : (x + 1) * factor]
        assert image.alpha[y, x] == alpha[block].min()
        if image.alpha[y, x] and (y + 1) * factor <= HEIGHT and (x + 1) * factor <= WIDTH:
            np.testing.assert_allclose(image.pixels[y, x], pixels[block].mean(axis=(0, 1)), atol=0.51)


@pytest.mark.parametrize("orientation", range(1, 9))
@pytest.mark.parametrize("factor", [2, 4, 6, 8])
def test_jpeg_is_reduced_in_place(tmp_path: Path, pixels: NDArray[np.uint8], orientation: int, factor: int) -> None:
    """The decoder's own reduction is no other image than the mean of blocks; half a px of shift would show."""
    exif = Image.Exif()
    exif[0x0112] = orientation
    write_image(tmp_path / "a.jpg", pixels, None, Metadata((WIDTH, HEIGHT), exif=exif.tobytes()), quality=98)
    whole, small = (read_image(tmp_path / "a.jpg", k).pixels for k in (1, factor))
    expected = block_mean(whole, factor).astype(float)
    inner = np.s_[1:-1, 1:-1]
    error = np.abs(small - expected)[inner].mean()
    assert small.shape == expected.shape
    for axis in (0, 1):
        shifted = 0.5 * (expected + np.roll(expected, 1, axis))
        assert error < 0.5 * np.abs(shifted - expected)[inner].mean()


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
@pytest.mark.parametrize("channels", [1, 2, 3, 4])
def test_halved_px_are_means_of_what_is_opaque(dtype: type[np.uint8 | np.uint16], channels: int) -> None:
    rng, full = np.random.default_rng(channels), np.iinfo(dtype).max
    strip = rng.integers(0, full + 1, (6, 8, channels + 1)).astype(dtype)
    strip[..., -1] = full * (rng.random((6, 8)) < 0.6)
    strip[:2, :2, -1], strip[2:4, :2, -1] = 0, full
    found = halved(strip, transparent=True)
    blocks = strip.reshape(3, 2, 4, 2, channels + 1).astype(np.float64)
    share = blocks[..., -1:] / full
    total = np.maximum(share.sum(axis=(1, 3)), 1e-9)
    np.testing.assert_array_equal(found[..., :-1], np.floor((blocks * share).sum(axis=(1, 3)) / total + 0.5)[..., :-1])
    np.testing.assert_array_equal(found[..., -1], np.floor(blocks[..., -1].mean(axis=(1, 3)) + 0.5))


def test_features_of_a_reduced_image_lie_where_they_are_in_the_whole(pixels: NDArray[Any]) -> None:
    large = np.asarray(cv2.resize(pixels, (4 * WIDTH, 4 * HEIGHT), interpolation=cv2.INTER_CUBIC))
    options = FeatureOptions(work_megapixels=WIDTH * HEIGHT / 1e6)
    whole = detect(large, options)
    asked: list[float | None] = []

    def load(megapixels: float | None) -> View:
        asked.append(megapixels)
        return View(block_mean(large, 2), reduction=2, image_size=(4 * WIDTH, 4 * HEIGHT))

    small = detect_view(load, options)
    assert small.image_size == whole.image_size == (4 * WIDTH, 4 * HEIGHT)
    assert asked == [options.work_megapixels, CLOSER * WIDTH * HEIGHT / 1e6]  # for a closer look
    distance = np.linalg.norm(whole.points[:50, None] - small.points[None], axis=2).min(axis=1)
    assert np.median(distance) < 0.2
