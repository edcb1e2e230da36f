"""The adjustment: flat observations, derivatives checked numerically, priors, covariance against scatter."""

import numpy as np
import pytest

from examples.worlds.alignment_scenes import Scene, grid_scene
from rdstitch.alignment.least_squares.bundle_adjustment import BundleAdjuster, FreeParameters, Parameters
from rdstitch.alignment.least_squares.link_equations import link_equations, squared_lengths, trial_errors
from rdstitch.alignment.least_squares.normal_equations import SparseNormalEquations, assemble
from rdstitch.alignment.least_squares.observations import Observations
from rdstitch.alignment.least_squares.priors import Priors
from rdstitch.alignment.motion_models import HOMOGRAPHY, MODELS, RIGID, TILTING, MotionModel
from rdstitch.geometry.radial_homography import transfer_jacobian
from rdstitch.numerics.robust_loss import robust_cost, robust_weight, sigma_of

FREE_LENS = np.array([True, True, True, True, True])
ONE_LENS = np.array([True, False, False, False, False])


def _scene() -> Scene:
    return grid_scene(3, 2, (0.4, 0.35), 0.2, wind=(0.1, 0.02), seed=3, tilt=(0.05, -0.04), per_link=60)


def _start(model: MotionModel, truth: Scene) -> Parameters:
    shared = model.shared_from_physical(np.array([0.05, -0.04, np.log(1.3)])) if model.shared_names else np.zeros(0)
    poses = model.nearest_poses(truth.truth, shared, np.zeros((len(truth.truth), 2)))
    return Parameters(poses, shared, np.array([-0.23, 0.01, -0.02, 0.004, -0.006]))


def _dense(normal: SparseNormalEquations, observations: Observations) -> np.ndarray:
    """The whole matrix of the free parameters."""
    (count, size), shared = normal.free.shape, len(normal.shared)
    poses, images = np.zeros((count, count, size, size)), np.arange(count)
    poses[images, images] = normal.poses
    image1, image2 = observations.image1, observations.image2
    joined = np.array([normal.free[k].any() for k in image1]) & np.array([normal.free[k].any() for k in image2])
    poses[image2[joined], image1[joined]] += normal.links
    poses[image1[joined], image2[joined]] += normal.links.swapaxes(1, 2)
    rows, coupling = poses.swapaxes(1, 2).reshape(count * size, -1), normal.coupling.reshape(-1, shared)
    free = np.append(normal.free.ravel(), np.ones(shared, dtype=np.bool_))
    dense: np.ndarray = np.block([[rows, coupling], [coupling.T, normal.shared]])[np.ix_(free, free)]
    return dense


@pytest.mark.parametrize("width", [2.0, 20.0])  # px; the errors at the start are of some twenty
@pytest.mark.parametrize("model", MODELS.values(), ids=MODELS)
def test_gradient_and_curvature_of_the_whole_cost(model: MotionModel, width: float) -> None:
    """Against differences of the robust cost, with the whitening held as the adjustment holds it."""
    truth = _scene()
    observations = Observations.from_links(truth.links, truth.cameras)
    start, count = _start(model, truth), len(truth.cameras)

    def homographies(parameters: Parameters) -> np.ndarray:
        matrices = model.matrices(parameters.poses, parameters.shared).matrices
        return np.asarray(matrices[observations.image2] @ np.linalg.inv(matrices)[observations.image1])

    equations = link_equations(observations, homographies(start), start.lens, width, FREE_LENS)
    free = np.ones((count, model.pose_size), dtype=np.bool_)
    free[0] = False
    matrices = model.matrices(start.poses, start.shared)
    normal = assemble(equations, observations, matrices, homographies(start), free, 2.0)

    def cost(poses_step: np.ndarray, shared_step: np.ndarray) -> float:
        moved = start.retract(model, poses_step, shared_step, FREE_LENS)
        errors = trial_errors(observations, homographies(moved), moved.lens, equations.whitening)
        return 2.0 * float(robust_cost(squared_lengths(errors), width).sum())

    rng = np.random.default_rng(0)
    for _ in range(4):
        along = rng.normal(size=free.shape) * free, rng.normal(size=len(start.shared) + len(FREE_LENS))
        step = 1e-6
        numeric = (cost(step * along[0], step * along[1]) - cost(-step * along[0], -step * along[1])) / (2 * step)
        analytic = 2.0 * float(np.vdot(normal.gradient_poses, along[0]) + normal.gradient_shared @ along[1])
        assert analytic == pytest.approx(numeric, rel=1e-5)

    # the step solves the dense system
    dense = _dense(normal, observations)
    right = -np.concatenate([normal.gradient_poses[free], normal.gradient_shared])
    poses, shared = normal.solve(1e-3)
    expected = np.linalg.solve(dense + 1e-3 * np.diag(np.diag(dense)), right)
    np.testing.assert_allclose(np.concatenate([poses[free], shared]), expected, rtol=1e-6, atol=1e-9)
    assert not poses[~free].any()


@pytest.mark.parametrize("free", [ONE_LENS, FREE_LENS, np.zeros(5, dtype=np.bool_)], ids=["one", "all", "none"])
def test_sums_of_a_link_are_those_of_its_jacobian(free: np.ndarray) -> None:
    truth = _scene()
    observations = Observations.from_links(truth.links[:1], truth.cameras)
    lens, width = np.array([-0.2, 0.05, 0, 0.01, 0]), 9.0
    behind = np.array([[1.0, 0.0, 0.1], [0.0, 1.0, 0.0], [-2.0, 0.0, 1.0]])  # some of the correspondences
    found = link_equations(observations, behind[None], lens, width, free)
    by = transfer_jacobian(behind, lens[0], observations.points1 - lens[3:], (0.05, 0.0))
    jacobian = np.concatenate([by.by_homography, by.by_lens(free).transpose(2, 0, 1)], axis=2)
    seen = np.isfinite(found.errors[:, 0])
    assert 0 < seen.sum() < len(seen)
    jacobian, error = (found.whitening @ jacobian)[seen], found.errors[seen]
    weight = robust_weight((error**2).sum(axis=1), width)
    expected = np.einsum("m,mik,mil->kl", weight, jacobian, jacobian)
    np.testing.assert_allclose(found.gram[0], expected, rtol=1e-9, atol=1e-9 * np.abs(expected).max())
    expected = np.einsum("m,mik,mi->k", weight, jacobian, error)
    np.testing.assert_allclose(found.gradient[0], expected, rtol=1e-9, atol=1e-9 * np.abs(expected).max())


def test_information_on_shared_parameters_is_what_elimination_leaves() -> None:
    truth = _scene()
    observations = Observations.from_links(truth.links, truth.cameras)
    start = _start(TILTING, truth)
    matrices = TILTING.matrices(start.poses, start.shared)
    h = matrices.matrices[observations.image2] @ np.linalg.inv(matrices.matrices)[observations.image1]
    free = np.ones((len(truth.cameras), 6), dtype=np.bool_)
    free[0] = ~TILTING.gauge
    normal = assemble(
        link_equations(observations, h, start.lens, 5.0, ONE_LENS),
        observations,
        matrices,
        h,
        free,
        1.0,
    )
    normal = normal.with_priors(np.full(free.shape, 1e4), np.zeros(free.shape), np.eye(4), np.zeros(4))
    inverse = np.linalg.inv(_dense(normal, observations))
    expected = np.linalg.inv(inverse[-4:, -4:])
    np.testing.assert_allclose(normal.shared_information(), expected, rtol=1e-5, atol=1e-5)
    # and of the inverse each image's own block, and those with the shared parameters
    whole, size = np.zeros((free.size + 4, free.size + 4)), free.shape[1]
    whole[np.ix_(*[np.append(free.ravel(), [True] * 4)] * 2)] = inverse
    own, by_shared, of_shared = normal.pose_covariances()
    for k in range(len(free)):
        rows = slice(k * size, (k + 1) * size)
        np.testing.assert_allclose(own[k], whole[rows, rows], rtol=1e-6, atol=1e-9 * np.abs(inverse).max())
        np.testing.assert_allclose(by_shared[k], whole[rows, -4:], rtol=1e-6, atol=1e-9 * np.abs(inverse).max())
    np.testing.assert_allclose(of_shared, inverse[-4:, -4:], rtol=1e-6)


def _adjust(model: MotionModel, truth: Scene, seen: Observations) -> tuple[float, float]:
    start = _start(model, truth)
    start = Parameters(start.poses, start.shared, np.array([-0.2, 0.0, 0.0, 0.0, 0.0]))
    freedom = FreeParameters.fixing(model, len(truth.cameras), [0], ONE_LENS)
    found = BundleAdjuster(model, seen, freedom, Priors.none(model, len(truth.cameras))).run(start)
    assert found.converged
    return float(found.parameters.lens[0]), float(np.sqrt(found.covariance[-1, -1]))


def test_stated_standard_deviation_is_the_scatter() -> None:
    errors = []
    for seed in range(30):
        truth = grid_scene(2, 2, (0.4, 0.35), 0.3, seed=seed, per_link=50, noise=0.5, outliers=0.0)
        value, std = _adjust(HOMOGRAPHY, truth, Observations.from_links(truth.links, truth.cameras))
        errors.append((value - truth.distortion) / std)
    assert 0.7 < float(np.std(errors)) < 1.4
    assert abs(float(np.mean(errors))) < 0.5


def test_outliers_do_not_move_the_result() -> None:
    truth = grid_scene(3, 2, (0.4, 0.35), 0.3, seed=5, noise=0.3, outliers=0.3)
    value, std = _adjust(RIGID, truth, Observations.from_links(truth.links, truth.cameras))
    assert abs(value - truth.distortion) < 5 * std < 0.005


def test_the_focal_length_of_a_long_strip_is_the_same_from_wherever_it_starts() -> None:
    """It is hardly seen beside the tilts of all images: damping would leave it near its start."""
    wind = 0.05, 0.02
    truth = grid_scene(25, 2, (0.3, 0.5), 0.1, seed=5, tilt=(0.02, -0.03), noise=0.2, per_link=120, wind=wind)
    count, true = len(truth.poses), np.log(520.0 / truth.cameras[0].scale)
    freedom = FreeParameters.fixing(TILTING, count, [0], ONE_LENS)
    seen = Observations.from_links(truth.links, truth.cameras)
    adjuster = BundleAdjuster(TILTING, seen, freedom, Priors.none(TILTING, count))
    values = []
    for factor in (0.8, 1.0, 1.3):
        shared = TILTING.shared_from_physical(np.array([0.02, -0.03, true + np.log(factor)]))
        start = TILTING.nearest_poses(truth.truth, shared, np.zeros((count, 2)))
        result = adjuster.run(Parameters(start, shared, np.array([-0.25, 0.0, 0.0, 0.0, 0.0])))
        values.append(float(result.parameters.shared[-1]))
    std = float(np.sqrt(adjuster.covariance(result)[2, 2]))
    assert np.ptp(values) < 0.05 * std
    assert abs(values[0] - true) < 4 * std


@pytest.mark.parametrize("behind", [[1, 4], [2, 3], [1, 3, 5]])
def test_what_leaves_most_matches_behind_the_camera_is_no_solution(behind: list[int]) -> None:
    truth = _scene()
    start, observations = _start(HOMOGRAPHY, truth), Observations.from_links(truth.links, truth.cameras)
    start.poses[behind] *= -1.0
    count = len(truth.cameras)
    free = FreeParameters.fixing(HOMOGRAPHY, count, [0], ONE_LENS)
    found = BundleAdjuster(HOMOGRAPHY, observations, free, Priors.none(HOMOGRAPHY, count)).run(start)
    assert np.isinf(found.squared).mean() > 0.5
    assert not found.converged


def test_errors_of_a_given_scatter_give_their_sigma() -> None:
    errors = np.random.default_rng(0).normal(0, 0.7, (20_000, 2))
    assert sigma_of((errors**2).sum(axis=1)) == pytest.approx(0.7, rel=0.03)


def _observations(counts: list[int]) -> Observations:
    rng = np.random.default_rng(0)
    total, links = sum(counts), len(counts)
    points = rng.uniform(-0.8, 0.8, (total, 2))
    return Observations(
        np.arange(links),
        np.arange(links) + 1,
        np.concatenate([[0], np.cumsum(counts)]).astype(np.intp),
        points,
        points + rng.normal(0.0, 0.05, points.shape),
        np.full(links, 400.0),
        np.full(links, 400.0),
        np.array(counts),
    )


def test_medians_of_links_of_any_length() -> None:
    counts = [5, 0, 1, 8, 2, 0]
    observations = _observations(counts)
    values = np.random.default_rng(1).normal(size=sum(counts))
    values[3] = np.inf
    found = observations.medians(values)
    parts = np.split(values, np.cumsum(counts)[:-1])
    assert found.tolist() == [float(np.median(part)) if len(part) else np.inf for part in parts]
    assert _observations([0, 0]).medians(np.empty(0)).tolist() == [np.inf, np.inf]


def test_areas_of_links_with_few_correspondences_or_many() -> None:
    corners = np.array([(-1.0, -1.0), (1.0, -1.0), (-1.0, 1.0), (1.0, 1.0)])
    points = np.concatenate([corners, 0.5 * corners + 0.2, corners * (1.0, 0.0), corners[:1]])
    start = np.array([0, 4, 8, 12, 13, 13])
    sizes = np.full(5, 400.0)
    made = Observations(np.arange(5), np.arange(5) + 1, start, points, points, sizes, sizes, np.diff(start))
    np.testing.assert_allclose(made.areas, [1.0, 0.25, 0.0, 0.0, 0.0], atol=1e-12)


def test_sums_of_a_link_do_not_depend_on_the_other_links() -> None:
    """Whether these have as many correspondences or not."""
    observations = _observations([30, 12, 30, 0, 7])
    homographies = np.eye(3) + np.random.default_rng(2).normal(0.0, 0.01, (5, 3, 3))
    lens, free = np.array([-0.2, 0.0, 0.0, 0.0, 0.0]), np.array([True, False, False, True, True])
    together = link_equations(observations, homographies, lens, 20.0, free)
    for link in range(5):
        alone = link_equations(observations.subset(np.array([link])), homographies[[link]], lens, 20.0, free)
        np.testing.assert_allclose(together.gram[link], alone.gram[0], rtol=1e-12, atol=1e-9)
        np.testing.assert_allclose(together.gradient[link], alone.gradient[0], rtol=1e-12, atol=1e-9)
    assert (together.gram[3] == 0.0).all()
    assert (together.gram[0] != 0.0).any()
