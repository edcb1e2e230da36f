"""The tracker: a frame comes in, its place on the plane comes out."""

import math
from collections.abc import Callable, Iterable
from concurrent.futures import Executor
from dataclasses import replace
from functools import partial

import numpy as np

from rdstitch.alignment import AlignmentOptions
from rdstitch.arrays import FloatArray
from rdstitch.features import Features, Matcher
from rdstitch.features.corner_flow import CornerFlow, matched_corners
from rdstitch.features.prepared_image import PreparedImage
from rdstitch.geometry.camera import Camera
from rdstitch.inputs.odometry import BodyPose
from rdstitch.matching.links import Link
from rdstitch.results.messages import Message
from rdstitch.robust import EstimationOptions
from rdstitch.tracking.camera_check import check_given_camera
from rdstitch.tracking.camera_knowledge import CameraKnowledge
from rdstitch.tracking.frame_links import agree
from rdstitch.tracking.keyframe_map import KeyframeMap
from rdstitch.tracking.map_refinement import MapRefinement
from rdstitch.tracking.odometry_prediction import OdometryPrediction
from rdstitch.tracking.placement import Placement
from rdstitch.tracking.tracked_frame import IncomingFrame, TrackedFrame, TrackingResult
from rdstitch.tracking.tracking_state import TrackingState

_PATIENCE = 0.015  # seconds a frame that are waited for the first alignment
# Fraction of a frame that its last keyframe shows, below which it becomes a keyframe; 0.7: 3.6 mm, and lengths are
# known to 1.9 % instead of 0.4; 0.9: 3.1 mm, and 1.4 times the time.
_KEYFRAME_OVERLAP = 0.8


class FrameTracker:
    """Registers frames of one camera one after the other.

    Features (``detect``, in a frame's pixels; ``match``) are asked for only where the corners of the last keyframe,
    followed from frame to frame, do not place a frame. Keyframes are aligned by ``executor`` while further frames come;
    where a tracker is ``patient`` alignments are waited for, so that the same frames give the same poses, else no
    frame waits long. Where λ is known both options have it.
    """

    def __init__(
        self,
        pair: EstimationOptions,
        alignment: AlignmentOptions,
        detect: Callable[[PreparedImage], Features],
        match: Matcher,
        executor: Executor,
        *,
        patient: bool = True,
    ) -> None:
        self._detect, self._match, self._count = detect, match, 0
        self.messages: list[Message] = []  # what the user should know of what has come so far
        self._flow, self._odometry = CornerFlow(), OdometryPrediction()
        self._map = KeyframeMap(CameraKnowledge.of(alignment, pair), [])
        self._refinement = MapRefinement(executor, patient=patient, report=self._report)

    @property
    def revisable(self) -> set[int]:
        """Numbers of the frames that may still find their place, or another one."""
        return set(self._map.frames)

    def add(
        self, image: PreparedImage, camera: Camera, attitude: FloatArray | None = None, body: BodyPose | None = None
    ) -> list[TrackingResult]:
        """Register the next frame; it comes last, after those before it whose place is new.

        ``camera`` is of the size of ``image``; ``attitude`` (S, 2) is ψ and θ, radians, as they were measured at
        :data:`rdstitch.inputs.delays.DELAYS`; ``body`` is by odometry.
        """
        followed = self._flow.follow(image)
        frame = IncomingFrame(self._count, camera, image, self._detect, self._flow.static_places, attitude, body)
        self._count += 1
        if not self._map.keyframes:
            return [self._first(frame, 0)]
        patience = 0.0 if self._map.has_plane else _PATIENCE
        revised = [] if self._refinement.patient else self._take_over(None, patience)
        return [*revised, *self._registered(frame, followed)]

    def finish(self) -> list[TrackingResult]:
        """Frames that find their place, or another one, when no other frame comes."""
        results, keyframe_map = self._take_over(None, None), self._map
        refinable = not keyframe_map.has_plane or keyframe_map.knowledge.plane is not None
        if len(keyframe_map.keyframes) > 1 and not keyframe_map.keeps_focal and refinable:
            self._refinement.begin(keyframe_map)
            results += self._take_over(None, None)
        return list({result.number: result for result in results}.values())

    def _registered(self, frame: IncomingFrame, followed: tuple[FloatArray, FloatArray] | None) -> list[TrackingResult]:
        """Place a frame by the corners (N, 2) that were followed, else by links with keyframes, else by odometry."""
        placed, links = None if followed is None else self._place_followed(frame, *followed), list[Link]()
        if placed is None or self._is_new(placed):
            links = self._map.links_with(frame, placed, self._match)
            placed = self._map.place_by_links(frame, links) or placed
        if placed is not None:
            results = self._placed(placed, links)
        elif (placed := self._odometry.place(frame, self._map.knowledge)) is not None:
            results = self._predicted(placed)
        else:
            return [self._without_place(frame)]
        if placed.pose is not None and frame.body is not None:
            self._odometry.latest = placed
        if not placed.keyframe:
            placed.frame = frame.without_image()
        return results

    def _first(self, frame: IncomingFrame, map_number: int) -> TrackingResult:
        """Begin a map with its first keyframe."""
        knowledge, self._odometry.latest = self._map.knowledge, None
        camera = knowledge.camera_of(frame)
        first = TrackedFrame(frame, Placement(camera, np.eye(3), None), keyframe=True)
        if knowledge.plane is None:
            knowledge = knowledge.with_given_focal(frame.camera)
        if knowledge.plane is not None:
            first.placement = knowledge.plane.below(camera, knowledge.attitude(frame))
            first.covariance = np.zeros((4, 4))
        self._map = KeyframeMap(knowledge, [first], map_number)
        self._refinement.start_map()
        self._flow.begin(frame.image, frame.corners)
        state = TrackingState.NEW_MAP if map_number else TrackingState.FIRST
        return self._result(first, state=state if frame.textured else TrackingState.NO_TEXTURE)

    def _placed(self, placed: TrackedFrame, links: list[Link]) -> list[TrackingResult]:
        """Keep a frame that keyframes show; where it has links and shows anything new, it is the next keyframe."""
        self._map.lost_frames = 0
        inliers, last = int(placed.inliers.sum()), self._map.keyframes[-1].number
        shown = next((link for link in links if link.image1 == last), None)
        between = shown is not None and not self._is_new(placed)
        if shown is not None and between:
            self._flow.begin(placed.frame.image, shown.points1, shown.points2)
            self._map.keep_between(placed, shown.points1, shown.points2)
        confirmed = self._map.confirm_first(placed)
        results = [] if confirmed is None else [self._result(confirmed, revised=True)]
        if links:
            inliers = max(map(len, links))
            results += [] if between else self._add_keyframe(placed, links)
        return [*results, self._result(placed, inliers)]

    def _place_followed(self, frame: IncomingFrame, before: FloatArray, now: FloatArray) -> TrackedFrame | None:
        """Place a frame by corners (N, 2) of the last keyframe; None where too few of them agree on a place."""
        last = self._map.keyframes[-1]
        placed = self._map.place(frame, last, before, now, rough=True)
        if placed is None or not agree(placed.inliers):
            return None
        # Where the view turns, what is followed from frame to frame drifts.
        to_frame = partial(last.points_in, placed)
        now, before = matched_corners(frame.image, last.frame.image, last.frame.corners, to_frame)
        placed = self._map.place(frame, last, before, now)
        if placed is None or not agree(placed.inliers):
            return None
        self._flow.begin(frame.image, before, now)
        self._map.keep_between(placed, before[placed.inliers], now[placed.inliers])
        return placed

    def _predicted(self, placed: TrackedFrame) -> list[TrackingResult]:
        """Keep a frame that odometry placed, as the next keyframe where it shows anything new."""
        revised = list[TrackingResult]()
        if placed.frame.textured and self._is_new(placed):
            self._map.lost_frames = 0
            revised = self._add_keyframe(placed, [])
        return [*revised, self._result(placed)]

    def _without_place(self, frame: IncomingFrame) -> TrackingResult:
        """Count a frame that no keyframe shows; after many of them, a new map begins with the last."""
        self._map.lost_frames += 1
        if not frame.textured:
            return self._unplaced(frame, TrackingState.NO_TEXTURE)
        if (map_number := self._map.next_number) is not None:
            return self._first(frame, map_number)
        return self._unplaced(frame, TrackingState.LOST)

    def _is_new(self, placed: TrackedFrame) -> bool:
        """Whether the last keyframe shows too little of it."""
        return placed.overlap_with(self._map.keyframes[-1]) < _KEYFRAME_OVERLAP

    def _add_keyframe(self, placed: TrackedFrame, links: list[Link]) -> list[TrackingResult]:
        """Keep the frame; take over an alignment of the last keyframes, which may place others, and begin the next."""
        self._flow.begin(placed.frame.image, placed.frame.corners)
        self._map.add(placed, links)
        if not self._map.has_plane:
            self._map.knowledge = self._map.knowledge.with_votes(self._map.links)
        revised = self._with_checked_camera(placed)
        if placed.frame.body is not None:
            self._odometry.learn(self._map.by_number.values())
        if self._refinement.is_waited_for(self._map.added):
            revised += self._take_over(placed, None)
        self._refinement.begin_if_due(self._map)
        return revised

    def _with_checked_camera(self, latest: TrackedFrame) -> list[TrackingResult]:
        """Adopt what keyframes show of a given camera; earlier frames whose places are others by it, or surer."""
        keyframe_map, check = self._map, check_given_camera(self._map, latest.frame)
        if check is None:
            return []
        for message in check.messages:
            self._report(message)
        if check.focal_replaced:
            self._refinement.drop()
        keyframe_map.knowledge = check.knowledge
        if check.length_factor is not None:
            keyframe_map.rescale(check.length_factor)
        return self._revised(keyframe_map.revise(keyframe_map.frames), latest) if check.revises else []

    def _take_over(self, latest: TrackedFrame | None, patience: float | None) -> list[TrackingResult]:
        return self._revised(self._refinement.take_over(self._map, patience), latest)

    def _revised(self, frames: Iterable[TrackedFrame], latest: TrackedFrame | None) -> list[TrackingResult]:
        return [self._result(frame, revised=True) for frame in frames if frame is not latest]

    def _report(self, message: Message) -> None:
        """Keep a message, if nothing of its kind is known."""
        kinds = {message.code or message.text for message in self.messages}
        if (message.code or message.text) not in kinds:
            self.messages.append(message)

    def _result(
        self, placed: TrackedFrame, inliers: int = 0, *, state: TrackingState | None = None, revised: bool = False
    ) -> TrackingResult:
        pose = placed.pose
        return replace(
            self._unplaced(placed.frame, self._state_of(placed) if state is None else state),
            placement=placed.placement if placed.aligned else None,
            keyframe=placed.keyframe,
            inliers=inliers,
            revised=revised,
            quality=placed.quality,
            covariance=None if pose is None else self._map.knowledge.covariance(placed, pose),
        )

    def _state_of(self, placed: TrackedFrame) -> TrackingState:
        """The state of a frame that was placed by others."""
        if placed.pose is not None:
            return TrackingState.TRACKED
        if placed.aligned:
            return TrackingState.NO_METRIC_POSE if placed.placement.focal is None else TrackingState.NOT_FINITE
        if self._map.has_plane:
            return TrackingState.NOT_LINKED
        moved = len(self._map.keyframes) > 1 or placed.keyframe
        return TrackingState.INITIALISING if moved else TrackingState.NOT_MOVED

    def _unplaced(self, frame: IncomingFrame, state: TrackingState) -> TrackingResult:
        """The result of a frame without a place: what is known of its camera."""
        knowledge, (unit, unit_std) = self._map.knowledge, self._odometry.unit
        known = knowledge.distortion
        return TrackingResult(
            number=frame.number,
            state=state,
            distortion=math.nan if known is None else known.value,
            distortion_std=math.inf if known is None else known.std,
            distortion_known=knowledge.distortion_known,
            map_number=self._map.number,
            length_std=knowledge.length_std,
            unit=unit,
            unit_std=unit_std,
        )
