"""The level frame of a camera that turns on the spot, by gravity or by how people hold cameras."""

import math

import numpy as np

from rdstitch.arrays import BoolArray, FloatArray

_FULL_CIRCLE = np.pi / 2  # images whose centres leave no wider gap than this, radians, count as all the way round

_MAX_GRAVITY_SPREAD = np.radians(5.0)
"""Median angle between measured directions of gravity and their mean, up to which they are believed."""

_ROLL = np.radians(3.0)  # standard deviation of the roll of a camera that is held by hand: chosen

_STEEP = np.cos(np.radians(30.0))
"""Images that look within 30 degrees of straight up or down do not show how the camera was held."""

_VERTICAL = 1e-6  # radians from straight up or down at which an image shows no heading


def levelled(
    matrices: FloatArray, reference: int, gravity: FloatArray | None = None, counted: BoolArray | None = None
) -> FloatArray:
    """Matrices (N, 3, 3) from undistorted coordinates of each image to directions in a level frame.

    The frame has x to the right, y down, and z towards the middle of what the images show, or towards the reference
    image where they show everything around. ``matrices`` are ``diag(f, f, 1) R_i``, from directions in any frame to the
    images; gravity (N, 3) is down in the axes of each camera, NaN where it has not measured it. Images that are not
    counted (N,) do not move the frame, into which they come; the reference is.
    """
    focal = float(np.linalg.norm(matrices[0, 0]))
    rotations = matrices / np.array([[focal], [focal], [1.0]])
    counted = np.ones(len(matrices), dtype=np.bool_) if counted is None else counted
    down = measured_down(rotations[counted], None if gravity is None else gravity[counted])
    frame = level_frame(rotations[counted], int(counted[:reference].sum()), down)
    return np.asarray(frame @ np.swapaxes(rotations, 1, 2) @ np.diag([1.0, 1.0, focal]))


def measured_down(rotations: FloatArray, gravity: FloatArray | None) -> FloatArray | None:
    """Direction down (3,), in the frame that rotations (N, 3, 3) lead from, by gravity (N, 3) in the cameras' axes.

    Gravity may be in any unit. None where no camera has measured it, or where the measurements contradict each other.
    """
    if gravity is None:
        return None
    down = np.einsum("nij,ni->nj", rotations, gravity)
    length = np.linalg.norm(down, axis=1)
    known = np.isfinite(length) & (length > 0.0)
    if not known.any():
        return None
    down = down[known] / length[known, None]
    mean = _unit(down.mean(axis=0))
    spread = float(np.median(np.arccos(np.clip(down @ mean, -1.0, 1.0))))
    return mean if spread < _MAX_GRAVITY_SPREAD else None


def level_frame(rotations: FloatArray, reference: int, down_by_gravity: FloatArray | None = None) -> FloatArray:
    """Rotation (3, 3) to the level frame from the one that rotations (N, 3, 3) lead from to the cameras.

    People hold cameras level, whichever way they turn them: the x axes of all images lie in one plane,
    and the direction down is the one they have least in common with (Brown and Lowe 2007, section 5). The less the
    images turn, beyond what hands roll, the more counts what is down in them; a few may be taken with the camera on its
    side. Gravity, where cameras have measured it, decides alone.
    """
    right, down, ahead = _upright(rotations)
    mean_down = _unit(down.mean(axis=0))
    spread, axes = np.linalg.eigh(right.T @ right)
    axis = axes[:, 0] * (1.0 if axes[:, 0] @ mean_down > 0.0 else -1.0)
    certainty = (spread[1] - spread[0]) / max(spread[1] + spread[0], 1e-12)
    certainty *= -math.expm1(-spread[1] / (2.0 * len(right) * _ROLL**2))  # that roll alone spreads them less (Rayleigh)
    y = _unit(certainty * axis + (1.0 - certainty) * mean_down) if down_by_gravity is None else down_by_gravity
    x = np.cross(y, ahead[reference])
    if np.linalg.norm(x) < _VERTICAL:
        x = right[reference] - (right[reference] @ y) * y
    x = _unit(x)
    z = np.cross(x, y)
    heading = _middle(np.arctan2(ahead @ x, ahead @ z))
    x, z = np.cos(heading) * x - np.sin(heading) * z, np.sin(heading) * x + np.cos(heading) * z
    return np.stack([x, y, z])


def _upright(rotations: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Axes right, down and ahead (N, 3) of cameras, turned by quarters about the last so that most agree on down."""
    right, down, ahead = np.moveaxis(rotations, 1, 0)
    usual = down[np.argmax(down @ down.sum(axis=0))]
    roll = np.rint(np.arctan2(right @ usual, down @ usual) / (np.pi / 2)) * (np.pi / 2)
    roll = np.where(np.abs(ahead @ usual) < _STEEP, roll, 0.0)[:, None]
    return np.cos(roll) * right - np.sin(roll) * down, np.sin(roll) * right + np.cos(roll) * down, ahead


def _middle(headings: FloatArray) -> float:
    """Middle of headings, radians: opposite to the widest gap between them; 0 where they go all the way round."""
    ordered = np.sort(headings)
    gaps = np.diff(np.append(ordered, ordered[0] + 2.0 * np.pi))
    widest = int(np.argmax(gaps))
    if gaps[widest] < _FULL_CIRCLE:
        return 0.0
    return float(ordered[widest] + gaps[widest] / 2.0 + np.pi)


def _unit(vector: FloatArray) -> FloatArray:
    return vector / max(float(np.linalg.norm(vector)), 1e-12)
