"""The tracker: a frame comes in, its place on the plane comes out."""

from collections.abc import Callable, Iterable
from concurrent.futures import Executor
from dataclasses import dataclass, field
from functools import partial

import numpy as np

from rdstitch.alignment import AlignmentOptions
from rdstitch.arrays import FloatArray
from rdstitch.features import Features, Matcher
from rdstitch.features.corner_flow import CornerFlow, matched_corners
from rdstitch.features.prepared_image import PreparedImage, View, prepare
from rdstitch.geometry.camera import Camera
from rdstitch.inputs.odometry import BodyPose
from rdstitch.matching.links import Link
from rdstitch.results.messages import Message
from rdstitch.robust import EstimationOptions
from rdstitch.tracking.camera_check import check_camera
from rdstitch.tracking.camera_knowledge import CameraKnowledge
from rdstitch.tracking.frame_links import agree
from rdstitch.tracking.keyframe_map import KeyframeMap
from rdstitch.tracking.map_refinement import MapRefinement
from rdstitch.tracking.odometry_prediction import OdometryPrediction
from rdstitch.tracking.placement import Placement
from rdstitch.tracking.relocalisation import links_with_map
from rdstitch.tracking.state import TrackState
from rdstitch.tracking.tracked_frame import Tracked, TrackedFrame

_PATIENCE = 0.015  # seconds a frame that are waited for the first alignment
_KEYFRAME_OVERLAP = 0.8  # share of a frame that its last keyframe shows, below which it becomes a keyframe
_NO_IMAGE = prepare(View(np.zeros((1, 1), np.uint8)), None)  # of frames that are not looked at again


@dataclass(frozen=True)
class TrackingOptions:
    """Choices and knowledge of a tracker."""

    pair: EstimationOptions = field(default_factory=EstimationOptions)  # with λ, where it is known
    # of the windows of keyframes; λ is that of the cameras where ``pair`` has one
    alignment: AlignmentOptions = field(default_factory=AlignmentOptions)
    # whether an alignment is waited for where it is due, so that the same frames give the same poses; else no frame
    # waits for more than a part of its time
    patient: bool = True


class Tracker:
    """Registers frames of one camera one after the other.

    Features (``detect``, in a frame's pixels; ``match``) are asked for only where the corners of the last keyframe,
    followed from frame to frame, do not place a frame. Keyframes are aligned by ``executor`` while further frames come.
    """

    def __init__(
        self,
        options: TrackingOptions,
        detect: Callable[[PreparedImage], Features],
        match: Matcher,
        executor: Executor,
    ) -> None:
        self._detect, self._match, self._count = detect, match, 0
        self.messages: list[Message] = []  # what the user should know of what has come so far
        self._known = CameraKnowledge.of(options.alignment, options.pair)
        self._flow, self._odometry = CornerFlow(), OdometryPrediction()
        self._map = KeyframeMap(self._known, TrackState(), [])
        self._refinement = MapRefinement(executor, patient=options.patient, tell=self._tell)

    @property
    def revisable(self) -> set[int]:
        """Numbers of the frames that may still find their place, or another one."""
        return set(self._map.frames)

    def add(
        self, image: PreparedImage, camera: Camera, attitude: FloatArray | None = None, body: BodyPose | None = None
    ) -> list[Tracked]:
        """Register the next frame; it comes last, after those before it whose place is new.

        ``camera`` is of the size of ``image``; ``attitude`` (S, 2) is ψ and θ, radians, as they were measured at
        :data:`rdstitch.inputs.delays.DELAYS`; ``body`` is by odometry.
        """
        frame = TrackedFrame(self._count, camera, image, self._detect, attitude, body, static=self._flow.is_static)
        self._count += 1
        if not self._map.keyframes:
            return [self._first(frame, self._map.state)]
        patience = _PATIENCE if self._map.state.initialising else 0.0
        revised = [] if self._refinement.patient else self._take_over(frame, patience)
        results = [*revised, *self._registered(frame)]
        if results[-1].pose is not None and body is not None:
            self._odometry.latest = frame
        if not frame.keyframe:
            frame.image = _NO_IMAGE
        return results

    def finish(self) -> list[Tracked]:
        """Frames that find their place, or another one, when no other frame comes."""
        results, frames = self._take_over(None, None), self._map
        refinable = frames.state.initialising or self._known.plane is not None
        if len(frames.keyframes) > 1 and not frames.keeps_focal and refinable:
            self._refinement.begin(frames)
            results += self._take_over(None, None)
        return list({result.number: result for result in results}.values())

    def _registered(self, frame: TrackedFrame) -> list[Tracked]:
        """By the corners that were followed, else by links with keyframes, else by odometry."""
        inliers, links = self._follow(frame), list[Link]()
        if not inliers or self._is_new(frame):
            links = links_with_map(frame, self._map, self._match)
        if links:
            self._map.settle(frame, links)
        if frame.place is None:
            return self._predicted(frame) or [self._without_place(frame)]
        self._map.state = self._map.state.placed()
        keyframe = bool(links)
        if links:
            inliers, last = max(map(len, links)), self._map.keyframes[-1].number
            shown = next((link for link in links if link.image1 == last), None)
            if shown is not None and not self._is_new(frame):
                self._flow.begin(frame.image, shown.points1, shown.points2)
                self._map.keep_between(frame, shown.points1, shown.points2)
                keyframe = False
        results = self._confirmed_by(frame)
        if keyframe:
            results += self._add_keyframe(frame, links)
        return [*results, self._result(frame, inliers)]

    def _first(self, frame: TrackedFrame, state: TrackState) -> Tracked:
        """The first keyframe of a map."""
        known, self._odometry.latest = self._known, None
        self._map = KeyframeMap(known, state, [frame])
        self._refinement.start_map()
        camera, frame.keyframe = known.camera_of(frame.camera), True
        frame.place = Placement(camera, np.eye(3), None)
        known.plane = known.plane or known.given_plane(frame.camera)
        if known.plane is not None:
            frame.place = known.plane.below(camera, known.attitude(frame))
            frame.covariance = np.zeros((4, 4))
        self._flow.begin(frame.image, frame.corners)
        reason = "first frame" if not state.map_number else "no keyframe shows what it shows: it begins a new map"
        return self._result(frame, reason=reason if frame.textured else "no floor texture")

    def _confirmed_by(self, frame: TrackedFrame) -> list[Tracked]:
        """The first keyframe, where it has its place by what is given, and a second frame shows that it is one."""
        first = self._map.keyframes[0]
        if self._known.plane is None or first.aligned or len(self._map.keyframes) > 1 or frame.covariance is None:
            return []
        self._map.state = self._map.state.with_plane()
        first.aligned = frame.aligned = True
        return [self._result(first, revised=True)]

    def _follow(self, frame: TrackedFrame) -> int:
        """Place the frame by the corners of the last keyframe; how many agree, 0 where they do not place it."""
        matched, last = self._flow.follow(frame.image), self._map.keyframes[-1]
        if matched is None:
            return 0
        if agree(self._map.place(frame, last, *matched, rough=True)):
            # Where the view turns, what is followed from frame to frame drifts.
            now, before = matched_corners(frame.image, last.image, last.corners, partial(last.motion_to, frame))
            inliers = self._map.place(frame, last, before, now)
            if agree(inliers):
                self._flow.begin(frame.image, before, now)
                self._map.keep_between(frame, before[inliers], now[inliers])
                return int(inliers.sum())
        frame.unplace()
        return 0

    def _predicted(self, frame: TrackedFrame) -> list[Tracked]:
        """A frame placed by odometry, as the next keyframe where it shows anything new; empty where it cannot be."""
        if not self._odometry.place(frame, self._known):
            return []
        revised = list[Tracked]()
        if frame.textured and self._is_new(frame):
            self._map.state = self._map.state.placed()
            revised = self._add_keyframe(frame, [])
        return [*revised, self._result(frame)]

    def _without_place(self, frame: TrackedFrame) -> Tracked:
        """A frame that no keyframe shows; after many of them, a new map begins with the last."""
        self._map.state = self._map.state.unplaced()
        if not frame.textured:
            return self._result(frame, reason="no floor texture")
        state = self._map.state.next_map(len(self._map.keyframes), all_searched=self._map.all_searched)
        if state is not None:
            return self._first(frame, state)
        return self._result(frame, reason="no keyframe shows what it shows")

    def _is_new(self, frame: TrackedFrame) -> bool:
        """Whether the last keyframe shows too little of it."""
        return frame.share_shown_by(self._map.keyframes[-1]) < _KEYFRAME_OVERLAP

    def _add_keyframe(self, frame: TrackedFrame, links: list[Link]) -> list[Tracked]:
        """Keep the frame; take over an alignment of the last keyframes, which may place others, and begin the next."""
        self._flow.begin(frame.image, frame.corners)
        self._map.add(frame, links)
        if self._map.state.initialising:
            self._known.vote(self._map.links)
        revision, revised = check_camera(self._map, frame, self._tell), list[Tracked]()
        if revision is not None:
            if revision.new_focal:
                self._refinement.drop()
            if revision.longer is not None:
                self._map.place_anew(revision.longer)
            revised = self._revised(self._map.revise(), frame)
        if frame.body is not None:
            self._odometry.learn(self._map.by_number.values())
        if self._refinement.is_waited_for(self._map.seen):
            revised += self._take_over(frame, None)
        self._refinement.begin_if_due(self._map)
        return revised

    def _take_over(self, latest: TrackedFrame | None, patience: float | None) -> list[Tracked]:
        return self._revised(self._refinement.take_over(self._map, patience), latest)

    def _revised(self, frames: Iterable[TrackedFrame], latest: TrackedFrame | None) -> list[Tracked]:
        return [self._result(frame, revised=True) for frame in frames if frame is not latest]

    def _tell(self, message: Message) -> None:
        """Keep a message, if nothing of its kind is known."""
        kinds = {known.code or known.text for known in self.messages}
        if (message.code or message.text) not in kinds:
            self.messages.append(message)

    def _result(self, frame: TrackedFrame, inliers: int = 0, *, reason: str = "", revised: bool = False) -> Tracked:
        placement, known, state = frame.place if frame.aligned else None, self._known, self._map.state
        if placement is not None:
            reason = "" if placement.pose is not None else "the model has no metric poses"
        elif not reason and not state.initialising:
            reason = "it is not linked with the map yet"
        elif not reason:
            alone = len(self._map.keyframes) == 1 and not frame.keyframe
            reason = "the camera has not moved far enough yet" if alone else "the first keyframes are being aligned"
        pose, (unit, unit_std) = None if placement is None else placement.pose, self._odometry.unit
        return Tracked(
            number=frame.number,
            placement=placement,
            distortion=known.distortion,
            distortion_std=known.distortion_std,
            distortion_known=known.distortion_known,
            map_number=state.map_number,
            keyframe=frame.keyframe,
            inliers=inliers,
            revised=revised,
            quality=frame.quality,
            covariance=None if pose is None else known.covariance(frame, pose),
            length_std=known.length_std,
            unit=unit,
            unit_std=unit_std,
            reason=reason,
        )
