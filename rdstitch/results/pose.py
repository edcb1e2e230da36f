"""The pose of one frame of a camera that is followed, as it is printed."""

import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from rdstitch.arrays import FloatArray
from rdstitch.choices import TrajectoryFrame
from rdstitch.geometry.path_frames import covariance_in_frame, in_frame, ros_covariance
from rdstitch.options.option import Options, Range, documented, option
from rdstitch.results.messages import Message
from rdstitch.tracking import TrackingResult


@documented
@dataclass(frozen=True)
class FollowedPoses(Options):
    """How poses are printed: as :func:`rdstitch.trajectory` writes them."""

    height: float | None = option(
        None,
        "Of the first keyframe above the plane, in the unit that positions shall have; else as odometry says, or 1.",
        within=Range(above=0.0),
    )
    frame: TrajectoryFrame = option("enu", "See :mod:`rdstitch.geometry.path_frames`.")


@dataclass(frozen=True)
class Pose:
    """What is known of one frame when it has arrived; false where that is no place.

    Attributes
    ----------
    name : str
    number : int
        In the video, camera or stream that it comes from, else in the order of arrival.
    timestamp : float
        s; NaN where not known.
    tracked : TrackingResult
        Its place and λ, as far as they are known.
    problem : str
        Why the frame was not tracked at all; empty where it was.
    poses : FollowedPoses
        How the pose is printed.
    messages : tuple of Message
        What the user should know, and what this frame has shown.
    """

    name: str
    number: int
    timestamp: float
    tracked: TrackingResult = field(default_factory=TrackingResult)
    problem: str = ""
    poses: FollowedPoses = FollowedPoses()
    messages: tuple[Message, ...] = ()

    def __bool__(self) -> bool:
        return self.tracked.pose is not None

    @property
    def reason(self) -> str:
        """Why there is no place; empty where there is one."""
        return self.problem or self.tracked.reason

    @property
    def unit(self) -> float:
        """How long the height of the first keyframe is: as given, else as odometry says, else one."""
        return self.poses.height or self.tracked.unit or 1.0

    @property
    def _by_odometry(self) -> bool:
        """Whether odometry says how long the unit is."""
        return not self.poses.height and self.tracked.unit is not None

    @property
    def length_std(self) -> float:
        """Relative standard deviation that all lengths share, by focal length or odometry; NaN where not known."""
        std = self.tracked.unit_std if self._by_odometry else self.tracked.length_std
        return math.nan if std is None else std

    @property
    def position(self) -> tuple[float, float, float] | None:
        """X, y and height above the plane, in the frame and unit of the tracker; None where there is no place."""
        if (pose := self.tracked.pose) is None:
            return None
        return *in_frame(pose.x * self.unit, pose.y * self.unit, self.poses.frame), pose.height * self.unit

    @property
    def yaw(self) -> float | None:
        """Heading, radians, counterclockwise as seen from above; None where there is no place."""
        return None if self.tracked.pose is None else self.tracked.pose.yaw

    @property
    def covariance(self) -> FloatArray | None:
        """Of x, y, height and yaw, (4, 4), in the frame and unit of the tracker and radians; None where not known.

        Relative to the first keyframe, with the growth of the errors from keyframe to keyframe and the scale that all
        share.
        """
        known = self._covariance
        return None if known is None else covariance_in_frame(known, self.poses.frame)

    @property
    def ros_covariance(self) -> FloatArray | None:
        """The same as messages of ROS have it, (6, 6); see :func:`rdstitch.geometry.path_frames.ros_covariance`."""
        known = self._covariance
        return None if known is None else ros_covariance(known, self.poses.frame)

    @property
    def _covariance(self) -> FloatArray | None:
        """In the axes of the first image."""
        if (pose := self.tracked.pose) is None or self.tracked.covariance is None:
            return None
        # A height that is given, and is the unit, is exact.
        height = pose.height if self._by_odometry else 0.0
        place, unit = np.array([pose.x, pose.y, height, 0.0]), np.array([self.unit] * 3 + [1.0])
        shared = 0.0 if math.isnan(self.length_std) else self.length_std
        covariance = self.tracked.covariance + shared**2 * np.outer(place, place)
        # In another unit than its own it is as uncertain as lengths by images, besides.
        covariance[2, 2] += ((self.tracked.length_std or 0.0) * height) ** 2
        return np.asarray(covariance * np.outer(unit, unit))

    @property
    def map(self) -> int | None:
        """Number of the map that the pose belongs to: those of different maps have nothing in common."""
        return self.tracked.map_number

    @property
    def quality(self) -> float:
        """Share of the matches that agree, 0 to 1."""
        return self.tracked.quality if self else 0.0

    def as_dict(self) -> dict[str, Any]:
        """As a line of JSON takes it; null for what is not known."""
        tracked, covariance = self.tracked, self.ros_covariance
        x, y, height = self.position or (None, None, None)
        return {
            "name": self.name,
            "frame": self.number,
            "timestamp": _known(self.timestamp),
            "x": x,
            "y": y,
            "yaw_deg": None if self.yaw is None else math.degrees(self.yaw),
            "yaw": self.yaw,
            "height": height,
            "covariance": None if covariance is None else covariance.ravel().tolist(),
            "length_std": _known(self.length_std),
            "quality": self.quality,
            "homography": None if tracked.placement is None else tracked.placement.homography.tolist(),
            "lambda": _known(tracked.distortion),
            "lambda_std": _known(tracked.distortion_std),
            "lambda_known": tracked.distortion_known,
            "map": tracked.map_number,
            "keyframe": tracked.keyframe,
            "inliers": tracked.inliers,
            "revised": tracked.revised,
            "reason": self.reason,
            "messages": [str(message) for message in self.messages],
        }


def _known(value: float) -> float | None:
    return value if math.isfinite(value) else None
