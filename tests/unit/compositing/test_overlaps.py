"""What exposure is estimated from grows with the number of images, not with its square."""

from functools import partial
from itertools import combinations

import numpy as np
import pytest

from rdstitch.camera import Camera
from rdstitch.compositing import gain_compensation, overlap_cells, plan_canvas
from rdstitch.compositing.boxes import intersection, overlapping_pairs
from rdstitch.compositing.overlap_cells import compare_overlaps
from rdstitch.compositing.placed_image import PlacedImage
from rdstitch.compositing.source_images import ImageReader
from rdstitch.compositing.survey import Survey, survey_images
from tests.compositing_scenes import as_image, place_images


@pytest.mark.parametrize("shape", [(300, 80), (80, 300)])
def test_all_pairs_of_boxes_with_pixels_in_common(shape: tuple[int, int]) -> None:
    rng = np.random.default_rng(3)
    corners = rng.integers(0, shape, (60, 2))
    boxes = [None if k % 9 == 4 else (int(x), int(y), int(x) + 30, int(y) + 20) for k, (x, y) in enumerate(corners)]
    expected = sorted(
        (j, i)
        for (i, a), (j, b) in combinations(enumerate(boxes), 2)
        if a is not None and b is not None and intersection(a, b) is not None
    )
    assert [tuple(pair) for pair in overlapping_pairs(boxes, most=60).tolist()] == expected
    assert len(overlapping_pairs([None, boxes[0]])) == len(overlapping_pairs([])) == 0


def test_of_images_in_two_places_each_keeps_few_neighbours_and_the_places_stay_connected() -> None:
    stacks = [(x + k % 3, k // 3, x + k % 3 + 100, k // 3 + 100) for x in (0, 96) for k in range(60)]
    pairs = overlapping_pairs(stacks, most=5)
    assert len(pairs) <= 120 * 5 + 119
    assert ((pairs[:, 0] >= 60) & (pairs[:, 1] < 60)).any()


def _row(count: int) -> tuple[Survey, list[PlacedImage]]:
    """Tiny images side by side, each half over the next, and by turns darker and brighter."""
    lens = Camera((32, 24), distortion=0.0, focal=32.0)
    frames = [np.full((24, 32, 3), 100 + 20 * (k % 2), dtype=np.uint8) for k in range(count)]
    step = 16 / lens.scale
    places = np.array([[[1, 0, k * step], [0, 1, 0], [0, 0, 1]] for k in range(count)], dtype=np.float64)
    cameras = [lens] * count
    images = place_images([partial(as_image, frame) for frame in frames], cameras, places)
    return survey_images(ImageReader(images), images, plan_canvas(cameras, places)), images


def test_what_is_compared_is_linear_in_the_number_of_images() -> None:
    """Two neighbours an image in a row."""
    count = 200
    survey, images = _row(count)
    cells = compare_overlaps(survey)
    assert cells.overlap.nnz == 2 * (count - 1)
    exposure = gain_compensation.estimate_exposure(survey, images)
    means = np.exp(exposure.log_gain + exposure.fields.mean(axis=(1, 2))).mean(axis=1)
    assert (means[1::2] > means[::2]).all()


def test_gains_of_thousands_of_overlaps_take_a_few_cells_of_each(monkeypatch: pytest.MonkeyPatch) -> None:
    survey, images = _row(60)
    of_all = gain_compensation.estimate_exposure(survey, images, "gain").log_gain
    monkeypatch.setattr(overlap_cells, "_MAX_CELLS", 600)
    cells = compare_overlaps(survey)
    assert 59 <= len(cells.pair) <= 600
    np.testing.assert_allclose(gain_compensation.estimate_exposure(survey, images, "gain").log_gain, of_all, atol=1e-3)
