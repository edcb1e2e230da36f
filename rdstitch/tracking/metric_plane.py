"""Frames of a camera whose focal length and tilt are known: where they lie on a metric plane, and how surely."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rdstitch.arrays import FloatArray
from rdstitch.geometry.camera import Camera
from rdstitch.geometry.planar_motion import rotation_from_tilt
from rdstitch.tracking.placement import HEIGHT, YAW, Placement, PlaneSimilarity, X, Y

# A side of an image: errors of one cell share a part that comes of the lens and the pixels of a place; 4, 16: the same.
_CELLS = 8


@dataclass(frozen=True)
class MetricPlane:
    """Focal length and tilt of a camera that moves over a plane."""

    focal: float  # half diagonals
    tilt: tuple[float, float]  # (ψ, θ), radians, of all frames, or of the mount of what measures attitudes
    rigid: bool  # whether the height stays
    tilt_std: float | None = None  # radians, by this focal length; None: exact, whatever the focal length is

    def bend_std(self, length_std: float | None) -> float:
        """Standard deviation of a path across, relative to its length: paths bend by what tilts are wrong by.

        A tilt that is taken for exact belongs to a focal length that is wrong by ``length_std``.
        """
        if self.tilt_std is not None or length_std is None or not math.isfinite(length_std):
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
        """Place a frame that is ``below`` by places (N, 2) on the map of its points (N, 2), pixels; with a covariance.

        That (4, 4) is of x, y, height and yaw. It takes the places for exact, but not the tilts: where these err by
        ``tilt_std``, radians, from frame to frame, that turns the frame and the one that gives the places.
        """
        local = frame.to_plane(points)
        moved = PlaneSimilarity.fitted(local, places, keep_size=self.rigid)
        # As complex numbers: places = turn * local + shift, with turn = height exp(-i yaw).
        source = local @ np.array([1.0, 1.0j])
        errors = places @ [1.0, 1.0j] - moved.turn * source - moved.shift
        squares = _squared_errors(errors, points, frame.camera.image_size)
        variance = squares / max(2 * len(points) - (3 if self.rigid else 4), 1)
        return moved.applied(frame), self._pose_covariance(source, moved.turn, variance, tilt_std)

    def _pose_covariance(
        self, local: NDArray[np.complex128], turn: complex, variance: float, tilt_std: float
    ) -> FloatArray:
        """Covariance (4, 4) by a frame's points (N,), relative to its foot, each with so much variance on the map."""
        middle, height = complex(local.mean()), abs(turn)
        around = local - middle
        spread = max(float((abs(turn * around) ** 2).sum()), 1e-300)
        # A tilt by a small angle moves a point s by its product with the angle and a coordinate of s. Where frames
        # follow one another, that of one turns both those before it and those after it, to the same side.
        by_tilts = [np.vdot(around, axis * local).imag * height**2 / spread for axis in (local.real, local.imag)]
        yaw_variance = variance / spread + (2.0 * tilt_std * math.hypot(*by_tilts)) ** 2
        height_variance = 0.0 if self.rigid else variance / spread * height**2
        of_middle = np.diag([variance / len(local), variance / len(local), height_variance, yaw_variance])
        lever = turn * middle  # from the camera's foot to the middle of the points
        # The foot moves with the middle, by the turn (-yaw) and by the height about it.
        to_foot = np.eye(4)
        to_foot[[X, Y], HEIGHT] = -lever.real / height, -lever.imag / height
        to_foot[[X, Y], YAW] = -lever.imag, lever.real
        return np.asarray(to_foot @ of_middle @ to_foot.T)


def _squared_errors(errors: NDArray[np.complex128], points: FloatArray, image_size: tuple[int, int]) -> float:
    """Sum of squared errors (N,) at pixels (N, 2): the part that a cell's errors share does not average out."""
    cell = np.floor(points * _CELLS / image_size).astype(np.intp)
    cells = np.unique(cell @ [1, 1 << 16], return_inverse=True)[1].reshape(-1)
    sums = np.bincount(cells, errors.real) ** 2 + np.bincount(cells, errors.imag) ** 2
    return max(float((abs(errors) ** 2).sum()), float(sums.sum()))


def chained(before: FloatArray, step: FloatArray, offset: tuple[float, float], height: float) -> FloatArray:
    """Covariance (4, 4) of a frame, by ``before`` of the frame that it was placed by, which is ``offset`` behind it."""
    dx, dy = offset
    carried = np.eye(4)
    carried[[X, Y], YAW] = dy, -dx  # yaw turns the map by minus itself, y being down
    carried[[X, Y], HEIGHT] = dx / height, dy / height
    return np.asarray(carried @ before @ carried.T + step)
