"""What stays at its place in all pictures: found where it is, and nowhere else."""

import numpy as np
import pytest
from numpy.typing import NDArray

from rdstitch.compositing.static_pixels import static_pixels
from rdstitch.synthetic import ground

_WIDTH, _HEIGHT, _COUNT = 200, 150, 5


def _pictures() -> NDArray[np.float32]:
    """Pictures (5, h, w) of a plane, each of another place."""
    texture = ground((_WIDTH + 400, _HEIGHT), 3)
    places = [texture.region(90 * k, 0, 90 * k + _WIDTH, _HEIGHT)[:, :, 0] for k in range(_COUNT)]
    noise = np.random.default_rng(1).normal(0.0, 0.01, (_COUNT, _HEIGHT, _WIDTH))
    return np.clip(np.stack(places) + noise, 0.05, 1.0).astype(np.float32)


def test_nothing_stays_where_the_camera_moves() -> None:
    assert static_pixels(list(_pictures())) is None


def test_a_line_along_the_motion_is_not_static() -> None:
    pictures = _pictures()
    pictures[:, 60:64] = 1.0
    pictures[:, 90:110] *= 0.4
    assert static_pixels(list(pictures)) is None


@pytest.mark.parametrize("shape", ["body", "border"])
def test_a_body_and_a_black_border_are_found(shape: str) -> None:
    pictures = _pictures()
    region = np.zeros((_HEIGHT, _WIDTH), dtype=np.bool_)
    if shape == "body":
        region[100:, 60:] = True
        body = ground((_WIDTH, _HEIGHT), 9).region(0, 0, _WIDTH, _HEIGHT)[:, :, 0]
        pictures = np.where(region, body, pictures)
    else:
        v, u = np.ogrid[:_HEIGHT, :_WIDTH]
        region = np.hypot(u - 100, v - 75) > 85
        pictures[:, region] = 0.0
    found = static_pixels(list((pictures * 255).astype(np.uint8)))
    assert found is not None
    assert found[region].mean() > 0.95
    assert found[~region].mean() < 0.06


def test_a_camera_that_hardly_moves_masks_nothing() -> None:
    assert static_pixels([_pictures()[0]] * 5) is None
