"""Frames of a camera whose focal length and tilt are known: where they lie on a metric plane, and how surely."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rdstitch.arrays import FloatArray
from rdstitch.geometry.camera import Camera
from rdstitch.geometry.planar_motion import rotation_from_tilt
from rdstitch.tracking.placement import Placement, PlaneSimilarity

_CELLS = 8
"""A side of an image: matches of one cell have their errors in common, as the lens and the pixels of a place make them,
so that they count as one."""


_TILT_STARTS = (0.0, 0.0), (0.35, 0.0), (-0.35, 0.0), (0.0, 0.35), (0.0, -0.35)
_STEPS, _DIFFERENCE, _SETTLED = 15, 1e-5, 1e-6  # radians
_MAX_CONDITION, _HALVINGS = 1e6, 6
_HORIZON = 0.05  # of a ray of unit depth: what is nearer to the horizon has no place


@dataclass(frozen=True)
class MetricPlane:
    """What a motion in the plane needs of the camera."""

    focal: float  # half diagonals
    tilt: tuple[float, float]  # (ψ, θ), radians, of all frames, or of the mount of what measures attitudes
    rigid: bool  # whether the height stays

    def below(self, camera: Camera, attitude: tuple[float, float] | None) -> Placement:
        """A frame at the origin, with yaw zero and height one."""
        psi, theta = attitude or (0.0, 0.0)
        rotation = rotation_from_tilt((self.tilt[0] + psi, self.tilt[1] + theta))
        return Placement(camera, rotation.T @ np.diag([1.0 / self.focal, 1.0 / self.focal, 1.0]), self.focal)

    def placed(self, frame: Placement, points: FloatArray, places: FloatArray) -> "tuple[Placement, FloatArray]":
        """A frame that is ``below`` at the places (N, 2) on the map of its points (N, 2), pixels.

        Returns
        -------
        Placement, ndarray of shape (4, 4)
            The frame, and the covariance of its x, y, height and yaw, if the places are exact.
        """
        local = frame.to_plane(points)
        moved = PlaneSimilarity.fitted(local, places, keep_size=self.rigid)
        # As complex numbers: places = turn * local + shift, with turn = height exp(-i yaw).
        source, target = local @ [1.0, 1.0j], places @ [1.0, 1.0j]
        errors = target - moved.turn * source - moved.shift
        middle = complex(source.mean())
        freedom = 3 if self.rigid else 4
        width, height = frame.camera.image_size
        cell = np.floor(points * _CELLS / (width, height)).astype(np.intp)
        together = len(points) / len(np.unique(cell @ [1, 1 << 16]))
        variance = together * float((abs(errors) ** 2).sum()) / max(2 * len(points) - freedom, 1)
        spread = max(float((abs(moved.turn * (source - middle)) ** 2).sum()), 1e-300)
        lever = moved.turn * middle  # from the camera's foot to the middle of the points
        # The foot moves with the middle, by the turn (-yaw) and by the height about it.
        by_yaw, by_height = 1j * lever, -lever / abs(moved.turn)
        jacobian = np.zeros((4, 4))
        jacobian[:2, :2] = np.eye(2)
        jacobian[:2, 2] = by_height.real, by_height.imag
        jacobian[:2, 3] = by_yaw.real, by_yaw.imag
        jacobian[2, 2] = jacobian[3, 3] = 1.0
        yaw_variance = variance / spread
        height_variance = 0.0 if self.rigid else yaw_variance * abs(moved.turn) ** 2
        alone = np.diag([variance / len(points), variance / len(points), height_variance, yaw_variance])
        return moved.applied(frame), jacobian @ alone @ jacobian.T


@dataclass(frozen=True)
class SeenPair:
    """Points that two frames share."""

    rays1: FloatArray  # rays1, rays2: (N, 2): undistorted, in focal lengths
    rays2: FloatArray
    attitude1: FloatArray  # attitude1, attitude2: (2,): as measured, radians; zeros where nothing was
    attitude2: FloatArray

    def errors(self, camera: FloatArray) -> FloatArray:
        """How far (2 N,) their points on the plane are from a rigid motion, focal lengths; inf beyond the horizon.

        ``camera``: the tilt, and log of how much longer the focal length is.
        """
        one, two = (
            _on_plane(rays / np.exp(camera[2]), camera[:2] + attitude)
            for rays, attitude in ((self.rays1, self.attitude1), (self.rays2, self.attitude2))
        )
        one, two = one - one.mean(), two - two.mean()
        turn = complex(np.vdot(two, one))
        # In given focal lengths, as the points were measured: a longer one makes no errors smaller.
        errors = (one - turn / max(abs(turn), 1e-300) * two) * np.exp(camera[2])
        return np.concatenate([errors.real, errors.imag])


@dataclass(frozen=True)
class ShownCamera:
    """What motions show of a camera."""

    tilt: tuple[float, float]  # (ψ, θ), radians, with the focal length that is given
    tilt_std: float  # of its less certain direction
    rms: float  # of the points on the plane, heights
    log_focal: float  # log of how much longer the focal length is than the given one, by the motions alone
    log_focal_std: float


def shown_camera(pairs: Sequence[SeenPair]) -> ShownCamera:
    """The tilt, and the focal length, by which the motions between frames are rigid."""

    def errors(camera: FloatArray) -> FloatArray:
        with np.errstate(all="ignore"):  # beyond the horizon
            return np.concatenate([pair.errors(camera) for pair in pairs])

    def fitted(start: FloatArray, free: int) -> tuple[FloatArray, FloatArray, FloatArray]:
        """The camera, its errors and their derivatives (2 N, free) after Gauss and Newton's steps."""
        camera, value, change = start, errors(start), np.zeros((0, free))
        for _ in range(_STEPS):
            steps = _DIFFERENCE * np.eye(3)[:free]
            change = np.stack([errors(camera + step) - value for step in steps], axis=1) / _DIFFERENCE
            if not np.isfinite(change).all():
                break
            step = np.zeros(3)
            step[:free] = np.linalg.lstsq(change, value, rcond=None)[0]
            shorter = ((step / 2**k, errors(camera - step / 2**k)) for k in range(_HALVINGS))
            step, after = next((one for one in shorter if one[1] @ one[1] < value @ value), (step, None))
            if after is None:
                break
            camera, value = camera - step, after
            if abs(step).max() < _SETTLED:
                break
        return camera, value, change

    fits = [fitted(np.append(start, 0.0), 2) for start in _TILT_STARTS]
    fits = [fit for fit in fits if np.isfinite(fit[2]).all()]
    if not fits:
        return ShownCamera((0.0, 0.0), math.inf, math.inf, 0.0, math.inf)
    camera, value, change = min(fits, key=lambda fit: float(fit[1] @ fit[1]))
    count = len(value) // 2
    freedom = max(2 * count - 3 - 3 * len(pairs), 1)
    together = max(count / (len(pairs) * _CELLS**2 / 2), 1.0)
    least = max(float(np.linalg.eigvalsh(change.T @ change)[0]), 1e-300)
    longer, better, slope = fitted(camera, 3)
    known = np.isfinite(slope).all() and np.linalg.cond(slope) < _MAX_CONDITION
    inverse = np.linalg.inv(slope.T @ slope) if known else np.full((3, 3), math.inf)
    return ShownCamera(
        (float(camera[0]), float(camera[1])),
        math.sqrt(together * float(value @ value) / freedom / least),
        math.sqrt(float(value @ value) / max(count, 1)),
        float(longer[2]),
        math.sqrt(together * float(better @ better) / freedom * float(inverse[2, 2])),
    )


def _on_plane(rays: FloatArray, tilt: FloatArray) -> NDArray[np.complex128]:
    """Points on the plane as complex numbers, in heights; inf beyond the horizon."""
    seen = np.column_stack([rays, np.ones(len(rays))]) @ rotation_from_tilt(tilt)
    depth = np.where(seen[:, 2] > _HORIZON, seen[:, 2], np.nan)
    return np.asarray(np.nan_to_num((seen[:, 0] + 1j * seen[:, 1]) / depth, nan=np.inf))


def chained(before: FloatArray, step: FloatArray, offset: tuple[float, float], height: float) -> FloatArray:
    """The covariance (4, 4) of a frame by that of the frame that it was placed by, which is ``offset`` behind it."""
    dx, dy = offset
    carried = np.eye(4)
    carried[:2, 3] = dy, -dx  # yaw turns the map by minus itself, y being down
    carried[:2, 2] = dx / height, dy / height
    return np.asarray(carried @ before @ carried.T + step)
