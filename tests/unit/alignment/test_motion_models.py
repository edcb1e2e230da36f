"""The motion models give what they promise: derivatives, inverses, and poses from homographies of a plane."""

import tracemalloc

import numpy as np
import pytest

from rdstitch.alignment.metric_upgrade import metric_upgrade
from rdstitch.alignment.motion_models import (
    HOMOGRAPHY,
    LOG_HEIGHT,
    MODELS,
    POSE,
    RIGID,
    SIMILARITY,
    TILTING,
    YAW,
    MotionModel,
    X,
    Y,
)
from rdstitch.geometry.planar_motion import PlanarMotion

SIGNS = np.array([[1.0], [-1.0]])


def _some(model: MotionModel, count: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    shared = model.shared_from_physical(np.array([0.05, -0.08, np.log(1.4)]))
    poses = model.nearest_poses(np.tile(np.eye(3), (count, 1, 1)), shared, np.zeros((count, 2)))
    return model.retract(poses, 0.3 * rng.normal(size=(count, model.pose_size))), shared


@pytest.mark.parametrize("model", MODELS.values(), ids=MODELS)
def test_derivatives_are_those_of_the_matrices(model: MotionModel) -> None:
    rng = np.random.default_rng(0)
    poses, shared = _some(model, 4, rng)
    found = model.matrices(poses, shared)
    step = 1e-6

    def direction(matrices: np.ndarray) -> np.ndarray:  # of a homography only the direction counts
        scale = np.linalg.norm(matrices, axis=(1, 2), keepdims=True)
        return np.asarray(matrices / scale)

    for k in range(model.pose_size):
        change = np.zeros((4, model.pose_size))
        change[:, k] = step
        high = model.matrices(model.retract(poses, change), shared).matrices
        low = model.matrices(model.retract(poses, -change), shared).matrices
        moved_high = direction(found.matrices + step * found.by_pose[:, k])
        moved_low = direction(found.matrices - step * found.by_pose[:, k])
        numeric = (direction(high) - direction(low)) / (2 * step)
        np.testing.assert_allclose((moved_high - moved_low) / (2 * step), numeric, atol=1e-8)
    for k in range(len(shared)):
        high, low = (model.matrices(poses, shared + by).matrices for by in step * np.eye(len(shared))[[k, k]] * SIGNS)
        np.testing.assert_allclose(found.by_shared[:, k], (high - low) / (2 * step), atol=1e-8)


@pytest.mark.parametrize("model", [RIGID, SIMILARITY, TILTING], ids=lambda model: model.name)
def test_natural_parameters_and_their_derivatives(model: MotionModel) -> None:
    natural = np.array([0.1, -0.2, 0.4])
    shared = model.shared_from_physical(natural)
    np.testing.assert_allclose(model.physical_parameters(shared)[0], natural, atol=1e-15)
    for k in range(3):
        change = np.zeros(3)
        change[k] = 1e-6
        numeric = (model.physical_parameters(shared + change)[0] - model.physical_parameters(shared - change)[0]) / 2e-6
        np.testing.assert_allclose(model.physical_parameters(shared)[1][:, k], numeric, atol=1e-9)


def test_two_images_are_related_by_the_planar_motion_between_them() -> None:
    tilt, focal = (0.1, -0.05), 1.3
    motion = PlanarMotion(tilt, 0.4, (0.3, -0.2), 1.2)
    shared = SIMILARITY.shared_from_physical(np.array([*tilt, np.log(focal)]))
    poses = np.zeros((2, 6))
    poses[1, [YAW, X, Y, LOG_HEIGHT]] = 0.4, 0.3 * focal, -0.2 * focal, np.log(1.2)
    first, second = SIMILARITY.matrices(poses, shared).matrices
    scale = np.diag([focal, focal, 1.0])
    np.testing.assert_allclose(
        second @ np.linalg.inv(first), scale @ motion.homography() @ np.linalg.inv(scale), atol=1e-12
    )
    metric = SIMILARITY.metric_poses(poses, shared)
    np.testing.assert_allclose(metric[1], [0.4, 0.3, -0.2, np.log(1.2), *tilt], atol=1e-12)


@pytest.mark.parametrize("model", [RIGID, SIMILARITY], ids=lambda model: model.name)
def test_poses_come_back_from_their_homographies(model: MotionModel) -> None:
    rng = np.random.default_rng(1)
    poses, shared = _some(model, 5, rng)
    attitudes = 0.05 * rng.normal(size=(5, 2))
    poses[:, 4:] = attitudes
    matrices = model.matrices(poses, shared).matrices * rng.uniform(0.5, 2.0, (5, 1, 1))
    np.testing.assert_allclose(model.nearest_poses(matrices, shared, attitudes), poses, atol=1e-12)


def test_a_step_of_the_general_model_keeps_the_determinant() -> None:
    poses, _ = _some(HOMOGRAPHY, 3, np.random.default_rng(2))
    moved = HOMOGRAPHY.retract(poses, np.full((3, 8), 0.01)).reshape(-1, 3, 3)
    np.testing.assert_allclose(np.abs(np.linalg.det(moved)), 1.0, atol=1e-12)


_FOCAL = 1.3  # half diagonals


def _homographies(count: int) -> np.ndarray:
    """Plane-to-image homographies of tilted cameras over a plane, in a projective frame of it."""
    rng = np.random.default_rng(3)
    poses = np.zeros((count, 6))
    poses[:, :3] = rng.normal(0.0, 1.0, (count, 3))
    poses[:, 4:] = rng.normal(0.0, 0.1, (count, 2))
    shared = np.array([0.1, -0.2, np.log(_FOCAL)])
    return POSE.matrices(poses, shared).matrices


def test_memory_does_not_grow_with_images_times_tilts() -> None:
    homographies = _homographies(800)
    tracemalloc.start()
    try:
        metric_upgrade(homographies, 0, np.log(_FOCAL), 0.3)
        assert tracemalloc.get_traced_memory()[1] < 50e6
    finally:
        tracemalloc.stop()


def test_blocks_find_what_few_images_find() -> None:
    """Images enough for many blocks of tilts, of the same poses as those that need one."""
    few = _homographies(30)
    (one, physical), (many, same) = (
        metric_upgrade(own, 0, np.log(_FOCAL), 0.3) for own in (few, np.tile(few, (15, 1, 1)))
    )
    np.testing.assert_allclose(many[:30] - many[0], one - one[0], atol=1e-9)
    assert physical[2] == same[2]
