"""The part of an oblique image that is drawn: that which is not much coarser than the reference image.

A plane seen obliquely gets coarser towards the horizon, along the line of sight with the square of the distance. The
distance is one over the third coordinate of ``G p``, undistorted points p of the image mapped to the plane; so a limit
on the stretch is, in undistorted coordinates, a straight line parallel to the horizon. What the lens itself stretches,
towards the corners of a wide-angle image, does not count.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from rdstitch.arrays import BoolArray, FloatArray
from rdstitch.geometry.camera import Camera, points_over
from rdstitch.io.read import DecodedImage

PROBES = 33  # points of a grid over the image, and along its outline, a side, at which the stretch is measured
POINTS_PER_SIDE = 64
"""Of an outline: straight sides are curved after undistortion; so the extremes are within 0.02 pixels on 4000."""

_ROWS = 64  # rows of a mask that are computed at a time, so that they stay in the processor's cache


@dataclass(frozen=True, eq=False)
class VisibleRegion:
    """The part of an image that is drawn."""

    camera: Camera
    # (3,): what is drawn has ``depth · (x, y, 1) > 0``; x, y undistorted, in half diagonals from the distortion centre
    depth: FloatArray

    def outline(self) -> FloatArray:
        """Its border, measured pixels (K, 2), clockwise; empty where nothing is drawn."""
        border = self.camera.outline(POINTS_PER_SIDE)
        flat = self.camera.normalize(self.camera.undistort(border))
        inside = self._value(flat) > 0.0
        if inside.all() or not inside.any():
            return border if inside.all() else np.empty((0, 2))
        # Begin where the border comes back from beyond the limit, so that the drawn part is in one piece.
        start = int(np.flatnonzero(inside & ~np.roll(inside, 1))[0])
        border, flat, inside = np.roll(border, -start, axis=0), np.roll(flat, -start, axis=0), np.roll(inside, -start)
        last = int(np.flatnonzero(inside)[-1])
        ends = [self._crossing(flat[last], flat[(last + 1) % len(flat)]), self._crossing(flat[-1], flat[0])]
        cut = ends[0] + np.linspace(0.0, 1.0, POINTS_PER_SIDE)[:, None] * (ends[1] - ends[0])
        measured = np.asarray(self.camera.distort(self.camera.denormalize(cut)))
        kept = border[: last + 1][inside[: last + 1]]
        return np.concatenate([kept, measured[np.isfinite(measured).all(axis=1)]])

    def shows(self, points: FloatArray) -> BoolArray:
        """Which measured pixels (K, 2) are drawn."""
        with np.errstate(invalid="ignore"):
            return np.asarray(self._value(self.camera.normalize(self.camera.undistort(points))) > 0.0)

    def masked(self, image: DecodedImage) -> DecodedImage:
        """The image, whole or reduced, with the rest transparent."""
        height, width = image.pixels.shape[:2]
        camera = self.camera.resized((width, height))
        x = (np.arange(width) - camera.center[0]) / camera.scale
        shown = np.empty((height, width), dtype=np.bool_)
        # In measured coordinates the limit is a conic.
        for top in range(0, height, _ROWS):
            y = ((np.arange(top, min(top + _ROWS, height)) - camera.center[1]) / camera.scale)[:, None]
            radius2 = x**2 + y**2
            lens = np.zeros_like(radius2)
            for coefficient in (*reversed(camera.coefficients), 1.0):  # Horner's scheme, in place
                lens *= radius2
                lens += coefficient
            shown[top : top + _ROWS] = self.depth[0] * x + self.depth[1] * y + self.depth[2] * lens > 0.0
        return replace(image, alpha=np.where(shown, np.uint8(255) if image.alpha is None else image.alpha, np.uint8(0)))

    def _value(self, flat: FloatArray) -> FloatArray:
        """What is positive where undistorted points (K, 2) are drawn."""
        return np.asarray(flat @ self.depth[:2] + self.depth[2])

    def _crossing(self, inside: FloatArray, outside: FloatArray) -> FloatArray:
        """Where the line between two undistorted points meets the limit."""
        a, b = self._value(np.stack([inside, outside]))
        return np.asarray(inside + (outside - inside) * (a / (a - b)))


def visible_regions(
    cameras: Sequence[Camera], homographies: Sequence[FloatArray], resolution: float, max_stretch: float
) -> list[VisibleRegion | None]:
    """What of each image is drawn; None for all of it.

    ``homographies`` lead to the plane, with positive third coordinates in front of the camera; at ``resolution`` canvas
    pixels per unit of it the reference image keeps its size.
    """
    parts: list[VisibleRegion | None] = []
    if max_stretch == np.inf:
        return [None] * len(cameras)
    for camera, matrix in zip(cameras, homographies, strict=True):
        stretch, depth = _stretch(camera, matrix, resolution)
        finest = max(1.0, float(stretch.min()))
        beyond = depth[stretch > max_stretch * finest]
        if not len(beyond):
            parts.append(None)
            continue
        parts.append(VisibleRegion(camera, matrix[2] - np.array([0.0, 0.0, max(float(beyond.max()), 0.0)])))
    return parts


def _stretch(camera: Camera, matrix: FloatArray, resolution: float) -> tuple[FloatArray, FloatArray]:
    """Canvas pixels per undistorted pixel, in the direction in which they are most, and depth, over an image (K,)."""
    grid = points_over(camera.image_size, PROBES)
    drawn = grid[np.linalg.norm(grid - camera.center, axis=1) <= camera.drawn_radius]
    flat = camera.normalize(camera.undistort(np.concatenate([drawn, camera.outline(PROBES)])))
    flat = flat[np.isfinite(flat).all(axis=1)]  # a fisheye may see beyond its horizon
    moved = flat @ matrix[:, :2].T + matrix[:, 2]
    depth: FloatArray = moved[:, 2]
    with np.errstate(all="ignore"):
        plane = moved[:, :2] / depth[:, None]
        jacobian = (matrix[None, :2, :2] - plane[:, :, None] * matrix[None, 2:, :2]) / depth[:, None, None]
        (a, b), (c, d) = jacobian.transpose(1, 2, 0)
        # Its larger singular value: half the sum of two lengths.
        largest = (np.hypot(a + d, b - c) + np.hypot(a - d, b + c)) / 2.0 * resolution / camera.scale
    return np.where(depth > 0.0, largest, np.inf), depth
