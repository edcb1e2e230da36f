"""The reference image of an alignment, in whose frame everything is turned upright."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np

from rdstitch.alignment.frames.vanishing_points import Edges, Focal, Upright, nearest_axis, of_edges, to_axes
from rdstitch.arrays import FloatArray
from rdstitch.errors import ArgumentError
from rdstitch.geometry.camera import Camera
from rdstitch.geometry.planar_motion import nearest_rotation, rotation_about
from rdstitch.options.upright_options import UprightOptions

_STEEP = math.cos(math.radians(30.0))  # a camera that looks nearer to straight up or down shows nothing upright


def view_rotation(options: UprightOptions) -> FloatArray | None:
    """Rotation (3, 3) by which what is yaw degrees to the right and pitch degrees up comes straight ahead, if any."""
    yaw, pitch, roll = np.radians([options.yaw, options.pitch, options.roll])
    if not (yaw or pitch or roll):
        return None
    return (rotation_about((0.0, yaw, 0.0)) @ rotation_about((pitch, 0.0, 0.0)) @ rotation_about((0.0, 0.0, roll))).T


@dataclass(frozen=True, eq=False)
class ReferenceView:
    """The camera of the reference image, and where it looks."""

    camera: Camera
    frame: FloatArray  # (3, 3): its undistorted coordinates to the plane, or to directions
    focal: Focal
    turned: bool  # whether the camera turned on the spot, so that there are directions

    @classmethod
    def of(cls, camera: Camera, frame: FloatArray, *, turned: bool) -> Self:
        """With the focal length that the alignment has, or that is known or guessed."""
        if turned:
            lengths = np.linalg.norm(frame, axis=0)
            return cls(camera, frame, Focal(float(lengths[2] / lengths[0])), turned)
        known = camera.with_guessed_focal()
        assert known.focal is not None
        return cls(camera, frame, Focal(known.focal / known.scale, known.focal_log_std), turned)

    @property
    def start(self) -> FloatArray:
        """Its axes (3, 3) as a rotation, where a search for those of the scene begins."""
        return nearest_rotation(np.asarray(np.linalg.inv(to_axes(self.frame, self.focal.value))))

    def undistorted(self, points: FloatArray) -> FloatArray:
        """Undistorted places (N, 2) of its pixels, half diagonals from its centre."""
        flat = self.camera.normalize(self.camera.undistort(points))
        if not np.isfinite(flat).all():
            raise ArgumentError(
                "rectangle, straighten: a place lies where the lens of the reference image shows nothing"
            )
        return flat

    def edges(self, ends: FloatArray, error: float) -> Edges:
        """Edges by their ends (N, 2, 3) in it, undistorted."""
        if not self.turned:
            return Edges.between(ends[(ends[:, :, 2] > 0.0).all(axis=1)], error)
        focal = self.focal.value
        return Edges.between(ends * (1.0, 1.0, focal), error / focal, on_sphere=True)

    def upright_by_lines(self, ends: FloatArray, error: float) -> Upright:
        """By ends (2 L, 2), pixels, of lines that are upright or level in the scene, each off by ``error`` pixels."""
        lines, start, focal = self.undistorted(ends).reshape(-1, 2, 2), self.start, self.focal
        homogeneous = np.concatenate([lines, np.ones((len(lines), 2, 1))], axis=2)
        edges = self.edges(homogeneous, error / self.camera.scale)
        return of_edges(edges, nearest_axis(edges, start[:2], focal.value), start, focal, focal.value)

    def upright_by_gravity(
        self, homographies: FloatArray, measured: Sequence[tuple[float, float, float] | None]
    ) -> Upright | None:
        """By the direction down in the axes of some cameras, or that of most images; None where that is ahead.

        ``homographies`` (N, 3, 3) lead from undistorted coordinates of images to the plane.
        """
        calibration = np.diag([1.0, 1.0, self.focal.value])
        known = any(down is not None for down in measured)
        directions = [
            np.sign(matrix[2, 2]) * calibration @ matrix @ np.linalg.inv(calibration) @ (down or (0.0, 1.0, 0.0))
            for matrix, down in zip(np.linalg.inv(self.frame) @ homographies, measured, strict=True)
            if down is not None or not known
        ]
        down = np.mean([direction / np.linalg.norm(direction) for direction in directions], axis=0)
        down /= np.linalg.norm(down)
        ahead = self.start[2]
        if abs(down @ ahead) > _STEEP:
            return None
        if not known:
            down -= (down @ ahead) * ahead
            down /= np.linalg.norm(down)
        right = np.cross(down, ahead)
        return Upright(np.stack([right / np.linalg.norm(right), down]), self.focal)
