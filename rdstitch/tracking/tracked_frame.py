"""A frame while it is tracked, and what is known of it afterwards."""

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from rdstitch.arrays import BoolArray, FloatArray
from rdstitch.features import Features
from rdstitch.features.corner_flow import corners_of
from rdstitch.features.prepared_image import PreparedImage
from rdstitch.geometry.camera import Camera
from rdstitch.geometry.radial_homography import from_plane
from rdstitch.inputs.odometry import BodyPose
from rdstitch.tracking.placement import CameraPose, Placement

MIN_INLIERS = 15
_GRID = 8  # points a side by which it is measured how much two frames share


@dataclass(frozen=True)
class Tracked:
    """The result of one frame."""

    number: int = -1  # of the frame, in the order of arrival; -1 where it could not be read
    placement: Placement | None = None  # where it lies on the plane of its map; None where that is not known
    # distortion, distortion_std: λ by all frames up to this one, half-diagonal frame; NaN and inf where it cannot be
    # seen
    distortion: float = math.nan
    distortion_std: float = math.inf
    distortion_known: bool = False  # whether λ was given, or is so certain that it is kept from now on
    map_number: int | None = None  # maps have no common plane: a new one begins where the track was lost
    keyframe: bool = False
    inliers: int = 0  # matches with the last keyframes that agree
    revised: bool = False  # whether the frame had come before, and has its place, or another one, only now
    quality: float = 0.0  # share of the matches that agree
    # (4, 4): of x, y, height and yaw, in units of the first keyframe's height and radians, relative to that; without
    # what all lengths share. None where there is no metric pose
    covariance: FloatArray | None = field(default=None, repr=False, compare=False)
    length_std: float = math.nan  # relative standard deviation that all lengths share
    # unit, unit_std: the height of the first keyframe by odometry, and its relative standard deviation
    unit: float = math.nan
    unit_std: float = math.nan
    reason: str = ""  # why there is no place; empty where there is one

    @property
    def pose(self) -> CameraPose | None:
        """Pose of the camera, where its place is known and the model has poses."""
        return None if self.placement is None else self.placement.pose


@dataclass(eq=False)
class TrackedFrame:
    """A frame, and what is known of its place so far."""

    number: int
    camera: Camera
    image: PreparedImage
    detect: Callable[[PreparedImage], Features]
    attitude: FloatArray | None = None  # (S, 2): (ψ, θ) as measured at DELAYS, radians
    body: BodyPose | None = None  # by odometry
    place: Placement | None = None  # relative to the other keyframes, from the first one on
    aligned: bool = False  # whether that is on the plane of the map
    keyframe: bool = False
    covariance: FloatArray | None = None
    quality: float = 0.0
    static: Callable[[FloatArray], BoolArray] = lambda points: np.zeros(len(points), dtype=np.bool_)

    @cached_property
    def corners(self) -> FloatArray:
        """Corners (N, 2), by which it is matched where one knows about where it lies."""
        corners = corners_of(self.image)
        return corners[~self.static(corners)]

    @cached_property
    def features(self) -> Features:
        """Features, by which it is matched where one does not."""
        features = self.detect(self.image)
        return features.take(np.flatnonzero(~self.static(features.points)))

    def unplace(self) -> None:
        """Forget its place."""
        self.place, self.aligned, self.covariance = None, False, None

    @property
    def seen_from(self) -> tuple[complex, float, BodyPose | None] | None:
        """Place of the camera on the map, x to the right and y to the top, and its yaw, with the body's pose."""
        pose = self.place.pose if self.aligned and self.place is not None else None
        return None if pose is None else (complex(pose.x, -pose.y), pose.yaw, self.body)

    @property
    def textured(self) -> bool:
        """Whether it shows enough to be placed by."""
        return len(self.corners) >= MIN_INLIERS or len(self.features) >= MIN_INLIERS

    def motion_to(self, other: "TrackedFrame", points: FloatArray) -> FloatArray:
        """Where another frame shows points (N, 2) of this one, by the places of both."""
        assert self.place is not None
        assert other.place is not None
        return from_plane(other.place.camera, other.place.homography, self.place.to_plane(points))

    def share_shown_by(self, other: "TrackedFrame") -> float:
        """Share of the frame that another one shows; 0 where its place is not known."""
        if self.place is None:
            return 0.0
        axes = [(np.arange(_GRID) + 0.5) * side / _GRID - 0.5 for side in self.camera.image_size]
        points = self.motion_to(other, np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, 2))
        inside = (points >= 0.0).all(axis=1) & (points <= np.array(other.camera.image_size) - 1.0).all(axis=1)
        return float(inside.mean())
