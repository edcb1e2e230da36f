"""What a tracker knows of its camera so far: the lens, the focal length, the tilt, and how late attitudes are."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from rdstitch.alignment import Alignment, AlignmentOptions
from rdstitch.alignment.given_checks import judged_focal
from rdstitch.alignment.trajectory import Trajectory
from rdstitch.arrays import FloatArray
from rdstitch.choices import ModelName
from rdstitch.geometry.camera import Camera
from rdstitch.inputs.delays import DELAY_STD, at_delay, change_with_delay
from rdstitch.matching.distortion_consensus import vote
from rdstitch.matching.links import Link
from rdstitch.robust import EstimationOptions
from rdstitch.tracking.metric_plane import MetricPlane
from rdstitch.tracking.placement import YAW, CameraPose, Placement
from rdstitch.tracking.tracked_frame import Frame, TrackedFrame

_KNOWN_STD = 0.002  # of λ: a tenth of a pixel in the corner of an image of 640 x 480 pixels, over half of it
_MIN_KEYFRAMES_FOR_LENS = 12  # keyframes that λ is not known before


@dataclass
class CameraKnowledge:
    """Of the camera whose frames are tracked."""

    given: AlignmentOptions
    pair: EstimationOptions  # with λ, once it is known
    model: ModelName  # of the motion
    distortion: float  # NaN, inf: not known
    distortion_std: float
    length_std: float = math.nan  # of all lengths, relative
    given_length_std: float = math.nan  # the same when all frames were given last
    # of positions, relative to their distance from the first, and of yaw, by a lens that is still estimated
    shape_std: tuple[float, float] = (0.0, 0.0)
    focal: float | None = None  # half diagonals: that of the map, whose lengths it determines
    stated_std: float = 0.0  # of the logarithm of the focal length that was given
    focal_contradicted: bool = False  # so that it is what the images show
    delay: float = 0.0  # delay, delay_std: s, of attitudes
    delay_std: float = DELAY_STD
    plane: MetricPlane | None = None

    @classmethod
    def of(cls, given: AlignmentOptions, pair: EstimationOptions) -> Self:
        """Before the first frame."""
        distortion, std = (math.nan, math.inf) if pair.distortion is None else (pair.distortion, 0.0)
        return cls(given, pair, given.model, distortion, std)

    @property
    def distortion_known(self) -> bool:
        """True where λ was given, or is known well enough to be kept."""
        return self.pair.distortion is not None

    def camera_of(self, frame: Frame) -> Camera:
        """That of a frame with the lens as it is known so far."""
        if self.given.lens_known:
            return frame.camera
        return frame.camera.with_coefficients(self.distortion if math.isfinite(self.distortion_std) else 0.0)

    def camera_with_lens_of(self, other: Placement, frame: Frame) -> Camera:
        """That of a frame with the lens that another one was placed with."""
        return frame.camera if self.given.lens_known else frame.camera.with_coefficients(*other.camera.coefficients)

    def adopt_given(self, camera: Camera) -> None:
        """Adopt the given focal length and tilt: with both, poses are metric from the second frame on."""
        tilt, rigid = self.given.tilt, self.model in ("auto", "rigid")
        if self.focal_contradicted or not self.is_metric(camera) or not (rigid or self.model == "similarity"):
            return
        assert camera.focal is not None
        self.focal, self.stated_std = camera.focal / camera.scale, camera.focal_log_std
        self.length_std, _ = judged_focal(self.stated_std, 0.0, math.inf)
        self.given_length_std = self.length_std
        if tilt is not None:
            self.model = "rigid" if rigid else "similarity"
            self.plane = MetricPlane(self.focal, tilt, rigid)

    def is_metric(self, camera: Camera) -> bool:
        """Whether lens and focal length of a camera are given."""
        return self.given.lens_known and camera.focal is not None and camera.focal_source in ("option", "file")

    def attitude(self, frame: Frame) -> tuple[float, float] | None:
        """(ψ, θ), radians, as measured when the frame was taken."""
        if frame.attitude is None:
            return None
        psi, theta = at_delay(frame.attitude, self.delay).tolist()
        return psi, theta

    def attitude_std(self, frame: Frame) -> float:
        """Its standard deviation, radians, with what the delay leaves open."""
        assert frame.attitude is not None
        late = self.delay_std * float(change_with_delay(frame.attitude).max())
        return math.hypot(self.given.attitudes_std, late)

    def vote(self, links: Sequence[Link]) -> None:
        """λ by the pairs alone, until there is an alignment."""
        if not self.distortion_known:
            relations = [link.relation for link in links]
            consensus = vote([r.distortion for r in relations], [r.distortion_std for r in relations])
            self.distortion, self.distortion_std = consensus.distortion, consensus.std

    def cameras_for(self, keyframes: Sequence[Frame], focal_std: float | None) -> list[Camera]:
        """Those of keyframes that are aligned, with the focal length of the map if it is to be kept so closely."""
        cameras = [keyframe.camera.with_guessed_focal() for keyframe in keyframes]
        if self.pair.distortion is not None and not self.given.lens_known:
            cameras = [camera.with_coefficients(self.pair.distortion) for camera in cameras]
        if self.focal is None or focal_std is None:
            return cameras
        focal = self.focal
        return [c.with_focal(focal * c.scale, "file", focal_std * focal * c.scale) for c in cameras]

    def _attitudes(self, keyframes: Sequence[Frame]) -> FloatArray | None:
        """(ψ, θ) of each, (N, 2), radians; None unless all were measured."""
        attitudes = [attitude for keyframe in keyframes if (attitude := self.attitude(keyframe)) is not None]
        return np.array(attitudes) if len(attitudes) == len(keyframes) else None

    def options_for(self, keyframes: Sequence[Frame]) -> AlignmentOptions:
        """Of an alignment of keyframes."""
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

    def learn(self, alignment: Alignment, keyframes: Sequence[Frame], *, keeps_focal: bool) -> None:
        """Keep what an alignment shows of the camera, for the frames to come."""
        if not self.distortion_known and alignment.distortion_std < self.distortion_std:
            self.distortion, self.distortion_std = alignment.distortion, alignment.distortion_std
        if not keeps_focal:
            self.focal, self.length_std = alignment.focal, alignment.length_std
        self.shape_std = _shape_std(alignment)
        self.plane = self._metric_plane(alignment, self._attitudes(keyframes))
        if self.distortion_known:
            self.model = alignment.model
        elif self.distortion_std <= _KNOWN_STD and len(keyframes) >= _MIN_KEYFRAMES_FOR_LENS:
            self.pair = replace(self.pair, distortion=self.distortion, solver="auto")
            self.model = alignment.model

    def _metric_plane(self, alignment: Alignment, attitudes: FloatArray | None) -> MetricPlane | None:
        """The plane that an alignment shows a camera to move over, by its attitudes (N, 2) where these are known."""
        poses, tilt = alignment.poses, alignment.tilt
        known_tilts = ("rigid", "similarity", *(() if attitudes is None else ("tilting",)))
        if alignment.model not in known_tilts or poses is None or not tilt or not self.focal:
            return None
        if attitudes is not None:
            tilt = np.nanmedian(poses.tilt - attitudes, axis=0).tolist()
        given = self.given.tilt is not None
        tilt_std = None if given else math.sqrt(float(np.trace(alignment.covariance[:2, :2])))
        return MetricPlane(self.focal, (tilt[0], tilt[1]), alignment.model == "rigid", tilt_std)

    def covariance(self, placed: TrackedFrame, pose: CameraPose) -> FloatArray | None:
        """Of a frame's pose, with what all frames have in common but for the unit of lengths."""
        covariance, (relative, yaw_std) = placed.covariance, self.shape_std
        if covariance is None:
            if not relative:
                return None
            covariance = np.zeros((4, 4))
        far = math.hypot(pose.x, pose.y)
        if self.plane is not None and not relative:
            relative = yaw_std = self.plane.bend_std(self.length_std)
        place = (relative * far) ** 2
        if placed.frame.attitude is not None:
            # The foot of the camera is off by the error of its tilt, and so is that of the first frame.
            place += 2.0 * (pose.height * self.attitude_std(placed.frame)) ** 2
        return np.asarray(covariance + np.diag([place, place, 0.0, yaw_std**2]))


def _shape_std(alignment: Alignment) -> tuple[float, float]:
    """Standard deviation of a path's shape: across, relative to its length, and of its yaw, radians; 0 if not known."""
    if alignment.poses is None or alignment.poses.covariance is None:
        return 0.0, 0.0
    path = Trajectory.from_poses(alignment.poses)
    distance = np.linalg.norm(path.position, axis=1)
    farthest = int(np.argmax(distance))
    if path.covariance is None or not distance[farthest] > 0.0:
        return 0.0, 0.0
    # Across: along it is what all lengths share.
    variance = float(np.linalg.eigvalsh(path.covariance[farthest, :2, :2])[0]) / distance[farthest] ** 2
    return math.sqrt(max(variance, 0.0)), math.sqrt(float(path.covariance[:, YAW, YAW].max()))
