"""Frames of a camera whose focal length and tilt are known: where they lie on a metric plane, and how surely."""

from dataclasses import dataclass

import numpy as np

from rdstitch.arrays import FloatArray
from rdstitch.geometry.camera import Camera
from rdstitch.geometry.planar_motion import rotation_from_tilt
from rdstitch.tracking.placement import Placement, PlaneSimilarity

_CELLS = 8
"""A side of an image: matches of one cell have their errors in common, as the lens and the pixels of a place make them,
so that they count as one."""


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

    def placed(
        self, frame: Placement, points: FloatArray, places: FloatArray, *, tilts_err: bool = False
    ) -> tuple[Placement, FloatArray]:
        """A frame that is ``below`` at the places (N, 2) on the map of its points (N, 2), pixels.

        Where tilts were measured, their errors move all points together (``tilts_err``).

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
        together = len(points) / (1 if tilts_err else len(np.unique(cell @ [1, 1 << 16])))
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


def chained(before: FloatArray, step: FloatArray, offset: tuple[float, float], height: float) -> FloatArray:
    """The covariance (4, 4) of a frame by that of the frame that it was placed by, which is ``offset`` behind it."""
    dx, dy = offset
    carried = np.eye(4)
    carried[:2, 3] = dy, -dx  # yaw turns the map by minus itself, y being down
    carried[:2, 2] = dx / height, dy / height
    return np.asarray(carried @ before @ carried.T + step)
