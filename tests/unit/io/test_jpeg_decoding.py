"""JPEG decoded straight into arrays: what Pillow decodes, and nothing where there is any complaint."""

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

from rdstitch.io import read_image
from rdstitch.io.read import decoded_jpeg
from rdstitch.io.reduction import reduced_size
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
