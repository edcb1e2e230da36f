"""How far a trajectory is from the true one."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rdstitch.arrays import FloatArray
from rdstitch.trajectories.trajectory import Trajectory


@dataclass(frozen=True)
class TrajectoryError:
    """How far a trajectory is from the truth."""

    translation: float  # median error of the relative translations, as a share of their length, in heights
    translation_in_own_unit: float  # after the best scale: the height in px is known as well as the focal length
    rotation: float  # median error of the relative rotations, radians
    drift: float  # root mean square distance of positions after the best similarity, as a share of the path's length
    scale: float  # length unit of the estimate in that of the truth, of the best similarity


def compare_trajectories(estimate: Trajectory, truth: Trajectory) -> TrajectoryError:
    """Compare a trajectory with the true one, over the frames that both have.

    Relative motions are compared as the earlier frame sees them, in units of its height, so that neither the frame
    nor the unit of either trajectory matters.
    """
    _, own, other = np.intersect1d(estimate.frame, truth.frame, return_indices=True)
    a, b = _chosen(estimate, own), _chosen(truth, other)
    (move_a, turn_a), (move_b, turn_b) = _relative(a), _relative(b)
    off = np.linalg.norm(move_a - move_b, axis=1)
    size = np.linalg.norm(move_b, axis=1)
    unit = float(np.vdot(move_a, move_b) / max(float(np.vdot(move_a, move_a)), 1e-300))
    off_scaled = np.linalg.norm(unit * move_a - move_b, axis=1)
    moving = size > 1e-9 * max(float(size.max()), 1e-300)
    turn = np.abs(np.remainder(turn_a - turn_b + np.pi, 2 * np.pi) - np.pi)
    complex_a, complex_b = (t.position[:, 0] + 1j * t.position[:, 1] for t in (a, b))
    centred_a, centred_b = complex_a - complex_a.mean(), complex_b - complex_b.mean()
    power = float(np.vdot(centred_a, centred_a).real)
    factor = np.vdot(centred_a, centred_b) / power if power > 0.0 else 1.0
    distance = np.abs(factor * centred_a - centred_b)
    return TrajectoryError(
        translation=float(np.median(off[moving] / size[moving])) if moving.any() else 0.0,
        translation_in_own_unit=float(np.median(off_scaled[moving] / size[moving])) if moving.any() else 0.0,
        rotation=float(np.median(turn)),
        drift=float(np.sqrt(np.mean(distance**2))) / max(b.length, 1e-300),
        scale=float(np.abs(factor)),
    )


def _chosen(trajectory: Trajectory, rows: NDArray[np.intp]) -> Trajectory:
    """Some frames of a trajectory."""
    t = trajectory
    return Trajectory(t.frame[rows], t.position[rows], t.yaw[rows], t.height[rows])


def _relative(path: Trajectory) -> tuple[FloatArray, FloatArray]:
    """Translations (F - step, 2), in heights, and rotations to the next frame, as each sees them."""
    move = np.diff(path.position, axis=0)
    c, s = np.cos(path.yaw[:-1]), np.sin(path.yaw[:-1])
    turned = np.stack([c * move[:, 0] - s * move[:, 1], s * move[:, 0] + c * move[:, 1]], axis=1)
    return turned / path.height[:-1, None], np.diff(path.yaw)
