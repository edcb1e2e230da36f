"""Whether the shape of the whole is known: what bends every overlap alike is seen, and nothing where nothing is."""

from dataclasses import replace

import numpy as np
import pytest

from examples.worlds.alignment_scenes import Scene, aligned, grid, scene
from rdstitch.alignment.motion_models import X
from rdstitch.arrays import FloatArray
from rdstitch.geometry.camera import Camera


def _row(count: int = 6, **options: object) -> Scene:
    rng = np.random.default_rng(3)
    poses = grid(count, 1, (0.45, 0.0), 0.1, rng)
    return scene(poses, rng=rng, reach=1, overlap=0.1, outliers=0.0, noise=0.2, **options)  # type: ignore[arg-type]


def _sheared(row: Scene, amount: float) -> Scene:
    """The rows of the images read one after another, while the camera moves across them."""

    def shear(points: FloatArray) -> FloatArray:
        moved: FloatArray = points + amount * (points[:, 1:] - row.cameras[0].center[1]) * np.array([0.0, 1.0])
        return moved

    links = [replace(link, points1=shear(link.points1), points2=shear(link.points2)) for link in row.links]
    return replace(row, links=links)


def test_a_plain_row_is_not_doubted() -> None:
    found = aligned(_row()).shape
    assert not found.doubtful
    assert not found.shown
    assert np.hypot(found.shift, found.shift_std) < 2.0


def test_a_rolling_shutter_is_shown_and_named() -> None:
    found = aligned(_sheared(_row(), 0.1), lens="division").shape
    assert found.doubtful
    assert found.shown


@pytest.mark.parametrize("seed", [1, 6, 7])
def test_images_cropped_each_elsewhere_are_doubted(seed: int) -> None:
    """None of the effects that are tried, but some of them grow with it."""
    rng = np.random.default_rng(seed)
    row = scene(grid(5, 1, (0.45, 0.0), 0.1, rng), rng=rng, reach=1, overlap=0.1, outliers=0.0, noise=0.2)
    corner = rng.uniform(-40.0, 40.0, (len(row.cameras), 2))
    links = [
        replace(link, points1=link.points1 - corner[link.image1], points2=link.points2 - corner[link.image2])
        for link in row.links
    ]
    found = aligned(replace(row, links=links)).shape
    assert found.doubtful
    assert found.shown


def test_an_off_center_lens_is_found_in_three_images_or_shown() -> None:
    size = (640, 480)
    lens = Camera(size, distortion=-0.25, center=(319.5 + 48.0, 239.5 + 30.0))
    row = _row(4, lens=lens)
    freed = aligned(row)
    assert np.abs(np.array(freed.cameras[0].center) - lens.center).max() < 8.0
    assert not freed.shape.doubtful
    held = aligned(row, lens="division").shape
    assert held.shown
    assert "axis is off the middle" in held.cause


def test_what_the_images_cannot_exclude_is_said() -> None:
    """Of a long row with few matches nobody knows whether it is bent."""
    rng = np.random.default_rng(3)
    poses = grid(14, 1, (0.85, 0.0), 0.02, rng)
    row = scene(poses, rng=rng, reach=1, overlap=0.05, outliers=0.0, noise=0.6, per_link=30)
    assert poses[:, X].std() > 1.0
    found = aligned(row).shape
    assert found.doubtful
    assert not found.shown
    assert found.image in (0, 13)
