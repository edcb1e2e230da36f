"""The tracker: a frame comes in, its place on the plane comes out."""

import math
from collections.abc import Callable, Sequence
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from concurrent.futures import TimeoutError as NotYet
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from importlib import import_module
from typing import Any

import cv2
import numpy as np

from rdstitch.alignment import Alignment, AlignmentOptions, align
from rdstitch.alignment.trajectory import Trajectory
from rdstitch.arrays import BoolArray, FloatArray
from rdstitch.features import Features, Matcher
from rdstitch.features.corner_flow import CornerFlow, corners_of, matched_corners
from rdstitch.features.prepared_image import PreparedImage
from rdstitch.geometry.camera import Camera
from rdstitch.geometry.radial_homography import RadialHomography, from_plane
from rdstitch.matching.distortion_consensus import vote
from rdstitch.matching.links import Link
from rdstitch.results.messages import Message
from rdstitch.robust import EstimationOptions, PairMatches, estimate_radial_homographies
from rdstitch.tracking.metric_plane import MetricPlane, SeenPair, ShownCamera, chained, shown_camera
from rdstitch.tracking.placement import CameraPose, Placement, PlaneSimilarity

_ALIGNMENT_IMPORTS = "scipy.ndimage", "scipy.sparse.csgraph", "scipy.sparse.linalg", "scipy.spatial"
_WINDOW = 48  # keyframes that are aligned together
_KEPT = 200  # older keyframes at the most, among which a lost frame looks for its place
_PARTNERS = 2  # last keyframes that a frame is matched with
_SEARCHED = 12  # keyframes among which a lost frame looks at a time
_FIRST_ALIGNMENT = 5  # keyframes that the first alignment takes
_GROWTH = 1.5  # from one alignment to the next, while λ is not known
_ALIGNMENT_INTERVAL = 24  # keyframes from one alignment to the next afterwards
_ALIGNMENT_DELAY = 8  # keyframes after which one is taken over, once λ is known; the next one before
_PATIENCE = 0.015  # seconds a frame that are waited for the first alignment
_KNOWN_STD = 0.002  # of λ: a tenth of a pixel in the corner of an image of 640 x 480 pixels, over half of it
_MIN_KEYFRAMES_FOR_LENS = 12  # keyframes that λ is not known before
_KEYFRAME_OVERLAP = 0.8  # share of a frame that its last keyframe shows, below which it becomes a keyframe
_GRID = 8  # points a side by which that is measured
_FOCAL_CHECKS = 8, 16, 32  # keyframes at which a given focal length is compared with what they show
_CONTRADICTED = 3.7  # standard deviations: odds of a thousand to one
_TILT_STD, _RIGID = 0.004, 1.0  # radians and pixels, up to which a tilt found by few keyframes makes metric poses
_MAX_LOST_FRAMES = 10  # frames in a row without a place, after which a new map begins, if all keyframes were searched
_MAX_WAITING = 500  # frames between the first keyframes that are placed with them
_MIN_INLIERS = 15
_MATCHES = 80  # of a link, that the alignment uses
_FLOW_ERROR = 1.5  # pixels by which a corner that was followed may be off the motion of the plane
_ROUGH = 0.02  # the same of the way from frame to frame, or while the lens is not known, in sides
_FLOW_AGREEING = 0.5  # share of the corners that must agree on it


@dataclass(frozen=True)
class TrackingOptions:
    """Choices and knowledge of a tracker."""

    pair: EstimationOptions = field(default_factory=EstimationOptions)  # with λ, where it is known
    # of the windows of keyframes; λ is that of the cameras where ``pair`` has one
    alignment: AlignmentOptions = field(default_factory=AlignmentOptions)
    # whether an alignment is waited for where it is due, so that the same frames give the same poses; else no frame
    # waits for more than a part of its time
    patient: bool = True


@dataclass(frozen=True)
class Tracked:
    """The result of one frame."""

    number: int  # of the frame, in the order of arrival
    placement: Placement | None  # where it lies on the plane of its map; None where that is not known
    # distortion, distortion_std: λ by all frames up to this one, half-diagonal frame; NaN and inf where it cannot be
    # seen
    distortion: float
    distortion_std: float
    distortion_known: bool  # whether λ was given, or is so certain that it is kept from now on
    map_number: int  # maps have no common plane: a new one begins where the track was lost
    keyframe: bool
    inliers: int  # matches with the last keyframes that agree
    revised: bool = False  # whether the frame had come before and only now found its place
    quality: float = 0.0  # share of the matches that agree
    # (4, 4): of x, y, height and yaw, in units of the first keyframe's height and radians, relative to that; without
    # what all lengths share. None where there is no metric pose
    covariance: FloatArray | None = field(default=None, repr=False, compare=False)
    length_std: float = math.nan  # relative standard deviation that all lengths share
    reason: str = ""  # why there is no place; empty where there is one

    @property
    def pose(self) -> CameraPose | None:
        """Pose of the camera, where its place is known and the model has poses."""
        return None if self.placement is None else self.placement.pose


@dataclass
class _Frame:
    number: int
    camera: Camera
    image: PreparedImage
    detect: Callable[[PreparedImage], Features]
    attitude: tuple[float, float] | None = None  # (ψ, θ), radians, as measured
    place: Placement | None = None  # relative to the other keyframes, from the first one on
    aligned: bool = False  # whether that is on the plane of the map
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

    @property
    def textured(self) -> bool:
        """Whether it shows enough to be placed by."""
        return len(self.corners) >= _MIN_INLIERS or len(self.features) >= _MIN_INLIERS

    def motion_to(self, other: "_Frame", points: FloatArray) -> FloatArray:
        """Where another frame shows points (N, 2) of this one, by the places of both."""
        assert self.place is not None
        assert other.place is not None
        return from_plane(other.place.camera, other.place.homography, self.place.to_plane(points))

    @property
    def grid(self) -> FloatArray:
        """Points all over the image, pixels (N, 2)."""
        axes = [(np.arange(_GRID) + 0.5) * side / _GRID - 0.5 for side in self.camera.image_size]
        return np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, 2)


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
            for name in _ALIGNMENT_IMPORTS:  # now: nothing that follows should wait for them
                import_module(name)
        self._count, self._map, self._lost = 0, 0, 0
        self._flow = CornerFlow()
        self._model = options.alignment.model
        self._distortion = options.pair.distortion
        self._std = 0.0 if self.distortion_known else math.inf
        self._length_std = math.nan
        # Of positions, relative to their distance from the first, and of yaw, by a lens that is still estimated.
        self._shape_std = (0.0, 0.0)
        self._focal: float | None = None  # half diagonals, once one was found with a lens that is kept
        self._plane: MetricPlane | None = None
        self._doubt = 0.0  # of the logarithm of the focal length, where the images contradict it
        self.messages: list[Message] = []
        self._start_map()

    @property
    def distortion_known(self) -> bool:
        """True where λ was given, or is known well enough to be kept."""
        return self._options.pair.distortion is not None

    @property
    def waits(self) -> bool:
        """True while there are too few keyframes for a map."""
        return not self._mapped

    @property
    def numbers_without_place(self) -> set[int]:
        """Numbers of the frames that may still find their place."""
        waiting = {frame.number for frame, *_ in self._waiting}
        return waiting | {keyframe.number for keyframe in self._keyframes if not keyframe.aligned}

    def add(self, image: PreparedImage, camera: Camera, attitude: tuple[float, float] | None = None) -> list[Tracked]:
        """Register the next frame; it comes last, after those before it that only now have found their place.

        Parameters
        ----------
        image : PreparedImage
        camera : Camera
            Of the size of ``image``.
        attitude : (float, float), optional
            (ψ, θ), radians, as it was measured.
        """
        number, self._count = self._count, self._count + 1
        frame = _Frame(number, camera, image, self._detect, attitude, static=self._flow.is_static)
        if not self._keyframes:
            return [self._first(frame)]
        revised = [] if self._options.patient else self._take_over(_PATIENCE if self.waits else 0.0)
        return [*revised, *self._registered_frame(frame)]

    def _registered_frame(self, frame: _Frame) -> list[Tracked]:
        inliers = self._follow(frame)
        if inliers and self._shown_by_last(frame) >= _KEYFRAME_OVERLAP:
            self._lost = 0
            return [*self._confirmed(frame), self._tracked(frame, keyframe=False, inliers=inliers)]
        links = self._links(frame)
        if not links:
            return [self._without_place(frame)]
        self._lost = 0
        self._settle(frame, links)
        inliers = max(map(len, links))
        last = next((link for link in links if link.image1 == self._keyframes[-1].number), None)
        if last is not None and self._shown_by_last(frame) >= _KEYFRAME_OVERLAP:
            self._flow.begin(frame.image, last.points1, last.points2)
            return [*self._confirmed(frame), self._tracked(frame, keyframe=False, inliers=inliers)]
        confirmed = self._confirmed(frame)
        self._flow.begin(frame.image, frame.corners)
        revised = self._add_keyframe(frame, links)
        return [*confirmed, *revised, self._tracked(frame, keyframe=True, inliers=inliers)]

    def _first(self, frame: _Frame) -> Tracked:
        """The first keyframe of a map."""
        self._start_map()
        known = self._distortion if self._distortion is not None and math.isfinite(self._std) else 0.0
        camera = frame.camera if self._lens_given else frame.camera.with_coefficients(known)
        frame.place = Placement(camera, np.eye(3), None)
        self._plane = self._plane or self._given_plane(frame)
        if self._plane is not None:
            frame.place, frame.covariance = self._plane.below(camera, frame.attitude), np.zeros((4, 4))
        self._keyframes.append(frame)
        self._flow.begin(frame.image, frame.corners)
        reason = "first frame" if not self._map else "no keyframe shows what it shows: it begins a new map"
        reason = reason if frame.textured else "no floor texture"
        return self._tracked(frame, keyframe=True, inliers=0, reason=reason)

    @property
    def _lens_given(self) -> bool:
        return self._options.alignment.lens_known

    def _given_plane(self, frame: _Frame) -> MetricPlane | None:
        """What is given of the camera, where that suffices for metric poses from the second frame on."""
        tilt, rigid = self._options.alignment.tilt, self._model in ("auto", "rigid")
        camera = frame.camera
        if not self._metric_camera(camera) or tilt is None or not (rigid or self._model == "similarity"):
            return None
        assert camera.focal is not None
        self._model, self._focal = "rigid" if rigid else "similarity", camera.focal / camera.scale
        self._length_std = camera.focal_log_std
        return MetricPlane(self._focal, tilt, rigid)

    def _metric_camera(self, camera: Camera) -> bool:
        """Whether lens and focal length of a camera are given."""
        return self._lens_given and camera.focal is not None and camera.focal_source in ("option", "file")

    def _confirmed(self, frame: _Frame) -> list[Tracked]:
        """The first keyframe, where it has its place by what is given, and a second frame shows that it is one."""
        first = self._keyframes[0]
        if self._plane is None or first.aligned or len(self._keyframes) > 1 or frame.covariance is None:
            return []
        self._mapped = first.aligned = frame.aligned = True
        return [replace(self._tracked(first, keyframe=True, inliers=0), revised=True)]

    def _follow(self, frame: _Frame) -> int:
        """Place the frame by the corners of the last keyframe; how many agree, 0 where they do not place it."""
        matched = self._flow.follow(frame.image)
        if matched is None:
            return 0
        last = self._keyframes[-1]
        if not _agree(self._place(frame, last, *matched, rough=True)):
            frame.place, frame.aligned = None, False
            return 0
        # Where the view turns, what is followed from frame to frame drifts.
        now, before = matched_corners(frame.image, last.image, last.corners, partial(last.motion_to, frame))
        inliers = self._place(frame, last, before, now)
        if not _agree(inliers):
            frame.place, frame.aligned = None, False
            return 0
        self._flow.begin(frame.image, before, now)
        if not self._mapped and len(self._waiting) < _MAX_WAITING:
            self._waiting.append((frame, last, before[inliers], now[inliers]))
        return int(inliers.sum())

    def _place(
        self, frame: _Frame, other: _Frame, before: FloatArray, now: FloatArray, *, rough: bool = False
    ) -> BoolArray:
        """Place a frame by points (N, 2) of a keyframe that it shows too; which of them (N,) agree."""
        assert other.place is not None
        start = other.place
        stay = replace(start, camera=self._camera(frame, start))
        rough |= not (self._mapped or self.distortion_known)
        error = _ROUGH * max(frame.camera.image_size) if rough else _FLOW_ERROR
        homography, inliers = _fitted_homography(start.camera, stay.camera, before, now, error)
        frame.place, frame.aligned, frame.covariance = None, False, None
        if homography is None:
            return inliers
        frame.quality, frame.aligned = float(inliers.mean()), other.aligned
        if self._plane is None or other.covariance is None:
            frame.place = replace(stay, homography=start.homography @ homography)
            return inliers
        below = self._plane.below(stay.camera, frame.attitude)
        frame.place, step = self._plane.placed(below, now[inliers], start.to_plane(before[inliers]))
        at, was = frame.place.pose, start.pose
        if at is not None and was is not None:
            frame.covariance = chained(other.covariance, step, (at.x - was.x, at.y - was.y), was.height)
        return inliers

    def _camera(self, frame: _Frame, beside: Placement) -> Camera:
        """The camera of a frame with the lens of another one."""
        return frame.camera if self._lens_given else frame.camera.with_coefficients(*beside.camera.coefficients)

    def _start_map(self) -> None:
        self._keyframes: list[_Frame] = []
        self._older: list[_Frame] = []  # keyframes that are no longer aligned with the last ones
        # Frames between keyframes without a map, and the points of a keyframe that they show: before and now.
        self._waiting: list[tuple[_Frame, _Frame, FloatArray, FloatArray]] = []
        self._window_links: list[Link] = []
        self._keyframes_seen, self._next_alignment = 0, _FIRST_ALIGNMENT
        self._alignment: tuple[list[_Frame], Future[Alignment]] | None = None
        self._taken_over_at = 0  # keyframes seen from which on it is
        self._mapped = False  # whether there is a plane that keyframes lie on
        self._searched = 0  # keyframes among which a lost frame has looked for its place

    def _without_place(self, frame: _Frame) -> Tracked:
        """A frame that no keyframe shows; after many of them, a new map begins with the last."""
        self._lost += 1
        if not frame.textured:
            return self._tracked(frame, keyframe=False, inliers=0, reason="no floor texture")
        alone = self.waits and len(self._keyframes) == 1
        searched = self._searched >= len(self._keyframes) + len(self._older)
        if (self._lost >= _MAX_LOST_FRAMES and searched) or alone:
            self._map += not alone
            self._lost = 0
            return self._first(frame)
        return self._tracked(frame, keyframe=False, inliers=0, reason="no keyframe shows what it shows")

    def _links(self, frame: _Frame) -> list[Link]:
        """The frame with the last keyframes, as far as they can be registered; of a lost one, with more of them."""
        recent = self._keyframes[::-1]
        if frame.place is not None and (links := self._links_by_corners(frame, recent[:_PARTNERS])):
            return links
        if self._lost == 0:
            self._searched = 0
        further = [*recent[_PARTNERS:], *self._older[::-1]]
        start = max(self._searched - _PARTNERS, 0) % max(len(further), 1)
        for others in (recent[:_PARTNERS], further[start : start + _SEARCHED]):
            self._searched += len(others) if others is not recent[:_PARTNERS] or not self._searched else 0
            matched = [self._match(other.features, frame.features) for other in others]
            pairs = [(other, m.points1, m.points2, -m.ratio) for other, m in zip(others, matched, strict=True)]
            if links := self._registered(frame, pairs):
                self._settle(frame, links)
                numbers = {link.image1 for link in links}
                shown = [keyframe for keyframe in others if keyframe.number in numbers]
                # They are neighbours again.
                self._keyframes = [k for k in self._keyframes if k not in shown] + shown[::-1]
                self._older = [k for k in self._older if k not in shown]
                return self._links_by_corners(frame, shown) or links
        return []

    def _links_by_corners(self, frame: _Frame, others: Sequence[_Frame]) -> list[Link]:
        """The same by the corners of a frame whose place is about known."""
        if frame.place is None:
            return []
        matched = [
            (other, *matched_corners(other.image, frame.image, frame.corners, partial(frame.motion_to, other)), None)
            for other in others
        ]
        return self._registered(frame, matched)

    def _registered(
        self, frame: _Frame, matched: Sequence[tuple[_Frame, FloatArray, FloatArray, FloatArray | None]]
    ) -> list[Link]:
        """Links of keyframes with the frame, by matches (N, 2) of both and their quality (N,)."""
        if self.distortion_known:
            return self._registered_by_lens(frame, matched)
        pairs = [
            PairMatches(points1, points2, other.camera.with_focal(), frame.camera.with_focal(), quality)
            for other, points1, points2, quality in matched
        ]
        relations = estimate_radial_homographies(pairs, self._options.pair)
        return [
            Link(other.number, frame.number, points1[fit.inliers], points2[fit.inliers], fit)
            for (other, points1, points2, _), fit in zip(matched, relations, strict=True)
            if fit and fit.inliers.sum() >= _MIN_INLIERS
        ]

    def _registered_by_lens(
        self, frame: _Frame, matched: Sequence[tuple[_Frame, FloatArray, FloatArray, FloatArray | None]]
    ) -> list[Link]:
        """The same where the lens is known: a homography of undistorted points."""
        links = []
        for other, points1, points2, _ in matched:
            assert other.place is not None
            camera, camera2 = self._camera(other, other.place), self._camera(frame, other.place)
            homography, inliers = _fitted_homography(camera2, camera, points2, points1, _FLOW_ERROR)
            if homography is None or inliers.sum() < max(_MIN_INLIERS, _chance(len(points1))):
                continue
            cameras = camera.with_focal(), camera2.with_focal()
            relation = RadialHomography(homography, *cameras, inliers, distortion_std=0.0, model="homography")
            links.append(Link(other.number, frame.number, points1[inliers], points2[inliers], relation))
        return links

    def _settle(self, frame: _Frame, links: Sequence[Link]) -> None:
        """Place a frame by its largest link with a keyframe that is on the map, if there is any."""
        by_number = {keyframe.number: keyframe for keyframe in (*self._older, *self._keyframes)}
        links = [link for link in links if link.image1 in by_number]
        if not links:
            return
        best = max(links, key=lambda link: (by_number[link.image1].aligned, len(link)))
        self._place(frame, by_number[best.image1], best.points1, best.points2)
        frame.aligned &= frame.place is not None

    def _shown_by_last(self, frame: _Frame) -> float:
        """Share of the frame that the last keyframe shows."""
        last = self._keyframes[-1]
        if frame.place is None:
            return 0.0
        points = frame.motion_to(last, frame.grid)
        inside = (points >= 0.0).all(axis=1) & (points <= np.array(last.camera.image_size) - 1.0).all(axis=1)
        return float(inside.mean())

    def _add_keyframe(self, frame: _Frame, links: Sequence[Link]) -> list[Tracked]:
        """Keep the frame; take over an alignment of the window, which may place others, and begin the next."""
        self._older = [*self._older, *self._keyframes[: -_WINDOW + 1]][-_KEPT:]
        self._keyframes = [*self._keyframes, frame][-_WINDOW:]
        self._keyframes_seen += 1
        kept = {keyframe.number for keyframe in self._keyframes}
        links = [*self._window_links, *links]
        self._window_links = [link for link in links if link.image1 in kept and link.image2 in kept]
        if not self.distortion_known:
            self._vote()
        revised = self._find_plane(frame)
        if self._options.patient and self._keyframes_seen >= self._taken_over_at:
            revised += self._take_over(None)
        if self._keyframes_seen + 1 >= self._next_alignment and self._alignment is None:
            grown = max(2, round(self._next_alignment * (_GROWTH - 1.0)))
            steps = _ALIGNMENT_INTERVAL if self.distortion_known else min(grown, _ALIGNMENT_INTERVAL)
            self._next_alignment += steps
            # At a keyframe and not when it is done: so that time does not decide on the result.
            waits_long = self.distortion_known and not self.waits
            self._taken_over_at = self._keyframes_seen + (_ALIGNMENT_DELAY if waits_long else 1)
            self._align_window()
        return revised

    def _shown_camera(self, frame: _Frame) -> ShownCamera:
        """What the links of the keyframes show of a camera whose lens and focal length are given."""
        focal, by_number = frame.camera.focal, {keyframe.number: keyframe for keyframe in self._keyframes}
        assert focal is not None

        def seen(keyframe: _Frame, points: FloatArray) -> tuple[FloatArray, FloatArray]:
            camera = keyframe.camera
            return (camera.undistort(points) - camera.center) / focal, np.array(keyframe.attitude or (0.0, 0.0))

        pairs = []
        for link in self._window_links:
            rays1, one = seen(by_number[link.image1], link.points1)
            rays2, two = seen(by_number[link.image2], link.points2)
            pairs.append(SeenPair(rays1, rays2, one, two))
        shown = shown_camera(pairs)
        uncertain = math.hypot(shown.log_focal_std, frame.camera.focal_log_std)
        if frame.attitude is None and abs(shown.log_focal) > _CONTRADICTED * uncertain:
            self._doubt = math.hypot(shown.log_focal, shown.log_focal_std)
            self._length_std = max(self._length_std, self._doubt)
            self._tell(
                f"the images contradict the given focal length of {focal:.1f} pixels: they show about "
                f"{focal * math.exp(shown.log_focal):.1f}; lengths are as uncertain until that is settled",
                "focal-contradicted",
            )
        return shown

    def _find_plane(self, frame: _Frame) -> list[Tracked]:
        """The map by the tilt that a few keyframes show, where lens and focal length are given."""
        if not self._metric_camera(frame.camera) or self._model not in ("auto", "rigid"):
            return []
        if (self._plane is not None or self._mapped) and (
            frame.attitude is not None  # whose errors would be taken for those of the focal length
            or self._keyframes_seen not in _FOCAL_CHECKS
            or any(message.code == "focal-contradicted" for message in self.messages)
        ):
            return []
        shown, focal = self._shown_camera(frame), frame.camera.focal
        if self._plane is not None or self._mapped:
            return []
        assert focal is not None
        if not (shown.tilt_std < _TILT_STD and shown.rms * focal < _RIGID):
            return []
        self._plane = MetricPlane(focal / frame.camera.scale, shown.tilt, rigid=True)
        self._length_std, waiting = max(self._doubt, frame.camera.focal_log_std), self.numbers_without_place
        first, *others = self._keyframes
        first.place, first.covariance = self._plane.below(first.camera, first.attitude), np.zeros((4, 4))
        first.aligned = self._mapped = True
        for keyframe in others:
            self._settle(keyframe, [link for link in self._window_links if link.image2 == keyframe.number])
        return self._found(waiting, except_for=frame.number)

    def _found(self, waiting: set[int], except_for: int) -> list[Tracked]:
        """Place the frames between keyframes that now have a place; these and keyframes that were waiting for it."""
        for frame, keyframe, before, now in self._waiting:
            if keyframe.aligned:
                self._place(frame, keyframe, before, now)
        between, self._waiting = [frame for frame, *_ in self._waiting], []
        keyframes = [keyframe for keyframe in self._keyframes if keyframe.aligned and keyframe.number in waiting]
        keys = {keyframe.number for keyframe in keyframes}
        found = [*keyframes, *(frame for frame in between if frame.aligned and frame.number not in keys)]
        return [
            replace(self._tracked(frame, keyframe=frame.number in keys, inliers=0), revised=True)
            for frame in sorted(found, key=lambda frame: frame.number)
            if frame.number != except_for
        ]

    def _vote(self) -> None:
        """λ by the pairs alone, until there is an alignment."""
        if not self._mapped:
            relations = [link.relation for link in self._window_links]
            consensus = vote([r.distortion for r in relations], [r.distortion_std for r in relations])
            self._distortion, self._std = consensus.distortion, consensus.std

    def _align_window(self) -> None:
        """Begin to align the keyframes of the window among themselves."""
        place = {keyframe.number: index for index, keyframe in enumerate(self._keyframes)}
        links = [replace(link, image1=place[link.image1], image2=place[link.image2]) for link in self._window_links]
        known = self._options.pair.distortion
        cameras = [keyframe.camera.with_focal() for keyframe in self._keyframes]
        if known is not None and not self._lens_given:
            cameras = [camera.with_coefficients(known) for camera in cameras]
        if self._focal is not None:
            # Another focal length would give other heights: those of one map must not depend on the window.
            cameras = [camera.with_focal(self._focal * camera.scale, "option") for camera in cameras]
        attitudes = [keyframe.attitude for keyframe in self._keyframes if keyframe.attitude is not None]
        options = replace(
            self._options.alignment,
            model=self._model,
            lens="auto" if known is not None else "division",
            lens_known=known is not None,
            most=_MATCHES,
            attitudes=np.array(attitudes) if len(attitudes) == len(cameras) else None,
            reference=None,
            pose_covariance=known is None,
        )
        executor = self._executor if self._mapped else self._first_executor
        self._alignment = list(self._keyframes), executor.submit(align, cameras, links, options)

    def _take_over(self, patience: float | None) -> list[Tracked]:
        """λ, the model and the places of keyframes from an alignment; those that have found their place with it.

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
            self._tell(f"an alignment of the last keyframes failed ({error}); the next one is tried")
            return []
        (keyframes, _), self._alignment = self._alignment, None
        for message in alignment.messages:
            if message.severity in ("warning", "note"):
                self._tell(message.text, message.code)
        if alignment.on_sphere:
            self._tell("the camera turns on the spot: there is no path")
            return []
        if not self.distortion_known and alignment.distortion_std < self._std:
            self._distortion, self._std = alignment.distortion, alignment.distortion_std
        placed = [
            (keyframe, Placement(camera, homography, alignment.focal))
            for keyframe, camera, homography, used in zip(
                keyframes, alignment.cameras, alignment.homographies, alignment.used, strict=True
            )
            if used
        ]
        self._mapped = True
        if self._focal is None:
            self._length_std = alignment.length_std
        if any(message.code == "focal-contradicted" for message in alignment.messages):
            # The unit of the map was another one: all keyframes are placed anew.
            self._focal, self._length_std = alignment.focal, alignment.length_std
            for keyframe in (*self._older, *self._keyframes):
                keyframe.aligned = False
        waiting, move = self.numbers_without_place, _to_map(placed)
        for keyframe, placement in placed:
            keyframe.place, keyframe.aligned = move.applied(placement), True
        self._learn(alignment, keyframes)
        aligned = {id(keyframe) for keyframe, _ in placed}
        for keyframe in self._keyframes:
            links = [link for link in self._window_links if link.image2 == keyframe.number]
            if id(keyframe) not in aligned and links:
                self._settle(keyframe, links)
        return self._found(waiting, except_for=self._count - 1)

    def _learn(self, alignment: Alignment, keyframes: Sequence[_Frame]) -> None:
        """Keep what an alignment shows of the camera, for the frames to come."""
        poses, tilt = alignment.poses, alignment.tilt
        self._shape_std = (0.0, 0.0)
        if poses is not None and poses.covariance is not None:
            path = Trajectory.from_poses(poses)
            far = np.linalg.norm(path.position, axis=1)
            last = int(np.argmax(far))
            if path.covariance is not None and far[last] > 0.0:
                # Across: along it is what all lengths share.
                variance = float(np.linalg.eigvalsh(path.covariance[last, :2, :2])[0]) / far[last] ** 2
                self._shape_std = math.sqrt(max(variance, 0.0)), math.sqrt(float(path.covariance[:, 3, 3].max()))
        measured = [keyframe.attitude for keyframe in keyframes]
        known = ("rigid", "similarity", *(("tilting",) if None not in measured else ()))
        if alignment.model in known and poses is not None and tilt and alignment.focal:
            mount = tilt
            if None not in measured:
                mount = tuple(np.nanmedian(poses.tilt - np.array(measured, dtype=np.float64), axis=0).tolist())
            self._plane = MetricPlane(alignment.focal, (mount[0], mount[1]), alignment.model == "rigid")
            # Until there is a window, errors have nothing to grow from.
            reached = np.zeros((4, 4))
            for keyframe in self._keyframes:
                if keyframe.aligned:
                    reached = keyframe.covariance = reached if keyframe.covariance is None else keyframe.covariance
        else:
            self._plane = None
        if self.distortion_known and self._focal is None:
            self._model, self._focal = alignment.model, alignment.focal
        enough = self._std <= _KNOWN_STD and len(keyframes) >= _MIN_KEYFRAMES_FOR_LENS
        if not self.distortion_known and enough:
            pair = replace(self._options.pair, distortion=self._distortion, solver="auto")
            self._options = replace(self._options, pair=pair)
            self._model, self._focal = alignment.model, alignment.focal

    def _covariance(self, frame: _Frame, pose: CameraPose) -> FloatArray | None:
        """Of a frame's pose, with what all frames have in common but for the unit of lengths."""
        known, (relative, yaw_std) = frame.covariance, self._shape_std
        if known is None:
            if not relative:
                return None
            known = np.zeros((4, 4))
        place = (relative * math.hypot(pose.x, pose.y)) ** 2
        if frame.attitude is not None:
            # The foot of the camera is off by the error of its tilt, and so is that of the first frame.
            place += 2.0 * (pose.height * self._options.alignment.attitudes_std) ** 2
        return np.asarray(known + np.diag([place, place, 0.0, yaw_std**2]))

    def _tell(self, text: str, code: str = "") -> None:
        """Keep a message, if it is new."""
        if all(message.text != text for message in self.messages):
            self.messages.append(Message(text, code=code))

    def _tracked(self, frame: _Frame, *, keyframe: bool, inliers: int, reason: str = "") -> Tracked:
        placement = frame.place if frame.aligned else None
        if placement is None and not reason:
            alone = len(self._keyframes) == 1 and not keyframe
            reason = "the camera has not moved far enough yet" if alone else "the first keyframes are being aligned"
            reason = reason if self.waits else "it is not linked with the map yet"
        elif placement is not None:
            reason = "" if placement.pose is not None else "the model has no metric poses"
        return Tracked(
            number=frame.number,
            placement=placement,
            distortion=math.nan if self._distortion is None else self._distortion,
            distortion_std=self._std,
            distortion_known=self.distortion_known,
            map_number=self._map,
            keyframe=keyframe,
            inliers=inliers,
            quality=frame.quality,
            covariance=None if placement is None or placement.pose is None else self._covariance(frame, placement.pose),
            length_std=self._length_std,
            reason=reason,
        )


def _agree(inliers: BoolArray) -> bool:
    """Whether so many of the corners (N,) agree that they show where a frame lies."""
    return bool(inliers.sum() >= max(_MIN_INLIERS, _FLOW_AGREEING * len(inliers)))


def _fitted_homography(
    camera: Camera, camera2: Camera, points: FloatArray, points2: FloatArray, error: float
) -> tuple[FloatArray | None, BoolArray]:
    """Homography (3, 3) from undistorted normalized points of a second image to those of a first, and inliers (N,)."""
    inliers = np.zeros(len(points), dtype=np.bool_)
    target, source = camera.undistort(points), camera2.undistort(points2)
    seen = np.flatnonzero(np.isfinite(source).all(axis=1) & np.isfinite(target).all(axis=1))
    if len(seen) < _MIN_INLIERS:
        return None, inliers
    # Without the lens, where all numbers are of the size of an image: OpenCV computes in single precision.
    source, target = camera2.normalize(source[seen]), camera.normalize(target[seen])
    fit: Any = cv2.findHomography(source, target, cv2.RANSAC, error / camera.scale)
    homography, agree = fit
    if homography is None or not np.linalg.det(homography) > 0.0:
        return None, inliers
    inliers[seen[agree[:, 0] > 0]] = True
    return np.asarray(homography, dtype=np.float64), inliers


def _chance(matches: int) -> float:
    """Matches that must agree, so that a few wrong ones do not make a link: a homography takes four of any."""
    return _MIN_INLIERS + 0.05 * matches


def _to_map(placed: Sequence[tuple[_Frame, Placement]]) -> PlaneSimilarity:
    """From the plane of an alignment to that of the map; the first alignment defines it."""
    shared = [(new, keyframe.place) for keyframe, new in placed if keyframe.aligned and keyframe.place is not None]
    if shared:
        return PlaneSimilarity.between(*zip(*shared, strict=True))
    pose = placed[0][1].pose
    return PlaneSimilarity(1.0, 0.0) if pose is None else PlaneSimilarity.to_origin(pose)
