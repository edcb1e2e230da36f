"""Knowledge of a tracker about its camera so far: the lens, the focal length, the tilt, and how late attitudes are."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import Enum, auto
from typing import NamedTuple, Self

import numpy as np

from rdstitch.alignment import Alignment, AlignmentOptions
from rdstitch.alignment.delays import at_delay, change_with_delay
from rdstitch.alignment.given_checks import judged_focal
from rdstitch.alignment.motion_models import MODELS, MotionModel
from rdstitch.arrays import FloatArray
from rdstitch.choices import ModelName
from rdstitch.geometry.camera import Camera
from rdstitch.inputs.delays import DELAY_STD
from rdstitch.matching.distortion_consensus import vote
from rdstitch.matching.links import Link
from rdstitch.robust import EstimationOptions
from rdstitch.tracking.metric_plane import MetricPlane
from rdstitch.tracking.placement import YAW, CameraPose, Placement
from rdstitch.tracking.tracked_frame import IncomingFrame, TrackedFrame
from rdstitch.trajectories.trajectory import Trajectory

_KNOWN_STD = 0.002  # of λ: a tenth of a pixel in the corner of an image of 640 x 480 pixels, over half of it
_MIN_KEYFRAMES_FOR_LENS = 12  # keyframes that λ is not known before


class Estimate(NamedTuple):
    """A number and its standard deviation."""

    value: float
    std: float


_USUAL_DELAY = Estimate(0.0, DELAY_STD)


class ShapeStd(NamedTuple):
    """Standard deviations of the shape of a path, by a lens that is still estimated."""

    across: float  # of positions across the path, relative to their distance from the first
    yaw: float  # radians


class FocalOrigin(Enum):
    """Origin of the focal length of a map."""

    GIVEN = auto()  # the user, whom images do not contradict
    MOTION = auto()  # the motions between keyframes, which contradict the user
    ALIGNMENT = auto()  # the alignment of keyframes, where nothing was given


@dataclass(frozen=True)
class FocalLength:
    """The focal length of a map, which determines all lengths on it."""

    value: float  # half diagonals
    log_std: float | None  # of its logarithm, and so of all lengths, relative; None where not known
    origin: FocalOrigin
    reported_std: float | None = None  # of a given one: what ``log_std`` was when all frames were given last


@dataclass(frozen=True)
class CameraKnowledge:
    """Knowledge about the camera whose frames are tracked; each step that adds to it gives the next one."""

    given: AlignmentOptions
    pair: EstimationOptions  # with λ, once it is known
    model: ModelName  # of the motion
    distortion: Estimate | None  # λ, half-diagonal frame; None where nothing shows it yet; std 0 where it was given
    focal: FocalLength | None = None
    shape_std: ShapeStd | None = None
    delay: Estimate = _USUAL_DELAY  # s, by which the times of attitudes are late
    plane: MetricPlane | None = None

    @classmethod
    def of(cls, given: AlignmentOptions, pair: EstimationOptions) -> Self:
        """Start with what the user says, before the first frame."""
        return cls(given, pair, given.model, None if pair.distortion is None else Estimate(pair.distortion, 0.0))

    @property
    def distortion_known(self) -> bool:
        """True where λ was given, or is known well enough to be kept."""
        return self.pair.distortion is not None

    @property
    def length_std(self) -> float | None:
        """Relative standard deviation that all lengths share."""
        return None if self.focal is None else self.focal.log_std

    @property
    def one_tilt_model(self) -> MotionModel | None:
        """The motion model, the least free one while none was chosen; None where frames have tilts of their own."""
        model = MODELS["rigid" if self.model == "auto" else self.model]
        return model if model.has_metric_poses and not model.free_tilts else None

    def camera_of(self, frame: IncomingFrame) -> Camera:
        """The camera of a frame, with the lens as it is known so far."""
        if self.given.lens_known:
            return frame.camera
        return frame.camera.with_coefficients(0.0 if self.distortion is None else self.distortion.value)

    def camera_with_lens_of(self, other: Placement, frame: IncomingFrame) -> Camera:
        """The camera of a frame, with the lens that another one was placed with."""
        return frame.camera if self.given.lens_known else frame.camera.with_coefficients(*other.camera.coefficients)

    def is_metric(self, camera: Camera) -> bool:
        """Whether lens and focal length of a camera are given."""
        return self.given.lens_known and camera.focal is not None and camera.focal_source in ("option", "file")

    def attitude(self, frame: IncomingFrame) -> tuple[float, float] | None:
        """(ψ, θ), radians, as measured when the frame was taken."""
        if frame.attitude is None:
            return None
        psi, theta = at_delay(frame.attitude, self.delay.value).tolist()
        return psi, theta

    def attitude_std(self, frame: IncomingFrame) -> float:
        """Standard deviation of a measured attitude, radians, with what the delay leaves open."""
        assert frame.attitude is not None
        late = self.delay.std * float(change_with_delay(frame.attitude).max())
        return math.hypot(self.given.attitudes_std, late)

    def cameras_for(self, keyframes: Sequence[IncomingFrame], focal_std: float | None) -> list[Camera]:
        """Cameras for an alignment of keyframes, with the focal length of the map if it is to be kept so closely."""
        cameras = [keyframe.camera.with_guessed_focal() for keyframe in keyframes]
        if self.pair.distortion is not None and not self.given.lens_known:
            cameras = [camera.with_coefficients(self.pair.distortion) for camera in cameras]
        if self.focal is None or focal_std is None:
            return cameras
        focal = self.focal.value
        return [c.with_focal(focal * c.scale, "file", focal_std * focal * c.scale) for c in cameras]

    def options_for(self, keyframes: Sequence[IncomingFrame]) -> AlignmentOptions:
        """Options for an alignment of keyframes."""
        attitudes, known, std = self._attitudes(keyframes), self.distortion_known, self.given.attitudes_std
        if attitudes is not None:
            std = max(self.attitude_std(keyframe) for keyframe in keyframes)
        return replace(
            self.given,
            model=self.model,
            lens="auto" if known else "division",
            lens_known=known,
            attitudes=attitudes,
            delayed_attitudes=None,
            attitudes_std=std,
            pose_covariance=not known,
        )

    def _attitudes(self, keyframes: Sequence[IncomingFrame]) -> FloatArray | None:
        """(ψ, θ) of each, (N, 2), radians; None unless all were measured."""
        attitudes = [attitude for keyframe in keyframes if (attitude := self.attitude(keyframe)) is not None]
        return np.array(attitudes) if len(attitudes) == len(keyframes) else None

    def with_given_focal(self, camera: Camera) -> Self:
        """Adopt the given focal length and tilt: with both, poses are metric from the second frame on."""
        contradicted = self.focal is not None and self.focal.origin is FocalOrigin.MOTION
        if contradicted or not self.is_metric(camera) or (model := self.one_tilt_model) is None:
            return self
        assert camera.focal is not None
        log_std, _ = judged_focal(camera.focal_log_std, 0.0, math.inf)
        focal = FocalLength(camera.focal / camera.scale, log_std, FocalOrigin.GIVEN, log_std)
        if (tilt := self.given.tilt) is None:
            return replace(self, focal=focal)
        return replace(self, focal=focal, model=model.name, plane=MetricPlane(focal.value, tilt, model.keeps_height))

    def with_votes(self, links: Sequence[Link]) -> Self:
        """Estimate λ from the pairs alone, until there is an alignment."""
        if self.distortion_known:
            return self
        relations = [link.relation for link in links]
        consensus = vote([r.distortion for r in relations], [r.distortion_std for r in relations])
        seen = math.isfinite(consensus.std)
        return replace(self, distortion=Estimate(consensus.distortion, consensus.std) if seen else None)

    def with_alignment(self, alignment: Alignment, keyframes: Sequence[IncomingFrame], *, keeps_focal: bool) -> Self:
        """Adopt what an alignment of keyframes shows of the camera, for the frames to come."""
        distortion, pair, known = self.distortion, self.pair, self.distortion_known
        focal, std = self.focal, None if math.isnan(alignment.length_std) else alignment.length_std
        if not keeps_focal:
            focal = None if alignment.focal is None else FocalLength(alignment.focal, std, FocalOrigin.ALIGNMENT)
        if not known:
            if alignment.distortion_std < (math.inf if distortion is None else distortion.std):
                distortion = Estimate(alignment.distortion, alignment.distortion_std)
            if distortion is not None and distortion.std <= _KNOWN_STD and len(keyframes) >= _MIN_KEYFRAMES_FOR_LENS:
                known, pair = True, replace(pair, distortion=distortion.value, solver="auto")
        return replace(
            self,
            pair=pair,
            model=alignment.model if known else self.model,
            distortion=distortion,
            focal=focal,
            shape_std=_shape_std(alignment),
            plane=self._aligned_plane(alignment, focal, self._attitudes(keyframes)),
        )

    def _aligned_plane(
        self, alignment: Alignment, focal: FocalLength | None, attitudes: FloatArray | None
    ) -> MetricPlane | None:
        """The plane that an alignment shows a camera to move over, by its attitudes (N, 2) where these are known."""
        poses, tilt, model = alignment.poses, alignment.tilt, MODELS[alignment.model]
        tilts_known = model.has_metric_poses and not model.any_tilt and not (model.free_tilts and attitudes is None)
        if not tilts_known or poses is None or not tilt or focal is None:
            return None
        if attitudes is not None:
            tilt = np.nanmedian(poses.tilt - attitudes, axis=0).tolist()
        given = self.given.tilt is not None
        tilt_std = None if given else math.sqrt(float(np.trace(alignment.covariance[:2, :2])))
        return MetricPlane(focal.value, (tilt[0], tilt[1]), model.keeps_height, tilt_std)

    def covariance(self, placed: TrackedFrame, pose: CameraPose) -> FloatArray | None:
        """Covariance (4, 4) of a frame's pose, with what all frames have in common but for the unit of lengths."""
        covariance, shape = placed.covariance, self.shape_std
        if covariance is None:
            if shape is None:
                return None
            covariance = np.zeros((4, 4))
        if shape is None:
            bend = 0.0 if self.plane is None else self.plane.bend_std(self.length_std)
            shape = ShapeStd(bend, bend)
        place = (shape.across * math.hypot(pose.x, pose.y)) ** 2
        if placed.frame.attitude is not None:
            # The foot of the camera is off by the error of its tilt, and so is that of the first frame.
            place += 2.0 * (pose.height * self.attitude_std(placed.frame)) ** 2
        return np.asarray(covariance + np.diag([place, place, 0.0, shape.yaw**2]))


def _shape_std(alignment: Alignment) -> ShapeStd | None:
    """Uncertainty of the shape of an aligned path; None where the alignment does not say, or goes nowhere."""
    if alignment.poses is None or alignment.poses.covariance is None:
        return None
    path = Trajectory.from_poses(alignment.poses)
    distance = np.linalg.norm(path.position, axis=1)
    farthest = int(np.argmax(distance))
    if path.covariance is None or not distance[farthest] > 0.0:
        return None
    # Across: along it is what all lengths share.
    variance = float(np.linalg.eigvalsh(path.covariance[farthest, :2, :2])[0]) / distance[farthest] ** 2
    return ShapeStd(math.sqrt(max(variance, 0.0)), math.sqrt(float(path.covariance[:, YAW, YAW].max())))
