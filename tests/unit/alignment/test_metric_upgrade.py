"""Poses of one camera from homographies of a plane."""

import tracemalloc

import numpy as np

from rdstitch.alignment.metric_upgrade import metric_upgrade
from rdstitch.alignment.motion_models import POSE

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
    one, many = (metric_upgrade(own, 0, np.log(_FOCAL), 0.3) for own in (few, np.tile(few, (15, 1, 1))))
    np.testing.assert_allclose(many.poses[:30] - many.poses[0], one.poses - one.poses[0], atol=1e-9)
    assert many.log_focal == one.log_focal
