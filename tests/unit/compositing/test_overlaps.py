"""What exposure is estimated from grows with the number of pictures, not with its square."""

from functools import partial
from itertools import combinations
from typing import Any

import numpy as np
import pytest
from scipy import sparse
from scipy.sparse.linalg import splu

from rdstitch.camera import Camera
from rdstitch.compositing import brightness, field_solver, gain_compensation, place_pictures, plan_canvas
from rdstitch.compositing.boxes import intersection, overlapping_pairs
from rdstitch.compositing.field_solver import solve_fields
from rdstitch.compositing.placed_picture import PlacedPicture
from rdstitch.compositing.source_images import PictureReader
from rdstitch.compositing.survey import Survey, survey_pictures
from tests.compositing_scenes import as_picture


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


def test_of_pictures_in_two_places_each_keeps_few_neighbours_and_the_places_stay_connected() -> None:
    stacks = [(x + k % 3, k // 3, x + k % 3 + 100, k // 3 + 100) for x in (0, 96) for k in range(60)]
    pairs = overlapping_pairs(stacks, most=5)
    assert len(pairs) <= 120 * 5 + 119
    assert ((pairs[:, 0] >= 60) & (pairs[:, 1] < 60)).any()


def _row(count: int) -> tuple[Survey, list[PlacedPicture]]:
    """Tiny pictures side by side, each half over the next, and by turns darker and brighter."""
    lens = Camera((32, 24), distortion=0.0, focal=32.0)
    frames = [np.full((24, 32, 3), 100 + 20 * (k % 2), dtype=np.uint8) for k in range(count)]
    step = 16 / lens.half_diagonal
    places = np.array([[[1, 0, k * step], [0, 1, 0], [0, 0, 1]] for k in range(count)], dtype=np.float64)
    cameras = [lens] * count
    pictures = place_pictures([partial(as_picture, frame) for frame in frames], cameras, places)
    return survey_pictures(PictureReader(pictures), pictures, plan_canvas(cameras, places)), pictures


def test_what_is_held_is_linear_in_the_number_of_pictures(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two neighbours a picture in a row, and a few entries of factorizations."""
    entries: list[int] = []

    def counted(matrix: Any, **options: Any) -> Any:
        factors = splu(matrix, **options)
        entries.append(factors.nnz)
        return factors

    monkeypatch.setattr(field_solver, "splu", counted)
    count = 400
    survey, pictures = _row(count)
    exposure = brightness.estimate_exposure(survey, pictures)
    cells = brightness._compare(survey, exposure)
    assert cells is not None
    assert cells.overlap.nnz == 2 * (count - 1)
    assert 0 < max(entries) < 10 * count
    means = np.exp(exposure.log_gain + exposure.fields.mean(axis=(1, 2))).mean(axis=1)
    assert (means[1::2] > means[::2]).all()


def test_gains_of_thousands_of_overlaps_take_a_few_samples_of_each(monkeypatch: pytest.MonkeyPatch) -> None:
    survey, pictures = _row(60)
    of_all = gain_compensation.estimate_gains(survey, pictures).log_gain
    monkeypatch.setattr(gain_compensation, "_MAX_SAMPLES", 60)
    samples = gain_compensation._collect(survey, [picture.camera for picture in pictures])
    assert samples is not None
    assert 59 <= len(samples.value1) <= 20 * 59
    np.testing.assert_allclose(gain_compensation.estimate_gains(survey, pictures).log_gain, of_all, atol=1e-3)


def test_fields_are_those_of_a_direct_solution() -> None:
    rng, (count, side, rows) = np.random.default_rng(5), (6, 7, 900)
    parts, nodes = [], side**2
    for sign, shift in ((1.0, 0), (-1.0, 1)):
        matrix = np.zeros((rows, count * nodes))
        picture = np.arange(rows) % (count - 1) + shift
        for _ in range(4):
            matrix[np.arange(rows), picture * nodes + rng.integers(0, nodes, rows)] += 0.25 * sign
        parts.append(matrix)
    weight, values, expected = rng.random(rows) * 1e3, rng.normal(size=(rows, 3)), rng.normal(size=(count * nodes, 3))
    design, prior = parts[0] + parts[1], np.eye(count * nodes) * 0.1
    direct = np.linalg.solve(
        design.T @ (weight[:, None] * design) + prior, design.T @ (weight[:, None] * values) + expected
    )
    first, second = (sparse.csr_array(part) for part in parts)
    start = np.zeros((count, side, side, 3))
    found = solve_fields((first, second), weight, values, (sparse.csr_array(prior), expected), start)
    np.testing.assert_allclose(found.reshape(-1, 3), direct, atol=1e-5 * np.abs(direct).max())
