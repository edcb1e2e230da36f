"""What must hold of the motion models whatever the numbers."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from rdstitch.alignment.motion_models import HOMOGRAPHY, SIMILARITY, TILTING, inverses
from rdstitch.alignment.motion_models.homography import _TRACELESS
from rdstitch.matching.thinning import spread_choice


def _numbers(low: float, high: float) -> st.SearchStrategy[float]:
    return st.floats(low, high, allow_nan=False, allow_subnormal=False)


def _relations(matrices: np.ndarray) -> np.ndarray:
    """Every image to the first, of determinant one."""
    h = matrices[:1] @ np.linalg.inv(matrices)
    return np.asarray(h / np.cbrt(np.linalg.det(h))[:, None, None])


@given(arrays(float, (3, 3, 3), elements=_numbers(-0.2, 0.2)), arrays(float, 8, elements=_numbers(-0.2, 0.2)))
def test_a_change_of_the_planes_frame_leaves_all_relations(change: np.ndarray, gauge: np.ndarray) -> None:
    poses = np.eye(3) + change
    frame = np.einsum("k,kij->ij", gauge, _TRACELESS)
    generators = poses @ frame @ np.linalg.inv(poses)
    basis = _TRACELESS.reshape(8, 9)
    step = np.linalg.lstsq(basis.T, generators.reshape(3, 9).T, rcond=None)[0].T
    moved = HOMOGRAPHY.retract(poses.reshape(3, 9), step).reshape(3, 3, 3)
    np.testing.assert_allclose(_relations(moved), _relations(poses), atol=1e-8)


@given(
    arrays(float, (3, 4), elements=_numbers(-1.5, 1.5)),
    arrays(float, 3, elements=_numbers(-0.3, 0.3)),
    _numbers(-3.0, 3.0),
    arrays(float, 2, elements=_numbers(-2.0, 2.0)),
)
def test_moving_the_plane_rigidly_leaves_all_relations(
    planar: np.ndarray, natural: np.ndarray, turn: float, shift: np.ndarray
) -> None:
    """Position and yaw are relative: the whole path may be moved over the plane."""
    poses = np.column_stack([planar, np.zeros((3, 2))])
    shared = SIMILARITY.shared_from_physical(natural)
    c, s = np.cos(turn), np.sin(turn)
    moved = poses.copy()
    moved[:, 1:3] = poses[:, 1:3] @ np.array([[c, -s], [s, c]]).T + shift
    moved[:, 0] -= turn
    before, after = (_relations(SIMILARITY.matrices(p, shared).matrices) for p in (poses, moved))
    np.testing.assert_allclose(after, before, atol=1e-7)


@given(arrays(float, (2, 6), elements=_numbers(-0.5, 0.5)), arrays(float, 3, elements=_numbers(-0.3, 0.3)))
def test_inverses_are_inverses(poses: np.ndarray, natural: np.ndarray) -> None:
    matrices = TILTING.matrices(poses, TILTING.shared_from_physical(natural)).matrices
    np.testing.assert_allclose(inverses(matrices) @ matrices, np.broadcast_to(np.eye(3), (2, 3, 3)), atol=1e-9)


@given(arrays(float, st.tuples(st.integers(1, 60), st.just(2)), elements=_numbers(-1.0, 1.0)), st.integers(1, 40))
def test_thinning_keeps_the_requested_number(points: np.ndarray, most: int) -> None:
    kept = spread_choice(points, most)
    assert len(kept) == min(most, len(points))
    assert (np.diff(kept) > 0).all()
