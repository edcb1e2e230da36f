"""What is unique in a repeated pattern says where its images lie; nothing else does."""

import numpy as np
import pytest

from rdstitch.camera import Camera
from rdstitch.synthetic.textures import ground
from rdstitch.verification.photometric_agreement import ComparedImage
from rdstitch.verification.self_similarity import draw, drawing_scale
from rdstitch.verification.unique_places import COARSEST, departures, unique_shifts

SIZE = (256, 192)
LENS = Camera(SIZE)
PERIOD = (50, 40)
TILES = np.tile(ground((50, 40), seed=5, channels=1).region(0, 0, 50, 40)[:, :, 0], (20, 20)).astype(np.float32)
NOTHING = np.zeros((0, 2), dtype=int)
TWO = np.array([[243, 171], [270, 232]])  # (x, y) of stains, in the overlap of both images


def _image(stains: np.ndarray, left: int, top: int, put: tuple[int, int] = (0, 0), seed: int = 0) -> ComparedImage:
    """A view of stained tiles, with noise of its own, put elsewhere on the plane by so many pixels."""
    plane = TILES.copy()
    for x, y in stains:
        plane[y - 3 : y + 4, x - 3 : x + 4] = 0.05
    clean = plane[top : top + SIZE[1], left : left + SIZE[0]]
    seen = clean + np.random.default_rng(seed).normal(0.0, 0.005, clean.shape)
    matrix = np.eye(3)
    matrix[:2, 2] = (np.array([left, top]) + put) / LENS.scale
    return ComparedImage(seen.astype(np.float32), LENS, matrix)


def _pixels(image: ComparedImage) -> np.ndarray:
    return draw(image, drawing_scale(image.camera, image.homography, SIZE[0]), SIZE[0], COARSEST).pixels


def test_only_what_is_unique_departs_from_the_pattern() -> None:
    found = departures(_pixels(_image(TWO, 150, 100)))
    for x, y in TWO - (150, 100):
        assert found[y, x] < -10.0
    clean = np.abs(np.nan_to_num(found))
    for x, y in TWO - (150, 100):
        clean[y - 12 : y + 13, x - 12 : x + 13] = 0.0  # and what its brightness takes with it
    assert clean.max() < 5.0


def test_ground_without_a_pattern_has_none() -> None:
    plane = ground(SIZE, seed=5, channels=1).region(0, 0, *SIZE)[:, :, 0].astype(np.float32)
    assert departures(_pixels(ComparedImage(plane, LENS, np.eye(3)))) is None


@pytest.mark.parametrize("periods", [(0, 0), (1, 0), (-1, 1)])
def test_stains_say_by_how_many_periods_an_image_is_off(periods: tuple[int, int]) -> None:
    put = periods[0] * PERIOD[0], periods[1] * PERIOD[1]
    placed = {0: _image(TWO, 150, 100, put), 4: _image(TWO, 213, 128, seed=1)}
    found = unique_shifts(placed, [(0, 4)])[0, 4]
    assert found.shift * LENS.scale == pytest.approx([-put[0], -put[1]], abs=1.0)
    assert found.share > 0.9
    assert found.rival < found.matched / 3.0


def test_one_stain_is_enough_and_none_is_not() -> None:
    for stains, count in ((TWO[:1], 1), (NOTHING, 0)):
        placed = {0: _image(stains, 150, 100, (50, 0)), 1: _image(stains, 213, 128, seed=1)}
        assert len(unique_shifts(placed, [(0, 1)])) == count


def test_stains_that_only_one_image_shows_decide_nothing() -> None:
    placed = {0: _image(TWO[:1], 150, 100), 1: _image(TWO[1:], 213, 128, seed=1)}
    assert not unique_shifts(placed, [(0, 1)])


def test_dust_on_the_lens_is_no_evidence() -> None:
    dust = np.array([[90, 70], [133, 111]])
    placed = {k: _image(dust + corner, *corner, seed=k) for k, corner in enumerate(((150, 100), (200, 140)))}
    assert not unique_shifts(placed, [(0, 1)])
