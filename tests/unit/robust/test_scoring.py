"""What the matches of a pair are worth: measurements, scores, and the verification of a model."""

import numpy as np
import pytest
from scipy.stats import binom

from rdstitch.arrays import FloatArray
from rdstitch.errors import ArgumentError
from rdstitch.geometry.camera import Camera
from rdstitch.geometry.radial_homography import transfer
from rdstitch.robust import estimate_radial_homography
from rdstitch.robust.chance import MIN_OCCUPIED_CELLS, binomial_tail, occupied_cells, rejection_reason
from rdstitch.robust.measurements import Measurements, checked_matches, padded_length
from rdstitch.robust.scoring import plausible, transfer_errors2, truncated_costs
from rdstitch.solvers.solutions import Solutions

SMALL, LARGE = Camera((300, 400)), Camera((600, 800))


def _two_pairs() -> Measurements:
    rng = np.random.default_rng(0)
    points = [(rng.uniform(0, 299, (n, 2)), rng.uniform(0, 299, (n, 2))) for n in (20, 9)]
    return Measurements.of_pairs(points, [(SMALL, LARGE), (LARGE, SMALL)])


def test_points_are_in_half_diagonals_of_their_own_image() -> None:
    data = _two_pairs()
    assert data.x1.shape == (2, 2, padded_length(20))
    assert data.count.tolist() == [20, 9]
    assert data.present.sum(axis=1).tolist() == [20, 9]
    assert data.present[1, :9].all()
    assert data.px.tolist() == [500.0, 250.0]
    assert data.px_ratio.tolist() == [2.0, 0.5]
    one = Measurements.from_pixels([[149.5, 199.5]], [[299.5 + 500.0, 399.5]], SMALL, LARGE)
    assert (one.x1[0, :, 0].tolist(), one.x2[0, :, 0].tolist()) == ([0.0, 0.0], [1.0, 0.0])
    np.testing.assert_allclose(data.radius2, (data.x1**2).sum(axis=1))


def test_matches_that_are_left_out_stay_out() -> None:
    data = _two_pairs()
    few = data.only(np.arange(data.present.shape[1])[None] < np.array([[5], [30]]))
    assert few.present.sum(axis=1).tolist() == [5, 9]
    # What was left out before is not let in again.
    assert few.only(np.ones_like(few.present)).present.sum(axis=1).tolist() == [5, 9]


@pytest.mark.parametrize(
    ("points1", "points2", "says"),
    [
        (np.zeros((3, 3)), np.zeros((3, 2)), "points1 must have shape"),
        (np.zeros((3, 2)), np.zeros(6), "points2 must have shape"),
        (np.zeros((3, 2)), np.full((3, 2), np.nan), "points2 has values that are not finite"),
        (np.zeros((3, 2)), np.full((3, 2), 1e200), "points2 has values that are no pixels: 1e"),
        (np.zeros((3, 2)), np.zeros((4, 2)), "differ in length: 3 and 4"),
    ],
)
def test_wrong_matches_are_refused(points1: np.ndarray, points2: np.ndarray, says: str) -> None:
    with pytest.raises(ArgumentError, match=says):
        checked_matches(points1, points2)


SIZES = (640, 480), (320, 240)
CAMERAS = Camera(SIZES[0]), Camera(SIZES[1])
POINTS = np.random.default_rng(0).uniform((0.0, 0.0), (639.0, 479.0), (40, 2))
H = np.array([[1.05, 0.1, 0.05], [-0.08, 0.97, -0.1], [0.03, -0.06, 1.0]])


def _measurements() -> Measurements:
    points2 = CAMERAS[1].denormalize(transfer(H, -0.2, CAMERAS[0].normalize(POINTS)))
    return Measurements.from_pixels(POINTS, points2 + np.array([0.3, -0.4]), *CAMERAS)


def test_errors_are_pixels_of_the_second_image() -> None:
    data = _measurements()
    pair = np.zeros(2, dtype=np.intp)
    errors = transfer_errors2(np.stack([H, 3.0 * H]), np.array([-0.2, -0.2]), pair, data)
    np.testing.assert_allclose(errors[:, :40], 0.25, rtol=1e-9)


def test_there_is_no_error_behind_the_camera_nor_beyond_the_lens() -> None:
    data = _measurements()
    pair = np.zeros(2, dtype=np.intp)
    behind, beyond = transfer_errors2(np.stack([-H, 4.0 * np.diag([1.0, 1.0, 0.25])]), np.array([0.0, 0.9]), pair, data)
    assert np.isinf(behind[:40]).all()
    # 1 - 4 λ r² is negative far from the centre, r four times the undistorted radius in image 1.
    far = np.linalg.norm(4.0 * data.x1[0, :, :40], axis=0) / (1.0 + 0.9 * data.radius2[0, :40])
    np.testing.assert_array_equal(np.isinf(beyond[:40]), 1.0 - 3.6 * far**2 < 0.0)
    assert 0 < np.isinf(beyond[:40]).sum() < 40


def test_padding_costs_nothing() -> None:
    data = _measurements()
    assert data.present.shape[1] > 40 or data.present.all()
    half = data.only(np.arange(data.present.shape[1])[None] < 20)
    exact = truncated_costs(H[None], np.array([-0.2]), np.zeros(1, dtype=np.intp), half, 1.0)
    assert exact == pytest.approx(0.25 * 20 / 40, rel=1e-9)


@pytest.mark.parametrize(
    ("matrix", "distortion", "possible"),
    [
        (np.eye(3), 0.0, True),
        (np.eye(3), -0.99, True),
        (np.eye(3), -1.01, False),  # folds at the corner
        (np.eye(3), 1.01, False),  # the undistorted radius stops growing
        (np.diag([1.0, -1.0, 1.0]), 0.0, False),  # mirrored
        (np.diag([1.0, 1e-4, 1.0]), 0.0, True),
        (np.diag([1.0, 1e-6, 1.0]), 0.0, False),  # a line
        (1e6 * np.eye(3), 0.0, True),  # of any scale
        (np.full((3, 3), np.nan), 0.0, False),
    ],
)
def test_images_of_a_plane_are_possible(matrix: np.ndarray, distortion: float, possible: bool) -> None:
    found = Solutions(np.zeros(1, dtype=np.intp), matrix[None], np.array([distortion]))
    assert plausible(found, corner_radius=1.0).tolist() == [possible]


def test_the_lens_is_judged_at_the_corner() -> None:
    found = Solutions(np.zeros(1, dtype=np.intp), np.eye(3)[None], np.array([-0.5]))
    assert [bool(plausible(found, radius)[0]) for radius in (1.0, 1.4, 1.5)] == [True, True, False]


SIZE = (1000, 800)
CELL = np.hypot(*SIZE) / 32


def _apart(count: int) -> FloatArray:
    """Points in as many different cells."""
    column, row = np.arange(count) % 24, np.arange(count) // 24
    return np.asarray((np.stack([column, row], axis=1) + 0.5) * CELL)


@pytest.mark.parametrize(("matches", "threshold"), [(60, 3.0), (400, 3.0), (400, 30.0)])
def test_chance_is_that_of_a_wrong_match_near_its_place(matches: int, threshold: float) -> None:
    """With ``p = π t² / area + 0.01``; four matches make the model, and agree by construction."""
    p = np.pi * threshold**2 / (SIZE[0] * SIZE[1]) + 0.01
    tail = binom.sf(np.arange(matches - 4) - 1, matches - 4, p)  # of as many or more
    enough = int(np.argmax(tail <= 1e-4)) + 4
    points = _apart(matches)
    for count, reliable in ((enough, True), (enough - 1, False)):
        reason = rejection_reason(points, points, np.arange(matches) < count, (SIZE, SIZE), threshold)
        if count >= MIN_OCCUPIED_CELLS:
            assert (reason is None) is reliable, count


@pytest.mark.parametrize(("trials", "probability"), [(1, 0.3), (50, 0.5), (4000, 0.011)])
def test_chance_of_so_many_or_more(trials: int, probability: float) -> None:
    least = np.unique(np.linspace(-1, trials, 40).astype(int))
    tails = [binomial_tail(int(one), trials, probability) for one in least]
    np.testing.assert_allclose(tails, binom.sf(least - 1, trials, probability), rtol=1e-9, atol=1e-290)


def test_a_wide_threshold_is_taken_for_even_odds_at_most() -> None:
    points = _apart(100)
    wide = 1e4
    enough = int(np.argmax(binom.sf(np.arange(96) - 1, 96, 0.5) <= 1e-4)) + 4
    reasons = [rejection_reason(points, points, np.arange(100) < n, (SIZE, SIZE), wide) for n in (enough - 1, enough)]
    assert [reason is None for reason in reasons] == [False, True]


def test_neighbouring_matches_count_once() -> None:
    def reason(points: FloatArray) -> str | None:
        return rejection_reason(points, points, np.ones(len(points), dtype=np.bool_), (SIZE, SIZE), 3.0)

    points = np.repeat(_apart(MIN_OCCUPIED_CELLS - 1), 50, axis=0)
    assert reason(points) == "350 of 350 matches agree, but they lie in 7 places of the image only"
    assert reason(np.vstack([points, _apart(MIN_OCCUPIED_CELLS)[-1:]])) is None
    # Few that all agree are no chance.
    assert reason(_apart(MIN_OCCUPIED_CELLS)) is None


def test_places_are_those_of_the_image_with_fewer() -> None:
    assert occupied_cells(_apart(30), _apart(30), SIZE, SIZE) == 30
    assert occupied_cells(_apart(30), np.full((30, 2), 7.0), SIZE, SIZE) == 1
    assert occupied_cells(_apart(30)[:0], _apart(30)[:0], SIZE, SIZE) == 0


@pytest.mark.parametrize("small_first", [True, False])
def test_images_of_very_different_sizes_are_registered_either_way(small_first: bool) -> None:
    """The cells of each are those of its own size."""
    sizes = (320, 240), (4000, 3000)
    points = np.random.default_rng(8).uniform((4, 4), (315, 235), (300, 2))
    turned = 11.6 * (points - (160, 120)) @ np.array([[0.998, 0.07], [-0.07, 0.998]]) + (2037, 1475)
    both = (points, turned) if small_first else (turned, points)
    first, second = sizes if small_first else sizes[::-1]
    assert estimate_radial_homography(both[0], both[1], first, image_size2=second)
