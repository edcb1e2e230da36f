"""Places of frames that show no keyframe, by the wheels of the robot that carries the camera."""

import cmath
from collections.abc import Iterable
from dataclasses import dataclass

from rdstitch.inputs.odometry import motion_between
from rdstitch.tracking.camera_knowledge import CameraKnowledge
from rdstitch.tracking.placement import PlaneSimilarity
from rdstitch.tracking.tracked_frame import IncomingFrame, TrackedFrame
from rdstitch.trajectories.odometry_fit import OdometryFit, motions_of

_KEYFRAMES = 60  # the last ones, by which it is found how the camera is mounted on the body


@dataclass
class OdometryPrediction:
    """Mounting of the camera on the body, and the frame from which the wheels go on."""

    mounted: OdometryFit | None = None  # in units of the map
    latest: TrackedFrame | None = None  # of those that had a place and odometry

    @property
    def unit(self) -> tuple[float, float] | tuple[None, None]:
        """Height of the first keyframe in units of the odometry, and its relative standard deviation."""
        return (None, None) if self.mounted is None else (abs(self.mounted.scale), self.mounted.length_std)

    def learn(self, keyframes: Iterable[TrackedFrame]) -> None:
        """Estimate how the camera is mounted, by the keyframes of a map that images have placed."""
        last = sorted(keyframes, key=lambda keyframe: keyframe.number)[-_KEYFRAMES:]
        # x to the right and y to the top; without a body there is no motion to or from a frame.
        poses = [
            (complex(pose.x, -pose.y), pose.yaw, None if keyframe.predicted else keyframe.frame.body)
            for keyframe in last
            if (pose := keyframe.pose) is not None
        ]
        self.mounted = OdometryFit.of(motions_of(poses)) or self.mounted

    def place(self, frame: IncomingFrame, knowledge: CameraKnowledge) -> TrackedFrame | None:
        """Place a frame by its way from the latest one; None where that is not known."""
        last, fit = self.latest, self.mounted
        if last is None or fit is None or frame.body is None or last.frame.body is None or knowledge.plane is None:
            return None
        was = last.pose
        if was is None or last.covariance is None:
            return None
        step = motion_between(last.frame.body, frame.body)
        way, carried, added = fit.moved(was.yaw, step)
        place, yaw = complex(was.x, was.y) + way.conjugate(), was.yaw + step.turn
        below = knowledge.plane.below(last.placement.camera, knowledge.attitude(frame))
        return TrackedFrame(
            frame,
            PlaneSimilarity(was.height * cmath.exp(-1j * yaw), place).applied(below),
            True,
            carried @ last.covariance @ carried.T + added,
            predicted=True,
        )
