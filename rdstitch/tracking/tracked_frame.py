"""A frame while it is tracked, and its result."""

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from rdstitch.arrays import BoolArray, FloatArray
from rdstitch.features import Features
from rdstitch.features.corner_flow import corners_of, is_static
from rdstitch.features.prepared_image import PreparedImage, View, prepare
from rdstitch.geometry.camera import Camera
from rdstitch.geometry.radial_homography import from_plane
from rdstitch.inputs.odometry import BodyPose
from rdstitch.tracking.placement import CameraPose, Placement
from rdstitch.tracking.tracking_state import TrackingState

MIN_INLIERS = 15  # matches by which a frame is placed or linked
_GRID = 8  # points a side by which it is measured how much two frames share
_NO_IMAGE = prepare(View(np.zeros((1, 1), np.uint8)), None)


@dataclass(frozen=True)
class TrackingResult:
    """The result of one frame."""

    number: int | None = None  # of the frame, in the order of arrival; None where it could not be read
    placement: Placement | None = None  # where it lies on the plane of its map; None where that is not known
    distortion: float = math.nan  # λ by all frames up to this one, half-diagonal frame; NaN where it cannot be seen
    distortion_std: float = math.inf
    distortion_known: bool = False  # whether λ was given, or is so certain that it is kept from now on
    map_number: int | None = None  # maps have no common plane: a new one begins where the track was lost
    keyframe: bool = False
    inliers: int = 0  # matches with the last keyframes that agree
    revised: bool = False  # whether the frame had come before, and has its place, or another one, only now
    quality: float = 0.0  # fraction of the matches that agree
    # (4, 4): of x, y, height and yaw, in units of the first keyframe's height and radians, relative to that; without
    # what all lengths share. None where there is no metric pose
    covariance: FloatArray | None = field(default=None, repr=False, compare=False)
    length_std: float | None = None  # relative standard deviation that all lengths share
    unit: float | None = None  # height of the first keyframe by odometry
    unit_std: float | None = None  # relative
    state: TrackingState = TrackingState.UNREAD

    @property
    def reason(self) -> str:
        """Why there is no place; empty where there is one."""
        return self.state.value

    @property
    def pose(self) -> CameraPose | None:
        """Pose of the camera, where its place is known and the model has poses."""
        return None if self.placement is None else self.placement.pose


@dataclass(frozen=True, eq=False)
class IncomingFrame:
    """A frame as it came, with what was measured at its time."""

    number: int
    camera: Camera
    image: PreparedImage
    detect: Callable[[PreparedImage], Features]
    static_places: BoolArray  # (P, P): cells of the image that do not move with the floor
    attitude: FloatArray | None = None  # (S, 2): (ψ, θ) as measured at DELAYS, radians
    body: BodyPose | None = None  # by odometry

    @cached_property
    def corners(self) -> FloatArray:
        """Corners (N, 2), by which it is matched where its place is about known."""
        corners = corners_of(self.image)
        return corners[~is_static(corners, self.image, self.static_places)]

    @cached_property
    def features(self) -> Features:
        """Features, by which it is matched where its place is not known."""
        features = self.detect(self.image)
        return features.take(np.flatnonzero(~is_static(features.points, self.image, self.static_places)))

    @property
    def textured(self) -> bool:
        """Whether it shows enough to be placed by."""
        return len(self.corners) >= MIN_INLIERS or len(self.features) >= MIN_INLIERS

    def without_image(self) -> "IncomingFrame":
        """The frame once its corners and features are no longer needed."""
        return replace(self, image=_NO_IMAGE)


@dataclass(eq=False)
class TrackedFrame:
    """A frame with its place relative to the keyframes, which its map may revise."""

    frame: IncomingFrame
    placement: Placement
    aligned: bool = False  # whether that is on the plane of the map
    covariance: FloatArray | None = None  # (4, 4): of x, y, height and yaw; None: not known
    inliers: BoolArray = field(default_factory=lambda: np.zeros(0, np.bool_))  # of the matches that it is by
    predicted: bool = False  # by odometry: images have not measured it
    keyframe: bool = False

    @property
    def quality(self) -> float:
        """Fraction of the matches that agree; 0 without any."""
        return float(self.inliers.mean()) if len(self.inliers) else 0.0

    @property
    def pose(self) -> CameraPose | None:
        """Pose of the camera on the map."""
        return self.placement.pose if self.aligned else None

    def move_to(self, other: "TrackedFrame") -> None:
        """Take the place of the same frame where it was placed again."""
        self.placement, self.aligned, self.covariance = other.placement, other.aligned, other.covariance
        self.inliers, self.predicted = other.inliers, other.predicted

    @property
    def number(self) -> int:
        """Number of the frame, in the order of arrival."""
        return self.frame.number

    def points_in(self, other: "TrackedFrame", points: FloatArray) -> FloatArray:
        """Points (N, 2) of this frame as another one shows them, by the places of both."""
        there = other.placement
        return from_plane(there.camera, there.homography, self.placement.to_plane(points))

    def overlap_with(self, other: "TrackedFrame") -> float:
        """Fraction of the frame that another one shows."""
        axes = [(np.arange(_GRID) + 0.5) * side / _GRID - 0.5 for side in self.frame.camera.image_size]
        points = self.points_in(other, np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, 2))
        inside = (points >= 0.0).all(axis=1) & (points <= np.array(other.frame.camera.image_size) - 1.0).all(axis=1)
        return float(inside.mean())
