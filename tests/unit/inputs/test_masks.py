"""Masks: read as what they show, brought to their images by name, and refused by name."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

from rdstitch.camera import Camera
from rdstitch.errors import InputError
from rdstitch.inputs.selection import with_masks
from rdstitch.inputs.source import Source
from rdstitch.io.mask import mask_frame, read_mask
from rdstitch.io.metadata import Metadata
from rdstitch.orientation import SIDEWAYS, turned, turned_size

SIZE = (40, 30)


def leg() -> NDArray[np.bool_]:
    """True but for a corner."""
    counts = np.ones(SIZE[::-1], dtype=bool)
    counts[20:, 24:] = False
    return counts


def save(path: Path, pixels: NDArray[np.uint8], **options: object) -> Path:
    path.parent.mkdir(exist_ok=True)
    Image.fromarray(pixels).save(path, **options)  # type: ignore[arg-type]
    return path


def source(path: Path) -> Source:
    return Source(path, Metadata(SIZE), Camera(SIZE))


@pytest.mark.parametrize(
    ("name", "pixels"),
    [
        ("labels.png", leg().astype(np.uint8)),
        ("white.png", np.where(leg(), 255, 0).astype(np.uint8)),
        ("colour.png", np.where(leg(), 200, 0).astype(np.uint8)[..., None] * np.array([0, 1, 0], np.uint8)),
        ("lossy.jpg", np.where(leg(), 255, 0).astype(np.uint8)),
        ("transparent.png", np.dstack([np.full((30, 40, 3), 255), np.where(leg(), 255, 0)]).astype(np.uint8)),
        ("twice.png", np.where(leg(), 255, 0).astype(np.uint8).repeat(2, axis=0).repeat(2, axis=1)),
        ("half.png", np.where(leg(), 255, 0).astype(np.uint8)[::2, ::2]),
    ],
)
def test_a_mask_means_what_it_shows(tmp_path: Path, name: str, pixels: NDArray[np.uint8]) -> None:
    path = save(tmp_path / name, pixels)
    mask_frame(path, "image.png", SIZE)
    mask = read_mask(path, SIZE)
    assert mask.dtype == np.uint8
    np.testing.assert_array_equal(mask, np.where(leg(), 255, 0))


def test_a_black_mask_leaves_nothing_and_a_white_one_all(tmp_path: Path) -> None:
    for value in (0, 1, 255):
        mask = read_mask(save(tmp_path / "a.png", np.full((30, 40), value, np.uint8)), SIZE)
        assert (mask == (255 if value else 0)).all()


@pytest.mark.parametrize("shape", [(40, 30), (30, 42), (15, 22), (300, 420)])
def test_a_mask_of_another_shape_is_named(tmp_path: Path, shape: tuple[int, int]) -> None:
    path = save(tmp_path / "a.png", np.zeros(shape, np.uint8))
    with pytest.raises(InputError, match=rf"a\.png: a mask of {shape[1]} x {shape[0]} pixels does not fit on .*b\.png"):
        mask_frame(path, tmp_path / "b.png", SIZE)


@pytest.mark.parametrize("orientation", range(1, 9))
def test_what_a_camera_hides_turns_with_the_stored_image(tmp_path: Path, orientation: int) -> None:
    upright = turned_size(SIZE, orientation)
    path = save(tmp_path / "leg.png", leg().astype(np.uint8))
    expected = np.where(turned(leg(), orientation), 255, 0)
    frame = mask_frame(path, "image.png", upright, orientation, of_camera=True)
    np.testing.assert_array_equal(read_mask(path, upright, frame), expected)
    # The mask of one image is as that looks; of one for all only its shape can say that.
    shown = save(tmp_path / "shown.png", np.ascontiguousarray(turned(leg(), orientation)).astype(np.uint8))
    frame = mask_frame(shown, "image.png", upright, orientation)
    np.testing.assert_array_equal(read_mask(shown, upright, frame), expected)
    if orientation in SIDEWAYS:
        assert mask_frame(shown, "image.png", upright, orientation, of_camera=True) is None
        assert mask_frame(path, "image.png", upright, orientation) == orientation


def test_what_a_mask_excludes_is_transparent_with_what_was(tmp_path: Path) -> None:
    alpha = np.full((30, 40), 255, np.uint8)
    alpha[:5] = 7
    image = save(tmp_path / "a.png", np.dstack([np.full((30, 40, 3), 90, np.uint8), alpha]))
    mask = save(tmp_path / "masks" / "a.png", leg().astype(np.uint8))
    read = replace(source(image), mask=mask).read()
    np.testing.assert_array_equal(read.alpha, np.where(leg(), alpha, 0))
    np.testing.assert_array_equal(read.pixels, np.full((30, 40, 3), 90))
    opaque = save(tmp_path / "b.png", np.full((30, 40), 90, np.uint8))
    np.testing.assert_array_equal(replace(source(opaque), mask=mask).read().alpha, np.where(leg(), 255, 0))


def test_masks_are_found_by_the_names_of_images(tmp_path: Path) -> None:
    sources = [source(tmp_path / f"{name}.jpg") for name in ("a", "b", "c")]
    white = np.full((30, 40), 255, np.uint8)
    of_a, of_c = save(tmp_path / "masks" / "a.png", white), save(tmp_path / "masks" / "c.TIF", white)
    save(tmp_path / "masks" / "z.png", np.zeros((3, 3), np.uint8))
    (tmp_path / "masks" / "b.txt").write_text("no image")
    assert [found.mask for found in with_masks(sources, tmp_path / "masks")] == [of_a, None, of_c]
    assert [found.mask for found in with_masks(sources, of_a)] == [of_a] * 3
    assert with_masks(sources, None) == sources


def test_masks_that_cannot_be_meant_are_refused(tmp_path: Path) -> None:
    white = np.full((30, 40), 255, np.uint8)
    image = save(tmp_path / "a.png", white)
    with pytest.raises(InputError, match=r"absent.*no such folder"):
        with_masks([source(image)], tmp_path / "absent")
    with pytest.raises(InputError, match="is the image itself"):
        with_masks([source(image)], tmp_path)
    save(tmp_path / "masks" / "b.png", white)
    with pytest.raises(InputError, match=r"none of the masks has the name of an image, such as a\.png"):
        with_masks([source(image)], tmp_path / "masks")
    save(tmp_path / "masks" / "a.png", white)
    save(tmp_path / "masks" / "a.bmp", white)
    with pytest.raises(InputError, match=r"a\.png: a\.bmp is a mask for the same image"):
        with_masks([source(image)], tmp_path / "masks")
