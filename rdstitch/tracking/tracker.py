"""The tracker: a frame comes in, its place on the plane comes out."""

import cmath
import math
import weakref
from collections import deque
from collections.abc import Callable, Sequence
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from concurrent.futures import TimeoutError as NotYet
from dataclasses import dataclass, field, replace
from functools import partial
from importlib import import_module

import numpy as np

from rdstitch.alignment import Alignment, AlignmentOptions, align
from rdstitch.alignment.given_checks import LATE, attitudes_late, focal_contradicted
from rdstitch.alignment.odometry import OdometryFit, motions_of
from rdstitch.arrays import BoolArray, FloatArray
from rdstitch.features import Features, Matcher
from rdstitch.features.corner_flow import CornerFlow, matched_corners
from rdstitch.features.prepared_image import PreparedImage, View, prepare
from rdstitch.geometry.camera import Camera
from rdstitch.inputs.odometry import BodyPose, motion_between
from rdstitch.matching.distortion_consensus import vote
from rdstitch.matching.links import Link
from rdstitch.results.messages import Message
from rdstitch.robust import EstimationOptions
from rdstitch.tracking.camera_knowledge import CameraKnowledge
from rdstitch.tracking.frame_links import (
    MATCH_ERROR,
    agree,
    camera_beside,
    fitted_homography,
    links_by_corners,
    links_by_features,
)
from rdstitch.tracking.keyframe_map import KeyframeMap
from rdstitch.tracking.metric_plane import MetricPlane, chained
from rdstitch.tracking.placement import Placement, PlaneSimilarity
from rdstitch.tracking.shown_camera import SeenPairs, ShownCamera, judged_focal, shown_camera
from rdstitch.tracking.tracked_frame import Tracked, TrackedFrame

_ALIGNMENT_IMPORTS = "scipy.sparse.csgraph", "scipy.sparse.linalg", "scipy.spatial"
_WINDOW = 48  # keyframes that are aligned together
_FIRST_ALIGNMENT = 5  # keyframes that the first alignment takes
_GROWTH = 1.5  # from one alignment to the next, while λ is not known
_ALIGNMENT_INTERVAL = 24  # keyframes from one alignment to the next afterwards
_FIRST_DELAY, _ALIGNMENT_DELAY = 1, 8  # keyframes after which one is taken over, before λ is known and afterwards
_PATIENCE = 0.015  # seconds a frame that are waited for the first alignment
_KEYFRAME_OVERLAP = 0.8  # share of a frame that its last keyframe shows, below which it becomes a keyframe
_CAMERA_CHECKS = 3, 4, 6, 8, 12, 16, 32  # keyframes at which what is given is compared with them, beside alignments
_CONTRADICTED = 0.999  # probability that a given focal length is wrong
_EXACT = 1e-4  # of the logarithm of a focal length that an alignment keeps
_MAX_LOST_FRAMES = 10  # frames in a row without a place, after which a new map begins, if all keyframes were searched
_SAME_LENGTHS = 0.1  # of their standard deviation: change of all lengths that leaves the places of earlier frames
_SURER = 0.5  # of the standard deviation of all lengths that earlier frames were given with: they come again
_REVISED = 500  # frames between keyframes, whose places are revised with those of the keyframes
_MATCHES = 80  # of a link, that the alignment uses
_MOUNTED = 60  # keyframes by which it is found how the camera is mounted on the body whose odometry is known
_NO_IMAGE = prepare(View(np.zeros((1, 1), np.uint8)), None)  # of frames that are not looked at again
_ROUGH = 0.02  # sides: how far a corner may be off from frame to frame, or while the lens is not known


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

    Parameters
    ----------
    options : TrackingOptions
    detect : callable
        Features of a frame, in its pixels. They are asked for only where the corners of the last keyframe, which are
        followed from frame to frame, do not place a frame.
    matcher : Matcher
        Of those.
    executor : Executor
        Where keyframes are aligned among themselves while further frames come.

    Attributes
    ----------
    messages : list of Message
        What the user should know of what has come so far.
    """

    def __init__(
        self,
        options: TrackingOptions,
        detect: Callable[[PreparedImage], Features],
        matcher: Matcher,
        executor: Executor,
    ) -> None:
        self._options, self._detect, self._match, self._executor = options, detect, matcher, executor
        # The first alignment is small, and starting a process takes longer.
        self._first_executor = executor
        if not options.patient:
            self._first_executor = ThreadPoolExecutor(1)
            weakref.finalize(self, self._first_executor.shutdown, wait=False, cancel_futures=True)
            for name in _ALIGNMENT_IMPORTS:  # now: nothing that follows should wait for them
                import_module(name)
        self._count, self._map_number, self._lost = 0, 0, 0
        self._flow = CornerFlow()
        self._latest_placed: TrackedFrame | None = None  # of those with odometry
        self._mounted: OdometryFit | None = None  # how the camera is on the body, in units of the map
        self._known = CameraKnowledge.of(options.alignment, options.pair)
        self.messages: list[Message] = []
        self._start_map()

    @property
    def waits(self) -> bool:
        """True while there are too few keyframes for a map."""
        return not self._mapped

    @property
    def revisable(self) -> set[int]:
        """Numbers of the frames that may still find their place, or another one."""
        return {frame.number for frame, *_ in self._between} | set(self._map.by_number)

    def add(
        self,
        image: PreparedImage,
        camera: Camera,
        attitude: FloatArray | None = None,
        body: BodyPose | None = None,
    ) -> list[Tracked]:
        """Register the next frame; it comes last, after those before it whose place is new.

        Parameters
        ----------
        image : PreparedImage
        camera : Camera
            Of the size of ``image``.
        attitude : ndarray of shape (S, 2), optional
            (ψ, θ), radians, as it was measured at :data:`rdstitch.inputs.delays.DELAYS`.
        body : BodyPose, optional
            By odometry.
        """
        number, self._count = self._count, self._count + 1
        frame = TrackedFrame(number, camera, image, self._detect, attitude, body, static=self._flow.is_static)
        if not self._map.keyframes:
            return [self._first(frame)]
        revised = [] if self._options.patient else self._take_over(_PATIENCE if self.waits else 0.0)
        results = [*revised, *self._registered_frame(frame)]
        if results[-1].pose is not None and body is not None:
            self._latest_placed = frame
        if not results[-1].keyframe:
            frame.image = _NO_IMAGE
        return results

    def finish(self) -> list[Tracked]:
        """Frames that find their place, or another one, when no other frame comes."""
        results = self._take_over(None, latest=-1)
        if len(self._map.keyframes) > 1 and not self._keeps_focal and (self.waits or self._known.plane is not None):
            self._align_window()
            results += self._take_over(None, latest=-1)
        return list({result.number: result for result in results}.values())

    def _registered_frame(self, frame: TrackedFrame) -> list[Tracked]:
        inliers = self._follow(frame)
        if inliers and self._shown_by_last(frame) >= _KEYFRAME_OVERLAP:
            self._lost = 0
            return [*self._confirmed(frame), self._tracked(frame, keyframe=False, inliers=inliers)]
        links = self._links(frame)
        if not links and inliers:  # placed, but by too little for a keyframe
            self._lost = 0
            return [*self._confirmed(frame), self._tracked(frame, keyframe=False, inliers=inliers)]
        if not links and self._placed_by_odometry(frame):
            return self._registered_by_odometry(frame)
        if not links:
            return [self._without_place(frame)]
        self._lost = 0
        self._settle(frame, links)
        inliers = max(map(len, links))
        last = self._map.keyframes[-1]
        with_last = next((link for link in links if link.image1 == last.number), None)
        if with_last is not None and self._shown_by_last(frame) >= _KEYFRAME_OVERLAP:
            self._flow.begin(frame.image, with_last.points1, with_last.points2)
            self._keep_between(frame, with_last.points1, with_last.points2)
            return [*self._confirmed(frame), self._tracked(frame, keyframe=False, inliers=inliers)]
        confirmed = self._confirmed(frame)
        self._flow.begin(frame.image, frame.corners)
        revised = self._add_keyframe(frame, links)
        return [*confirmed, *revised, self._tracked(frame, keyframe=True, inliers=inliers)]

    def _start_map(self) -> None:
        self._map = KeyframeMap(_WINDOW)
        # Frames between keyframes, and the points of a keyframe that they show: before and now.
        self._between: deque[tuple[TrackedFrame, TrackedFrame, FloatArray, FloatArray]] = deque(maxlen=_REVISED)
        self._next_alignment = _FIRST_ALIGNMENT
        # the keyframes, the result, and whether the focal length was kept
        self._alignment: tuple[list[TrackedFrame], Future[Alignment], bool] | None = None
        self._taken_over_at = 0  # keyframes seen from which on it is
        self._mapped = False  # whether there is a plane that keyframes lie on
        self._latest_placed = None

    def _first(self, frame: TrackedFrame) -> Tracked:
        """The first keyframe of a map."""
        self._start_map()
        camera = self._known.camera_of(frame.camera)
        frame.place = Placement(camera, np.eye(3), None)
        self._known.plane = self._known.plane or self._known.given_plane(frame.camera)
        if self._known.plane is not None:
            frame.place = self._known.plane.below(camera, self._known.attitude(frame))
            frame.covariance = np.zeros((4, 4))
        self._map.keyframes.append(frame)
        self._flow.begin(frame.image, frame.corners)
        reason = "first frame" if not self._map_number else "no keyframe shows what it shows: it begins a new map"
        reason = reason if frame.textured else "no floor texture"
        return self._tracked(frame, keyframe=True, inliers=0, reason=reason)

    def _confirmed(self, frame: TrackedFrame) -> list[Tracked]:
        """The first keyframe, where it has its place by what is given, and a second frame shows that it is one."""
        first = self._map.keyframes[0]
        if self._known.plane is None or first.aligned or len(self._map.keyframes) > 1 or frame.covariance is None:
            return []
        self._mapped = first.aligned = frame.aligned = True
        return [replace(self._tracked(first, keyframe=True, inliers=0), revised=True)]

    def _follow(self, frame: TrackedFrame) -> int:
        """Place the frame by the corners of the last keyframe; how many agree, 0 where they do not place it."""
        matched = self._flow.follow(frame.image)
        if matched is None:
            return 0
        last = self._map.keyframes[-1]
        if not agree(self._place(frame, last, *matched, rough=True)):
            frame.place, frame.aligned = None, False
            return 0
        # Where the view turns, what is followed from frame to frame drifts.
        now, before = matched_corners(frame.image, last.image, last.corners, partial(last.motion_to, frame))
        inliers = self._place(frame, last, before, now)
        if not agree(inliers):
            frame.place, frame.aligned = None, False
            return 0
        self._flow.begin(frame.image, before, now)
        self._keep_between(frame, before[inliers], now[inliers])
        return int(inliers.sum())

    def _keep_between(self, frame: TrackedFrame, before: FloatArray, now: FloatArray) -> None:
        """Keep what a frame between keyframes shows of the last one, instead of what was kept of it."""
        if self._between and self._between[-1][0] is frame:
            self._between.pop()
        self._between.append((frame, self._map.keyframes[-1], before, now))

    def _place(
        self, frame: TrackedFrame, other: TrackedFrame, before: FloatArray, now: FloatArray, *, rough: bool = False
    ) -> BoolArray:
        """Place a frame by points (N, 2) of a keyframe that it shows too; which of them (N,) agree."""
        assert other.place is not None
        start = other.place
        stay = replace(start, camera=camera_beside(frame, start, lens_given=self._known.lens_given))
        rough |= not (self._mapped or self._known.distortion_known)
        error = _ROUGH * max(frame.camera.image_size) if rough else MATCH_ERROR
        homography, inliers = fitted_homography(start.camera, stay.camera, before, now, error)
        frame.place, frame.aligned, frame.covariance = None, False, None
        if homography is None:
            return inliers
        frame.quality, frame.aligned = float(inliers.mean()), other.aligned
        if self._known.plane is None or other.covariance is None:
            frame.place = replace(stay, homography=start.homography @ homography)
            return inliers
        below = self._known.plane.below(stay.camera, self._known.attitude(frame))
        tilt_std = 0.0 if frame.attitude is None else self._known.attitude_std(frame)
        points, places = now[inliers], start.to_plane(before[inliers])
        frame.place, step = self._known.plane.placed(below, points, places, tilt_std=tilt_std)
        at, was = frame.place.pose, start.pose
        if at is not None and was is not None:
            frame.covariance = chained(other.covariance, step, (at.x - was.x, at.y - was.y), was.height)
        return inliers

    def _placed_by_odometry(self, frame: TrackedFrame) -> bool:
        """Place a frame that shows no keyframe by what the wheels say of the way from the last one that had a place."""
        last, fit = self._latest_placed, self._mounted
        if last is None or fit is None or frame.body is None or last.body is None or self._known.plane is None:
            return False
        was = last.place.pose if last.place is not None and last.aligned else None
        if was is None or last.place is None or last.covariance is None:
            return False
        step = motion_between(last.body, frame.body)
        moved = cmath.exp(1j * was.yaw) * fit.camera_motion(step.moved, step.turn)
        place, yaw = complex(was.x, was.y) + moved.conjugate(), was.yaw + step.turn
        below = self._known.plane.below(last.place.camera, self._known.attitude(frame))
        frame.place = PlaneSimilarity(was.height * cmath.exp(-1j * yaw), place).applied(below)
        spread = fit.noise**2 * np.array([step.variance / abs(fit.scale) ** 2] * 2 + [0.0, step.turn_variance])
        offset = moved.real, -moved.imag
        frame.covariance, frame.aligned = chained(last.covariance, np.diag(spread), offset, was.height), True
        frame.quality = 0.0
        return True

    def _registered_by_odometry(self, frame: TrackedFrame) -> list[Tracked]:
        """Such a frame as the next keyframe, where it shows anything new."""
        keyframe, revised = frame.textured and self._shown_by_last(frame) < _KEYFRAME_OVERLAP, list[Tracked]()
        if keyframe:
            self._lost = 0
            self._flow.begin(frame.image, frame.corners)
            revised = self._add_keyframe(frame, [])
        return [*revised, self._tracked(frame, keyframe=keyframe, inliers=0)]

    def _without_place(self, frame: TrackedFrame) -> Tracked:
        """A frame that no keyframe shows; after many of them, a new map begins with the last."""
        self._lost += 1
        if not frame.textured:
            return self._tracked(frame, keyframe=False, inliers=0, reason="no floor texture")
        alone = self.waits and len(self._map.keyframes) == 1
        if (self._lost >= _MAX_LOST_FRAMES and self._map.all_searched) or alone:
            self._map_number += not alone
            self._lost = 0
            return self._first(frame)
        return self._tracked(frame, keyframe=False, inliers=0, reason="no keyframe shows what it shows")

    def _links(self, frame: TrackedFrame) -> list[Link]:
        """The frame with the last keyframes, as far as they can be registered; of a lost one, with more of them."""
        lens, pair = self._known.lens_given, self._known.pair
        if links := links_by_corners(frame, self._map.partners, pair, lens_given=lens):
            return links
        if self._lost == 0:
            self._map.searched = 0
        further = self._map.to_search()
        self._map.searched += len(further)
        for others in (self._map.partners, further):
            if links := links_by_features(frame, others, self._match, pair, lens_given=lens):
                self._settle(frame, links)
                numbers = {link.image1 for link in links}
                shown = [keyframe for keyframe in others if keyframe.number in numbers]
                self._map.found_again(shown)
                return links_by_corners(frame, shown, pair, lens_given=lens) or links
        return []

    def _settle(self, frame: TrackedFrame, links: Sequence[Link]) -> None:
        """Place a frame by its largest link with a keyframe that is on the map, if there is any."""
        by_number = self._map.by_number
        links = [link for link in links if link.image1 in by_number]
        if not links:
            return
        best = max(links, key=lambda link: (by_number[link.image1].aligned, len(link)))
        self._place(frame, by_number[best.image1], best.points1, best.points2)
        frame.aligned &= frame.place is not None

    def _shown_by_last(self, frame: TrackedFrame) -> float:
        return frame.share_shown_by(self._map.keyframes[-1])

    def _add_keyframe(self, frame: TrackedFrame, links: Sequence[Link]) -> list[Tracked]:
        """Keep the frame; take over an alignment of the window, which may place others, and begin the next."""
        self._map.add(frame, links)
        seen = self._map.seen
        if self._between and self._between[-1][0] is frame:
            self._between.pop()
        if not self._known.distortion_known and not self._mapped:  # λ by the pairs alone, until there is an alignment
            relations = [link.relation for link in self._map.links]
            consensus = vote([r.distortion for r in relations], [r.distortion_std for r in relations])
            self._known.distortion, self._known.distortion_std = consensus.distortion, consensus.std
        revised = self._check_camera(frame)
        if frame.body is not None:
            keyframes = sorted(self._map.by_number.values(), key=lambda keyframe: keyframe.number)[-_MOUNTED:]
            known = [at for keyframe in keyframes if (at := keyframe.seen_from) is not None]
            self._mounted = OdometryFit.of(motions_of(known)) or self._mounted
        if self._options.patient and seen >= self._taken_over_at:
            revised += self._take_over(None)
        if seen + 1 >= self._next_alignment and self._alignment is None:
            grown = max(2, round(self._next_alignment * (_GROWTH - 1.0)))
            steps = _ALIGNMENT_INTERVAL if self._known.distortion_known else min(grown, _ALIGNMENT_INTERVAL)
            self._next_alignment += steps
            # At a keyframe and not when it is done: so that time does not decide on the result.
            waits_long = self._known.distortion_known and not self.waits
            self._taken_over_at = seen + (_ALIGNMENT_DELAY if waits_long else _FIRST_DELAY)
            self._align_window()
        return revised

    def _check_camera(self, frame: TrackedFrame) -> list[Tracked]:
        """What the keyframes show of a camera whose lens and focal length are given.

        Its tilt, with which a map begins; whether the focal length is right, and how late attitudes are.
        """
        known, seen = self._known, self._map.seen
        if known.focal is None or not known.is_metric(frame.camera) or known.model not in ("auto", "rigid"):
            return []
        if self._mapped and seen not in _CAMERA_CHECKS and seen % _ALIGNMENT_INTERVAL:
            return []
        shown = self._shown_camera()
        before = known.delay
        if frame.attitude is not None:
            known.delay, known.delay_std = shown.delay, shown.delay_std
            if abs(shown.delay) > LATE * shown.delay_std:
                self._tell(attitudes_late(shown.delay, shown.delay_std))
        if known.focal_contradicted:
            if abs(shown.log_focal) > shown.log_focal_std:
                return self._with_shown_focal(frame, shown)
        else:
            known.length_std, wrong = judged_focal(known.stated_std, shown.log_focal, shown.log_focal_std)
            if wrong > _CONTRADICTED:
                return self._with_shown_focal(frame, shown)
            if self._mapped and abs(known.delay - before) > known.delay_std:
                return self._placed_anew(frame, 1.0)
            if self._mapped and known.length_std < _SURER * known.given_length_std:
                known.given_length_std = known.length_std
                return self._revised(except_for=frame.number)
        pixels = known.focal * frame.camera.scale
        if self._mapped or not (shown.tilt_std * pixels < MATCH_ERROR and shown.rms * pixels < MATCH_ERROR):
            return []
        known.plane = MetricPlane(known.focal, shown.tilt, True, shown.tilt_std)
        return self._placed_anew(frame, 1.0)

    def _shown_camera(self) -> ShownCamera:
        assert self._known.focal is not None
        rays, attitudes, by_number = [], [], self._map.by_number
        for link in self._map.links:
            ends = by_number[link.image1], by_number[link.image2]
            for frame, points in zip(ends, (link.points1, link.points2), strict=True):
                camera = frame.camera
                rays.append((camera.undistort(points) - camera.center) / (self._known.focal * camera.scale))
                attitudes.append(frame.attitude)
        measured = [attitude for attitude in attitudes if attitude is not None]
        tilt = None if self._known.plane is None else self._known.plane.tilt
        return shown_camera(SeenPairs.of(rays, measured if len(measured) == len(rays) else []), tilt)

    def _with_shown_focal(self, frame: TrackedFrame, shown: ShownCamera) -> list[Tracked]:
        """The map by the focal length that the images show, instead of the one that was given."""
        assert self._known.focal is not None
        given = self._known.focal * frame.camera.scale
        found, std = given * math.exp(shown.log_focal), shown.log_focal_std
        if not self._known.focal_contradicted:
            self._tell(focal_contradicted(given, found, std))
        self._known.focal, self._known.focal_contradicted = found / frame.camera.scale, True
        self._known.length_std = std
        self._alignment = None  # one that is under way was begun with the old focal length
        self._known.plane = MetricPlane(self._known.focal, shown.tilt_by_itself, True, shown.tilt_std)
        return self._placed_anew(frame, math.exp(-shown.log_focal))

    def _placed_anew(self, latest: TrackedFrame, longer: float) -> list[Tracked]:
        """All keyframes by the camera as it is known now, by which lengths are so many times as long."""
        assert self._known.plane is not None
        first, *others = self._map.keyframes
        assert first.place is not None
        was = first.place.pose
        move = PlaneSimilarity(1.0, 0.0)
        if was is not None and first.aligned:
            move = PlaneSimilarity(np.exp(-1j * was.yaw).item(), longer * complex(was.x, was.y))
        first.place = move.applied(self._known.plane.below(first.camera, self._known.attitude(first)))
        first.covariance = np.zeros((4, 4)) if first.covariance is None else first.covariance
        first.aligned = self._mapped = True
        for keyframe in self._map.older:
            if keyframe.place is not None:
                keyframe.place = PlaneSimilarity(longer, 0.0).applied(keyframe.place)
        for keyframe in others:
            self._settle(keyframe, self._map.links_to(keyframe))
        return self._revised(except_for=latest.number)

    def _revised(self, waiting: set[int] | None = None, *, except_for: int) -> list[Tracked]:
        """Place the frames between keyframes anew; of all that have a place those that were waiting, None: all."""
        keyframes, between = self._map.by_number, []
        for frame, keyframe, before, now in self._between:
            if keyframe.aligned and (waiting is None or frame.number in waiting):
                self._place(frame, keyframe, before, now)
                between.append(frame)
        found = [*keyframes.values(), *(frame for frame in between if frame.number not in keyframes)]
        return [
            replace(self._tracked(frame, keyframe=frame.number in keyframes, inliers=0), revised=True)
            for frame in sorted(found, key=lambda frame: frame.number)
            if frame.aligned and frame.number != except_for and (waiting is None or frame.number in waiting)
        ]

    @property
    def _waiting(self) -> set[int]:
        """Numbers of the frames that have no place yet."""
        frames = [*(frame for frame, *_ in self._between), *self._map.by_number.values()]
        return {frame.number for frame in frames if not frame.aligned}

    @property
    def _keeps_focal(self) -> bool:
        """Whether alignments keep the focal length: that of one map must not depend on the window."""
        return self._known.focal is not None and (self._known.stated_std > 0.0 or not self._map.whole)

    def _align_window(self) -> None:
        """Begin to align the keyframes of the window among themselves."""
        window = self._map.keyframes
        known = self._known.pair.distortion
        cameras = [keyframe.camera.with_focal() for keyframe in window]
        if known is not None and not self._known.lens_given:
            cameras = [camera.with_coefficients(known) for camera in cameras]
        if self._known.focal is not None and self._keeps_focal:
            focal = self._known.focal
            cameras = [c.with_focal(focal * c.scale, "file", _EXACT * focal * c.scale) for c in cameras]
        attitudes = [attitude for keyframe in window if (attitude := self._known.attitude(keyframe)) is not None]
        measured = len(attitudes) == len(cameras)
        stated = max(
            (self._known.attitude_std(keyframe) for keyframe in window if keyframe.attitude is not None), default=0.0
        )
        options = replace(
            self._known.given,
            model=self._known.model,
            lens="auto" if known is not None else "division",
            lens_known=known is not None,
            most=_MATCHES,
            attitudes=np.array(attitudes) if measured else None,
            delayed_attitudes=None,
            attitudes_std=stated if measured else self._known.given.attitudes_std,
            reference=None,
            pose_covariance=known is None,
        )
        executor = self._executor if self._mapped else self._first_executor
        aligned = executor.submit(align, cameras, self._map.window_links(), options)
        self._alignment = list(window), aligned, self._keeps_focal

    def _take_over(self, patience: float | None, latest: int | None = None) -> list[Tracked]:
        """λ, the model and the places of keyframes from an alignment; frames but the latest that have another place.

        It is waited for so many seconds at most, None for as long as it takes.
        """
        if self._alignment is None:
            return []
        try:
            alignment = self._alignment[1].result(patience)
        except NotYet:
            return []
        except Exception as error:  # noqa: BLE001 - what one window cannot do the next one may
            self._alignment = None
            self._tell(Message(f"an alignment of the last keyframes failed ({error}); the next one is tried"))
            return []
        (keyframes, _, kept), self._alignment = self._alignment, None
        for message in alignment.messages:
            if message.severity in ("warning", "note"):
                self._tell(message)
        if alignment.on_sphere:
            self._tell(Message("the camera turns on the spot: there is no path"))
            return []
        if not self._known.distortion_known and alignment.distortion_std < self._known.distortion_std:
            self._known.distortion, self._known.distortion_std = alignment.distortion, alignment.distortion_std
        placed = [
            (keyframe, Placement(camera, homography, alignment.focal))
            for keyframe, camera, homography, used in zip(
                keyframes, alignment.cameras, alignment.homographies, alignment.used, strict=True
            )
            if used
        ]
        waiting, (move, longer) = self._waiting, _to_map(placed)
        first, placement = placed[0]
        if self._map.whole and first.number == self._map.keyframes[0].number and (pose := placement.pose) is not None:
            move = PlaneSimilarity.to_origin(pose)  # the others are relative to it
        self._mapped = True
        if not kept:
            self._known.length_std = alignment.length_std
        for keyframe, placement in placed:
            keyframe.place, keyframe.aligned = move.applied(placement), True
        self._known.focal = self._known.focal if kept else alignment.focal
        self._known.learn(alignment, keyframes)
        if self._known.plane is not None:  # until there is a window, errors have nothing to grow from
            reached = np.zeros((4, 4))
            for keyframe in self._map.keyframes:
                if keyframe.aligned:
                    reached = keyframe.covariance = reached if keyframe.covariance is None else keyframe.covariance
        aligned = {id(keyframe) for keyframe, _ in placed}
        for keyframe in self._map.keyframes:
            links = self._map.links_to(keyframe)
            if id(keyframe) not in aligned and links:
                self._settle(keyframe, links)
        # What was said of the lengths before is replaced, so that all lengths of a map are wrong by the same.
        anew = not kept and abs(math.log(longer)) > _SAME_LENGTHS * self._known.length_std
        return self._revised(None if anew else waiting, except_for=self._count - 1 if latest is None else latest)

    def _tell(self, message: Message) -> None:
        """Keep a message, if nothing of its kind is known."""
        kinds = {known.code or known.text for known in self.messages}
        if (message.code or message.text) not in kinds:
            self.messages.append(message)

    def _tracked(self, frame: TrackedFrame, *, keyframe: bool, inliers: int, reason: str = "") -> Tracked:
        placement = frame.place if frame.aligned else None
        if placement is None and not reason:
            alone = len(self._map.keyframes) == 1 and not keyframe
            reason = "the camera has not moved far enough yet" if alone else "the first keyframes are being aligned"
            reason = reason if self.waits else "it is not linked with the map yet"
        elif placement is not None:
            reason = "" if placement.pose is not None else "the model has no metric poses"
        pose = None if placement is None else placement.pose
        return Tracked(
            number=frame.number,
            placement=placement,
            distortion=math.nan if self._known.distortion is None else self._known.distortion,
            distortion_std=self._known.distortion_std,
            distortion_known=self._known.distortion_known,
            map_number=self._map_number,
            keyframe=keyframe,
            inliers=inliers,
            quality=frame.quality,
            covariance=None if pose is None else self._known.covariance(frame, pose),
            length_std=self._known.length_std,
            unit=math.nan if self._mounted is None else abs(self._mounted.scale),
            unit_std=math.nan if self._mounted is None else self._mounted.relative_std,
            reason=reason,
        )


def _to_map(placed: Sequence[tuple[TrackedFrame, Placement]]) -> tuple[PlaneSimilarity, float]:
    """From the plane of an alignment to that of the map, which the first one defines; how much longer lengths become.

    The unit of lengths is the height of the first keyframe: heights stay as they are, whatever focal length they are
    computed by.
    """
    shared = [(new, keyframe.place) for keyframe, new in placed if keyframe.aligned and keyframe.place is not None]
    if not shared:
        pose = placed[0][1].pose
        return PlaneSimilarity(1.0, 0.0) if pose is None else PlaneSimilarity.to_origin(pose), 1.0
    news, olds = zip(*shared, strict=True)
    move = PlaneSimilarity.between(news, olds)
    poses = [(one.pose, two.pose) for one, two in shared]
    known = [(new, old) for new, old in poses if new is not None and old is not None]
    if len(known) < len(poses):
        return move, 1.0
    larger = float(np.median([old.height / new.height for new, old in known]))
    longer = larger / abs(move.turn)
    turn = move.turn * longer
    now, then = (np.mean([complex(pose.x, pose.y) for pose in side]) for side in zip(*known, strict=True))
    return PlaneSimilarity(turn, complex(longer * then - turn * now)), longer
