"""Whether two images would fit elsewhere as well."""

import math

import numpy as np
import pytest

from rdstitch.camera import Camera
from rdstitch.synthetic.textures import ground
from rdstitch.verification.photometric_agreement import ComparedImage
from rdstitch.verification.self_similarity import Ambiguity, draw, drawing_scale, placement_ambiguity

SIZE = (256, 192)
LENS = Camera(SIZE)
PLANE = ground((700, 600), seed=5, channels=1).region(0, 0, 700, 600)[:, :, 0]


def _placed(
    plane: np.ndarray, left: int, top: int, *, put: tuple[float, float] = (0.0, 0.0), scale: float = 1.0
) -> ComparedImage:
    matrix = np.diag([scale, scale, 1.0])
    matrix[:2, 2] = scale * (np.array([left, top]) + put) / LENS.scale
    return ComparedImage(np.ascontiguousarray(plane[top : top + 192, left : left + 256], np.float32), LENS, matrix)


def _ambiguity(first: ComparedImage, second: ComparedImage) -> Ambiguity:
    scale = drawing_scale(second.camera, second.homography)
    return placement_ambiguity(draw(first, scale), draw(second, scale))


def test_ground_fits_where_it_is_and_nowhere_else() -> None:
    found = _ambiguity(_placed(PLANE, 100, 100), _placed(PLANE, 180, 140))
    assert found.here > 0.9
    assert found.elsewhere < 0.45
    assert not found.ambiguous


@pytest.mark.parametrize("scale", [0.01, 1.0, 300.0])
def test_a_repeated_pattern_fits_a_period_away(scale: float) -> None:
    tiles = np.tile(PLANE[:40, :50], (15, 14))
    found = _ambiguity(_placed(tiles, 100, 100, scale=scale), _placed(tiles, 163, 128, scale=scale))
    assert found.here > 0.9
    assert found.elsewhere > 0.9
    assert found.ambiguous
    periods = [math.hypot(50 * i, 40 * j) / 256 for i in range(-2, 3) for j in range(-2, 3)]
    assert min(abs(found.shift - period) for period in periods) < 0.006


def test_a_registration_may_be_off_by_three_pixels() -> None:
    for off, here in ((2.5, True), (6.0, False)):
        found = _ambiguity(_placed(PLANE, 100, 100, put=(off, 0.0)), _placed(PLANE, 180, 140))
        assert (found.here > 0.8) is here
        assert (found.here < 0.6) is not here


def test_a_wrong_place_is_ambiguous() -> None:
    found = _ambiguity(_placed(PLANE, 100, 100, put=(25.0, 0.0)), _placed(PLANE, 150, 120))
    assert found.ambiguous
    assert found.shift == pytest.approx(25.0 / 256, abs=0.006)


def test_images_that_do_not_touch_say_nothing() -> None:
    assert _ambiguity(_placed(PLANE, 0, 0), _placed(PLANE, 400, 300)) == Ambiguity(0.0, 0.0, 0.0)
    behind = ComparedImage(np.zeros((192, 256), np.float32), LENS, np.diag([1.0, 1.0, -1.0]))
    drawn = draw(behind, 100.0)
    assert drawn.pixels.shape == (1, 1)
    assert np.isnan(drawn.pixels).all()


def test_brightness_does_not_matter() -> None:
    lit = PLANE + np.linspace(0.0, 1.0, 700, dtype=np.float32) ** 2
    found = _ambiguity(_placed(PLANE, 100, 100), _placed(lit, 180, 140))
    assert found.here > 0.9
    assert not found.ambiguous


@pytest.mark.parametrize(
    ("here", "elsewhere", "ambiguous"),
    [(0.9, 0.82, True), (0.9, 0.80, False), (0.3, 0.51, True), (0.3, 0.49, False), (0.0, 0.0, False)],
)
def test_as_good_is_nine_tenths_and_alike(here: float, elsewhere: float, ambiguous: bool) -> None:
    assert Ambiguity(here, elsewhere, 0.2).ambiguous is ambiguous
