"""Refinement of pairs: what the priors add, which steps are possible, and that it comes to the truth."""

import numpy as np
import pytest

from rdstitch.camera import Camera
from rdstitch.planar_motion import PlanarMotion
from rdstitch.radial_homography import transfer
from rdstitch.robust.measurements import Measurements
from rdstitch.robust.pair_models import HomographyPairModel, PairModel, PlanarPairModel
from rdstitch.robust.refinement import Fits, PairProblems, refine_pairs

LENS = Camera((640, 480))
FOCAL = 1.3
K = np.diag([FOCAL, FOCAL, 1.0])
H = K @ PlanarMotion((0.1, -0.05), 0.3, (0.2, -0.1)).homography() @ np.linalg.inv(K)
DISTORTION = -0.2


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
    model = PlanarPairModel(FOCAL, 0.2)
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


@pytest.mark.parametrize("model", [HomographyPairModel(), PlanarPairModel(FOCAL), PlanarPairModel(1.25, 0.1)], ids=repr)
@pytest.mark.parametrize("fixed", [False, True])
def test_it_comes_to_the_truth(model: PairModel, fixed: bool) -> None:
    shift = np.eye(3)
    shift[0, 2] = 0.01
    near = shift @ H
    start = Fits(model.initialize(near[None]), near[None], np.array([DISTORTION if fixed else -0.15]))
    problems = _problems(model, noise=0.05, fixed=fixed)
    found, equations = refine_pairs(problems, start, 30)
    assert found.distortion == pytest.approx(DISTORTION, abs=1e-4)
    seen, shares = problems.inspect(found.parameters)
    np.testing.assert_array_equal(seen.errors, equations.errors)
    np.testing.assert_array_equal(seen.information, equations.information)
    assert seen.errors[0, :80].max() < 0.02
    assert np.isinf(seen.errors[0, 80:]).all()
    assert shares.shape == (1, problems.data.present.shape[1], seen.information.shape[1])
    assert seen.cost == pytest.approx(problems.normal_equations(found.parameters).cost)
