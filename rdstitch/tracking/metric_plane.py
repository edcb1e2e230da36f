"""Frames of a camera whose focal length and tilt are known: where they lie on a metric plane, and how surely."""

import math

import numpy as np

from rdstitch.arrays import FloatArray
from rdstitch.geometry.camera import Camera
from rdstitch.geometry.planar_motion import rotation_from_tilt
from rdstitch.system.dataclasses import dataclass
from rdstitch.tracking.placement import Placement, PlaneSimilarity

_CELLS = 8
"""A side of an image: errors of one cell may have a part in common, as the lens and the pixels of a place make them."""


@dataclass(frozen=True)
class MetricPlane:
    """What a motion in the plane needs of the camera."""

    focal: float  # half diagonals
    tilt: tuple[float, float]  # (ψ, θ), radians, of all frames, or of the mount of what measures attitudes
    rigid: bool  # whether the height stays
    tilt_std: float | None = None  # radians, by this focal length; None: exact, whatever the focal length is

    def bend_std(self, length_std: float) -> float:
        """Std of how far a path is off across, relative to its length: paths bend by what tilts are wrong by.

        A tilt that is taken for exact belongs to a focal length that is wrong by ``length_std``.
        """
        if self.tilt_std is not None or not math.isfinite(length_std):
            return self.tilt_std or 0.0
        return length_std * math.hypot(*self.tilt)

    def below(self, camera: Camera, attitude: tuple[float, float] | None) -> Placement:
        """A frame at the origin, with yaw zero and height one."""
        psi, theta = attitude or (0.0, 0.0)
        rotation = rotation_from_tilt((self.tilt[0] + psi, self.tilt[1] + theta))
        return Placement(camera, rotation.T @ np.diag([1.0 / self.focal, 1.0 / self.focal, 1.0]), self.focal)

    def placed(
        self, frame: Placement, points: FloatArray, places: FloatArray, *, tilt_std: float = 0.0
    ) -> tuple[Placement, FloatArray]:
        """A frame that is ``below`` at the places (N, 2) on the map of its points (N, 2), pixels.

        And the covariance (4, 4) of its x, y, height and yaw, if the places are exact. But for the tilts: where they
        err by ``tilt_std``, radians, from frame to frame, that turns the frame and the one that gives the places.
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
        cells = np.unique(cell @ [1, 1 << 16], return_inverse=True)[1].reshape(-1)
        sums = np.bincount(cells, errors.real) ** 2 + np.bincount(cells, errors.imag) ** 2
        # What errors of a cell have in common does not become less with their number.
        squares = max(float((abs(errors) ** 2).sum()), float(sums.sum()))
        variance = squares / max(2 * len(points) - freedom, 1)
        around = source - middle
        spread = max(float((abs(moved.turn * around) ** 2).sum()), 1e-300)
        lever = moved.turn * middle  # from the camera's foot to the middle of the points
        # The foot moves with the middle, by the turn (-yaw) and by the height about it.
        by_yaw, by_height = 1j * lever, -lever / abs(moved.turn)
        jacobian = np.zeros((4, 4))
        jacobian[:2, :2] = np.eye(2)
        jacobian[:2, 2] = by_height.real, by_height.imag
        jacobian[:2, 3] = by_yaw.real, by_yaw.imag
        jacobian[2, 2] = jacobian[3, 3] = 1.0
        # A tilt by a small angle moves a point s by its product with the angle and a coordinate of s. Where frames
        # follow one another, that of one turns both those before it and those after it, to the same side.
        by_tilts = [np.vdot(around, axis * source).imag * abs(moved.turn) ** 2 / spread for axis in local.T]
        yaw_variance = variance / spread + (2.0 * tilt_std * math.hypot(*by_tilts)) ** 2
        height_variance = 0.0 if self.rigid else variance / spread * abs(moved.turn) ** 2
        alone = np.diag([variance / len(points), variance / len(points), height_variance, yaw_variance])
        return moved.applied(frame), jacobian @ alone @ jacobian.T


def chained(before: FloatArray, step: FloatArray, offset: tuple[float, float], height: float) -> FloatArray:
    """The covariance (4, 4) of a frame by that of the frame that it was placed by, which is ``offset`` behind it."""
    dx, dy = offset
    carried = np.eye(4)
    carried[:2, 3] = dy, -dx  # yaw turns the map by minus itself, y being down
    carried[:2, 2] = dx / height, dy / height
    return np.asarray(carried @ before @ carried.T + step)
