"""The place of an image on the plane of the map, and similarities between the planes of two alignments."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Self

import numpy as np

from rdstitch.arrays import FloatArray
from rdstitch.geometry.camera import Camera
from rdstitch.geometry.planar_motion import nearest_rotation
from rdstitch.geometry.radial_homography import to_plane

_SAMPLES = 5  # points of an image's outline, a side, by which two planes are brought together


# Rows of a pose's covariance (4, 4).
X, Y, HEIGHT, YAW = range(4)


@dataclass(frozen=True)
class CameraPose:
    """The place and heading of the camera."""

    x: float  # x, y: in units of the first keyframe's height, as the first keyframe sees them
    y: float
    yaw: float  # φ, radians
    height: float  # in the same unit


@dataclass(frozen=True, eq=False)
class Placement:
    """An image on the plane."""

    camera: Camera  # with the λ that the homography belongs to
    homography: FloatArray  # (3, 3): from undistorted normalized coordinates of the image to the plane
    focal: float | None  # focal length in half diagonals; None where the model has none

    def to_plane(self, points: FloatArray) -> FloatArray:
        """Map points (N, 2) of the image, pixels, to the plane."""
        return to_plane(self.camera, self.homography, points)

    @cached_property
    def pose(self) -> CameraPose | None:
        """Pose of the camera over the plane; None where its focal length is not known.

        ``P ~ diag(f, f, 1) R [e1, e2, h e3 - t]`` gives the columns of R, the position t and the height h.
        """
        if self.focal is None or not np.isfinite(self.homography).all():
            return None
        columns = np.linalg.inv(self.homography) / np.array([[self.focal], [self.focal], [1.0]])
        columns /= math.copysign(float(np.linalg.norm(columns[:, :2]) / math.sqrt(2.0)), np.linalg.det(columns))
        first, second, last = columns.T
        # The nearest rotation, since the homography of an image on its own has none exactly.
        rotation = nearest_rotation(np.column_stack([first, second, np.cross(first, second)]))
        x, y, height = rotation.T @ last * np.array([-1.0, -1.0, 1.0])
        return CameraPose(float(x), float(y), math.atan2(-rotation[0, 1], rotation[0, 0]), float(height))


@dataclass(frozen=True)
class PlaneSimilarity:
    """Similarity of the plane, ``X -> a X + b`` with complex a and b."""

    turn: complex
    shift: complex

    @classmethod
    def fitted(cls, before: FloatArray, after: FloatArray, *, keep_size: bool = False) -> Self:
        """The similarity that brings points (N, 2) nearest to others (N, 2), in the sense of least squares."""
        start, end = (points @ np.array([1.0, 1.0j]) for points in (before, after))
        middle, goal = complex(start.mean()), complex(end.mean())
        turn = complex(np.vdot(start - middle, end - goal)) / max(
            float(np.vdot(start - middle, start - middle).real), 1e-300
        )
        if keep_size:
            turn /= max(abs(turn), 1e-300)
        return cls(turn, goal - turn * middle)

    @classmethod
    def to_origin(cls, pose: CameraPose) -> Self:
        """The similarity that brings a camera to the origin, with yaw zero and height one."""
        turn = complex(math.cos(pose.yaw), math.sin(pose.yaw)) / pose.height
        return cls(turn, -turn * complex(pose.x, pose.y))

    @classmethod
    def between(cls, before: Sequence[Placement], after: Sequence[Placement]) -> Self:
        """The similarity that brings the plane of some placements to that of others of the same images."""
        source, target = (
            np.concatenate([placed.to_plane(placed.camera.outline(_SAMPLES)) for placed in side])
            for side in (before, after)
        )
        seen = np.isfinite(source).all(axis=1) & np.isfinite(target).all(axis=1)
        return cls.fitted(source[seen], target[seen])

    @property
    def matrix(self) -> FloatArray:
        """The similarity as a homography (3, 3)."""
        a, b = self.turn, self.shift
        return np.array([[a.real, -a.imag, b.real], [a.imag, a.real, b.imag], [0.0, 0.0, 1.0]])

    def applied(self, placed: Placement) -> Placement:
        """Place an image where it lies after the plane was moved."""
        return Placement(placed.camera, self.matrix @ placed.homography, placed.focal)
