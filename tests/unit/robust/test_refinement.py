"""Refined pairs: models, parameters and their covariance."""

import math

import numpy as np
import pytest

from rdstitch.arrays import FloatArray
from rdstitch.geometry.camera import Camera
from rdstitch.geometry.planar_motion import PlanarMotion
from rdstitch.geometry.radial_homography import transfer
from rdstitch.numerics.robust_loss import robust_cost
from rdstitch.robust.covariance import covariances
from rdstitch.robust.measurements import Measurements
from rdstitch.robust.pair_models import HomographyPairModel, PairModel, PlanarPairModel
from rdstitch.robust.priors import Prior, focal_prior
from rdstitch.robust.refinement import PairProblems, descend

LENS = Camera((640, 480))
FOCAL = 1.3
K = np.diag([FOCAL, FOCAL, 1.0])
H = K @ PlanarMotion((0.1, -0.05), 0.3, (0.2, -0.1)).homography() @ np.linalg.inv(K)
DISTORTION = -0.2


def log_focal(focal: float, std: float) -> Prior:
    return focal_prior(math.log(focal), std, "option")


def _data() -> Measurements:
    points = np.random.default_rng(0).uniform((0.0, 0.0), (639.0, 479.0), (80, 2))
    moved = LENS.denormalize(transfer(H, DISTORTION, LENS.normalize(points)))
    return Measurements.from_pixels(points, moved, LENS, LENS)


def _problems(
    model: PairModel, *, noise: float = 0.5, fixed: bool = False, data: Measurements | None = None
) -> PairProblems:
    return PairProblems(model, data or _data(), np.array([3.0]), np.array([noise]), fixed)


@pytest.mark.parametrize("fixed", [False, True])
def test_without_matches_only_the_prior_counts(fixed: bool) -> None:
    """``noise² (log focal correction / std)²``, with half its gradient and curvature; nothing on λ."""
    data = _data()
    nothing = data.only(np.zeros_like(data.present))
    model = PlanarPairModel(FOCAL, log_focal(FOCAL, 0.2))
    state = model.retract(model.initialize(H[None]), np.array([[0.0, 0.0, 0.0, 0.0, 0.0, 0.1]]))
    problems = _problems(model, fixed=fixed, data=nothing)
    found = problems.normal_equations(np.column_stack([[DISTORTION], state]))
    free = 6 if fixed else 7
    assert found.cost == pytest.approx(0.25 * 0.25)
    np.testing.assert_allclose(found.gradient[0], np.eye(free)[-1] * 0.25 * 0.1 / 0.04, atol=1e-15)
    np.testing.assert_allclose(found.information[0], np.outer(np.eye(free)[-1], np.eye(free)[-1]) * 0.25 / 0.04)


def test_a_fixed_lens_is_no_parameter() -> None:
    model = HomographyPairModel()
    parameters = np.column_stack([[DISTORTION], model.initialize(H[None])])
    free, fixed = (_problems(model, fixed=fixed).normal_equations(parameters) for fixed in (False, True))
    np.testing.assert_allclose(free.information[0, 1:, 1:], fixed.information[0])
    np.testing.assert_allclose(free.gradient[0, 1:], fixed.gradient[0], atol=1e-9)
    assert free.cost == pytest.approx(fixed.cost)


def test_steps_that_no_lens_allows_are_not_possible() -> None:
    model = HomographyPairModel()
    start = np.column_stack([np.full(4, DISTORTION), np.repeat(model.initialize(H[None]), 4, axis=0)])
    steps = np.zeros((4, 9))
    steps[:, 0] = [-0.7, -0.79, 1.17, 1.19]
    moved, possible = _problems(model).retract(start, steps)
    assert possible.tolist() == [True, False, True, False]
    np.testing.assert_allclose(moved[:, 0], [-0.9, DISTORTION, 0.97, DISTORTION])
    broken, possible = _problems(model).retract(start[:1], np.full((1, 9), np.nan))
    assert not possible.any()
    np.testing.assert_array_equal(broken, start[:1])


@pytest.mark.parametrize(
    "model",
    [HomographyPairModel(), PlanarPairModel(FOCAL), PlanarPairModel(1.25, log_focal(1.25, 0.1))],
    ids=["homography", "focal known", "focal free"],
)
@pytest.mark.parametrize("fixed", [False, True])
def test_it_comes_to_the_truth(model: PairModel, fixed: bool) -> None:
    shift = np.eye(3)
    shift[0, 2] = 0.01
    near = shift @ H
    problems = _problems(model, noise=0.02, fixed=fixed)
    start = np.array([DISTORTION if fixed else -0.15])
    found, equations = descend(problems, problems.start(near[None], start), 30)
    assert found[0, 0] == pytest.approx(DISTORTION, abs=1e-4)
    seen = problems.normal_equations(found)
    np.testing.assert_array_equal(seen.errors, equations.errors)
    np.testing.assert_array_equal(seen.information, equations.information)
    assert seen.errors[0, :80].max() < 0.02
    assert np.isinf(seen.errors[0, 80:]).all()
    assert problems.covariances(found, seen).shape == seen.information.shape


CAMERA = Camera((600, 800))  # half a diagonal of 500 pixels: cells of 100


def _in_cells(cells: list[tuple[int, int]], each: int = 3) -> Measurements:
    """So many points in each cell of 100 pixels around the centre."""
    middle = np.repeat(np.asarray(cells, dtype=np.float64) + 0.5, each, axis=0)
    jitter = np.random.default_rng(0).uniform(-0.45, 0.45, middle.shape)
    points = 100.0 * (middle + jitter) + CAMERA.center
    return Measurements.from_pixels(points, points, CAMERA, CAMERA)


CELLS = [(0, 0), (-1, 0), (1, 2), (-3, -4), (2, -1), (-2, 3)]
DATA = _in_cells(CELLS)
A = np.array([[4.0, 1.0, 0.0], [1.0, 3.0, 0.5], [0.0, 0.5, 2.0]])


def _influence(size: float) -> FloatArray:
    found = np.zeros((1, DATA.present.shape[1], 3))
    found[0, :18] = size * np.random.default_rng(1).normal(size=(18, 3))
    return found


def _covariances(information: FloatArray, influence: FloatArray, noise: FloatArray, data: Measurements) -> FloatArray:
    return covariances(information, influence, np.tile(np.eye(3), (len(noise), 1, 1)), noise, data)


def _clustered(influence: FloatArray) -> FloatArray:
    sums = influence[0, :18].reshape(6, 3, 3).sum(axis=1)
    inverse = np.linalg.inv(A)
    return np.asarray(inverse @ (sums.T @ sums) @ inverse)


@pytest.mark.parametrize("size", [0.3, 1.0])
def test_no_direction_has_less_than_either(size: float) -> None:
    influence = _influence(size)
    found = _covariances(A[None], influence, np.array([1.0]), DATA)[0]
    for least in (np.linalg.inv(A), _clustered(influence)):
        assert np.linalg.eigvalsh(found - least).min() > -1e-9
    assert np.linalg.eigvalsh(found - np.linalg.inv(A) - _clustered(influence)).max() < 1e-9


def test_independent_errors_give_the_inverse_information_and_those_that_agree_in_cells_the_sandwich() -> None:
    """Pairs do not mix."""
    both = DATA.take(np.array([0, 0]))
    influence = np.concatenate([_influence(100.0), _influence(1e-6)])
    found = _covariances(np.stack([A, A]), influence, np.array([0.5, 0.5]), both)
    np.testing.assert_allclose(found[0], _clustered(influence[:1]), rtol=1e-6)
    np.testing.assert_allclose(found[1], 0.25 * np.linalg.inv(A), rtol=1e-6)


def test_what_is_not_determined_is_infinite() -> None:
    singular = np.diag([1.0, 1.0, 0.0])
    redundant = np.array([[1.0, 1.0, 0.0], [1.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
    broken = np.full((3, 3), np.nan)
    data = DATA.take(np.zeros(4, dtype=np.intp))
    found = _covariances(np.stack([singular, redundant, broken, A]), np.zeros((4, 20, 3)), np.ones(4), data)
    assert np.isinf(found[:3]).all()
    np.testing.assert_allclose(found[3], np.linalg.inv(A), rtol=1e-9)


def test_all_that_is_far_out_is_one_cell() -> None:
    """Beyond 32 cells from the centre, as a damaged camera file may put it."""
    far = _in_cells([(40, 0), (60, 0)])
    influence = np.zeros((1, far.present.shape[1], 3))
    influence[0, :6] = 10.0 * np.random.default_rng(2).normal(size=(6, 3))
    total = influence[0].sum(axis=0)
    found = _covariances(A[None], influence, np.array([1e-6]), far)[0]
    inverse = np.linalg.inv(A)
    np.testing.assert_allclose(found, inverse @ np.outer(total, total) @ inverse, rtol=1e-5, atol=1e-9)


def test_without_matches_only_the_priors_of_the_lens_count() -> None:
    """λ of both images, μ and the centre, in their standard deviations, in units of the noise."""
    points = np.random.default_rng(0).uniform((0, 0), (639, 479), (30, 2))
    data = Measurements.from_pixels(points, points, LENS, LENS)
    none = data.only(np.zeros_like(data.present))
    lens, std = np.array([-0.3, -0.2, 0.05, 0.01, -0.02]), np.array([0.5, 0.5, 0.1, 0.03, 0.03])
    priors = tuple(Prior(((1.0, 0.0, each),)) for each in std.tolist())
    problems = PairProblems(HomographyPairModel(), none, np.array([3.0]), np.array([0.5]), lens=priors)
    found = problems.normal_equations(np.concatenate([lens, np.eye(3).ravel() / np.sqrt(3.0)])[None])
    assert found.cost == pytest.approx(0.25 * np.square(lens / std).sum())
    np.testing.assert_allclose(found.gradient[0, :5], 0.25 * lens / std**2)
    np.testing.assert_allclose(found.information[0, :5, :5], 0.25 * np.diag(std**-2.0))


def test_priors_weigh_by_the_noise_that_they_are_compared_at() -> None:
    """A step changes the noise: what the prior cost before is compared with what it costs after by the same noise."""
    model = PlanarPairModel(FOCAL, log_focal(FOCAL, 1e-4))
    problems = PairProblems(model, _data(), np.array([3.0]), None, False)
    start = model.initialize(H[None])
    near, far = (
        problems.normal_equations(np.column_stack([[DISTORTION + off], model.retract(start, np.array([step]))]))
        for off, step in ((0.001, [0.0, 0.0, 0.0, 0.0, 0.0, 1e-4]), (0.003, [5e-4, 0.0, 0.0, 0.0, 0.0, 1e-4]))
    )
    assert near.noise[0] != pytest.approx(far.noise[0], rel=0.2)
    np.testing.assert_allclose(near.prior, far.prior)
    width = robust_cost(near.squared, far.scale[:, None]).sum(axis=1)
    np.testing.assert_allclose(problems.cost(near, far), width + far.noise**2 * near.prior)
