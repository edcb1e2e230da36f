"""Seams run where images look alike, and each side of one comes from the image that lies on that side."""

from functools import partial

import numpy as np
import pytest

from rdstitch.camera import Camera
from rdstitch.compositing import CompositeOptions, compose, plan_canvas
from tests.compositing_scenes import as_image, place_images

SIZE = (300, 200)
SHIFT = 100  # pixels by which the second image lies further right, or down
LEFT, ALIKE, RIGHT = 60, 128, 200


@pytest.mark.parametrize("swapped", [False, True])
@pytest.mark.parametrize("place", [180, 200, 220])
def test_a_seam_runs_where_two_images_look_alike(place: int, swapped: bool) -> None:
    """Two plain images of unequal grey that look alike in one column of the overlap alone."""
    column = np.arange(SIZE[0] + SHIFT)
    frames = []
    for grey, start in ((LEFT, 0), (RIGHT, SHIFT)):
        row = np.where(np.abs(column - place) <= 4, ALIKE, grey)[start : start + SIZE[0]].astype(np.uint8)
        frames.append(np.tile(row[None, :, None], (SIZE[1], 1, 3)))
    lens = Camera(SIZE)
    move = np.eye(3)
    move[0, 2] = SHIFT / lens.scale
    homographies = np.stack([np.eye(3), move])
    if swapped:  # whichever is added last
        frames, homographies = frames[::-1], homographies[::-1]
    canvas = plan_canvas([lens, lens], homographies)
    options = CompositeOptions(exposure="none", seam="graphcut", blend="none")
    found = compose(
        place_images([partial(as_image, frame) for frame in frames], [lens, lens], homographies), canvas, options
    )
    assert canvas.size == (SIZE[0] + SHIFT, SIZE[1])
    assert (found.pixels[:, : place - 6] == LEFT).all()
    assert (found.pixels[:, place + 7 :] == RIGHT).all()


def test_a_seam_avoids_fine_detail_that_is_off_by_a_pixel() -> None:
    """Grain that is the same in both images in a winding path alone; it is even grey in small ones."""
    rng, (width, height, shift) = np.random.default_rng(2), (1200, 900, 400)
    grain = np.repeat(rng.integers(88, 168, (height, width + shift, 1)), 3, axis=2).astype(np.uint8)
    column = np.arange(width + shift)[None, :]
    path = 800 + 60 * np.sin(np.arange(height) / 120)[:, None]
    off = np.where((np.abs(column - path) < 30)[..., None], grain, np.roll(grain, 1, axis=1))
    frames, lens, move = [grain[:, :width], off[:, shift:]], Camera((width, height)), np.eye(3)
    move[0, 2] = shift / lens.scale
    homographies = np.stack([np.eye(3), move])
    canvas = plan_canvas([lens, lens], homographies)
    images = place_images([partial(as_image, frame) for frame in frames], [lens, lens], homographies)
    found = compose(images, canvas, CompositeOptions(exposure="none", blend="none")).pixels
    left, right = column < path - 30, column > path + 30
    assert (found == grain).all(axis=-1)[left].mean() > 0.99
    assert (found == off).all(axis=-1)[right].mean() > 0.99
