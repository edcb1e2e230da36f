"""The tracker: a frame comes in, its place on the plane comes out."""

import math
from collections.abc import Callable, Sequence
from concurrent.futures import Executor, Future
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from typing import Any

import cv2
import numpy as np

from rdstitch.alignment import Alignment, AlignmentOptions, align
from rdstitch.arrays import FloatArray
from rdstitch.errors import RegistrationError
from rdstitch.features import Features, Matcher
from rdstitch.features.corner_flow import CornerFlow, corners_of, matched_corners
from rdstitch.features.prepared_image import PreparedImage
from rdstitch.geometry.camera import Camera
from rdstitch.geometry.radial_homography import from_plane
from rdstitch.matching.distortion_consensus import vote
from rdstitch.matching.links import Link
from rdstitch.robust import EstimationOptions, PairMatches, estimate_radial_homographies
from rdstitch.tracking.placement import CameraPose, Placement, PlaneSimilarity

_WINDOW = 48  # keyframes that are kept
_PARTNERS = 2  # last keyframes that a frame is matched with
_SEARCHED = 12  # last keyframes among which a lost frame looks for its place
_FIRST_ALIGNMENT = 5  # keyframes that the first alignment takes
_GROWTH = 1.5  # from one alignment to the next, while λ is not known
_ALIGNMENT_INTERVAL = 24  # keyframes from one alignment to the next afterwards
_ALIGNMENT_DELAY = 8  # keyframes after which one is taken over, once λ is known; the next one before
_KNOWN_STD = 0.002  # of λ: a tenth of a pixel in the corner of an image of 640 x 480 pixels, over half of it
_MIN_KEYFRAMES_FOR_LENS = 12  # keyframes that λ is not known before
_KEYFRAME_OVERLAP = 0.8  # share of a frame that its last keyframe shows, below which it becomes a keyframe
_GRID = 8  # points a side by which that is measured
_MAX_LOST_FRAMES = 10  # frames in a row without a place, after which a new map begins
_MIN_INLIERS = 15
_MATCHES = 80  # of a link, that the alignment uses
_SAME_TILT = ("rigid", "similarity")
_FLOW_ERROR = 1.5  # pixels by which a corner that was followed may be off the motion of the plane
_UNKNOWN_LENS_ERROR = 0.02  # the same while the lens is not known, in sides
_FLOW_AGREEING = 0.5  # share of the corners that must agree on it


@dataclass(frozen=True)
class TrackingOptions:
    """Choices and knowledge of a tracker."""

    pair: EstimationOptions = field(default_factory=EstimationOptions)  # with λ, where it is known
    # of the windows of keyframes; λ is that of the cameras where ``pair`` has one
    alignment: AlignmentOptions = field(default_factory=AlignmentOptions)


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

    @property
    def pose(self) -> CameraPose | None:
        """Pose of the camera, where its place is known and the model has poses."""
        return None if self.placement is None else self.placement.pose


@dataclass
class _Keyframe:
    number: int
    camera: Camera
    image: PreparedImage
    detect: Callable[[PreparedImage], Features]
    place: Placement | None = None  # relative to the other keyframes, from the first one on
    aligned: bool = False  # whether that is on the plane of the map

    @cached_property
    def corners(self) -> FloatArray:
        """Corners (N, 2), by which it is matched where one knows about where it lies."""
        return corners_of(self.image)

    @cached_property
    def features(self) -> Features:
        """Features, by which it is matched where one does not."""
        return self.detect(self.image)

    def motion_to(self, other: "_Keyframe", points: FloatArray) -> FloatArray:
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
    """

    def __init__(
        self,
        options: TrackingOptions,
        detect: Callable[[PreparedImage], Features],
        matcher: Matcher,
        executor: Executor,
    ) -> None:
        self._options, self._detect, self._match, self._executor = options, detect, matcher, executor
        self._count, self._map, self._lost = 0, 0, 0
        self._flow = CornerFlow()
        self._model = options.alignment.model
        self._focal: float | None = None
        self._distortion, self._std = options.pair.distortion, math.inf
        if self._distortion is not None:
            self._std = 0.0
        self._start_map()

    @property
    def distortion_known(self) -> bool:
        """True where λ was given, or is known well enough to be kept."""
        return self._options.pair.distortion is not None

    @property
    def waits(self) -> bool:
        """True while there are too few keyframes for a map."""
        return self._planar_model is None

    @property
    def numbers_without_place(self) -> set[int]:
        """Numbers of the keyframes that may still find their place."""
        return {keyframe.number for keyframe in self._keyframes if not keyframe.aligned}

    def add(self, image: PreparedImage, camera: Camera) -> list[Tracked]:
        """Register the next frame; it comes last, after those before it that only now have found their place.

        Parameters
        ----------
        image : PreparedImage
        camera : Camera
            Of the size of ``image``.
        """
        number, self._count = self._count, self._count + 1
        frame = _Keyframe(number, camera, image, self._detect)
        if not self._keyframes:
            return [self._first(frame)]
        inliers = self._follow(frame)
        if inliers and self._shown_by_last(frame) >= _KEYFRAME_OVERLAP:
            self._lost = 0
            return [self._tracked(frame, keyframe=False, inliers=inliers)]
        links = self._links(frame)
        if not links:
            return [self._without_place(frame)]
        self._lost = 0
        self._settle(frame, links)
        inliers = max(map(len, links))
        if self._shown_by_last(frame) >= _KEYFRAME_OVERLAP:
            last = next((link for link in links if link.image1 == self._keyframes[-1].number), None)
            if last is not None:
                self._flow.begin(image, last.points1, last.points2)
            return [self._tracked(frame, keyframe=False, inliers=inliers)]
        self._flow.begin(image, frame.corners)
        return [*self._add_keyframe(frame, links), self._tracked(frame, keyframe=True, inliers=inliers)]

    def _first(self, frame: _Keyframe) -> Tracked:
        """The first keyframe of a map."""
        self._start_map()
        known = self._distortion if self._distortion is not None and math.isfinite(self._std) else 0.0
        frame.place = Placement(frame.camera.with_coefficients(known), np.eye(3), None)
        self._keyframes.append(frame)
        self._flow.begin(frame.image, frame.corners)
        return self._tracked(frame, keyframe=True, inliers=0)

    def _follow(self, frame: _Keyframe) -> int:
        """Place the frame by the corners of the last keyframe; how many agree, 0 where they do not place it."""
        matched = self._flow.follow(frame.image)
        if matched is None:
            return 0
        place, inliers = self._moved(frame, self._keyframes[-1], *matched)
        if inliers < max(_MIN_INLIERS, _FLOW_AGREEING * len(matched[0])):
            return 0
        frame.place, frame.aligned = place, self._keyframes[-1].aligned
        return inliers

    def _moved(
        self, frame: _Keyframe, other: _Keyframe, before: FloatArray, now: FloatArray
    ) -> tuple[Placement | None, int]:
        """The place of a frame by points (N, 2) of a keyframe that it shows too, and how many of them agree."""
        assert other.place is not None
        start = other.place
        stay = replace(start, camera=frame.camera.with_coefficients(*start.camera.coefficients))
        error = _UNKNOWN_LENS_ERROR * max(frame.camera.image_size) if self.waits else _FLOW_ERROR
        target, source = start.camera.undistort(before), stay.camera.undistort(now)
        seen = np.flatnonzero(np.isfinite(source).all(axis=1) & np.isfinite(target).all(axis=1))
        if len(seen) < _MIN_INLIERS:
            return None, 0
        # Without the lens, where all numbers are of the size of an image: OpenCV computes in single precision.
        source, target = stay.camera.normalize(source[seen]), start.camera.normalize(target[seen])
        fit: Any = cv2.findHomography(source, target, cv2.RANSAC, error / start.camera.scale)
        homography, agree = fit
        if homography is None:
            return None, 0
        inliers = agree[:, 0] > 0
        if self._planar_model in _SAME_TILT:
            before, now = start.to_plane(before[seen][inliers]), stay.to_plane(now[seen][inliers])
            rigid = self._planar_model == "rigid"
            place = PlaneSimilarity.fitted(now, before, keep_size=rigid).applied(stay)
        else:
            place = replace(stay, homography=start.homography @ homography)
        return place, int(inliers.sum())

    def _start_map(self) -> None:
        self._keyframes: list[_Keyframe] = []
        self._window_links: list[Link] = []
        self._keyframes_seen, self._next_alignment = 0, _FIRST_ALIGNMENT
        self._alignment: tuple[list[_Keyframe], Future[Alignment]] | None = None
        self._taken_over_at = 0  # keyframes seen from which on it is
        self._planar_model: str | None = None

    def _without_place(self, frame: _Keyframe) -> Tracked:
        """A frame that no keyframe shows; after many of them, a new map begins with the last."""
        self._lost += 1
        alone = self.waits and len(self._keyframes) == 1
        if self._lost >= _MAX_LOST_FRAMES or alone:
            self._map += not alone
            self._lost = 0
            return self._first(frame)
        return self._tracked(frame, keyframe=False, inliers=0)

    def _links(self, frame: _Keyframe) -> list[Link]:
        """The frame with the last keyframes, as far as they can be registered; of a lost one, with more of them."""
        recent = self._keyframes[::-1]
        if frame.place is not None and (links := self._links_by_corners(frame, recent[:_PARTNERS])):
            return links
        for others in (recent[:_PARTNERS], recent[_PARTNERS:_SEARCHED]):
            matched = [self._match(other.features, frame.features) for other in others]
            pairs = [(other, m.points1, m.points2, -m.ratio) for other, m in zip(others, matched, strict=True)]
            if links := self._registered(frame, pairs):
                self._settle(frame, links)
                numbers = {link.image1 for link in links}
                return self._links_by_corners(frame, [k for k in others if k.number in numbers]) or links
        return []

    def _links_by_corners(self, frame: _Keyframe, others: Sequence[_Keyframe]) -> list[Link]:
        """The same by the corners of a frame whose place is about known."""
        if frame.place is None:
            return []
        matched = [
            (other, *matched_corners(other.image, frame.image, frame.corners, partial(frame.motion_to, other)), None)
            for other in others
        ]
        return self._registered(frame, matched)

    def _registered(
        self, frame: _Keyframe, matched: Sequence[tuple[_Keyframe, FloatArray, FloatArray, FloatArray | None]]
    ) -> list[Link]:
        """Links of keyframes with the frame, by matches (N, 2) of both and their quality (N,)."""
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

    def _settle(self, frame: _Keyframe, links: Sequence[Link]) -> None:
        """Place a frame by its largest link with a keyframe that is on the map, if there is any."""
        by_number = {keyframe.number: keyframe for keyframe in self._keyframes}
        best = max(links, key=lambda link: (by_number[link.image1].aligned, len(link)))
        other = by_number[best.image1]
        frame.place, _ = self._moved(frame, other, best.points1, best.points2)
        frame.aligned = other.aligned and frame.place is not None

    def _shown_by_last(self, frame: _Keyframe) -> float:
        """Share of the frame that the last keyframe shows."""
        last = self._keyframes[-1]
        if frame.place is None:
            return 0.0
        points = frame.motion_to(last, frame.grid)
        inside = (points >= 0.0).all(axis=1) & (points <= np.array(last.camera.image_size) - 1.0).all(axis=1)
        return float(inside.mean())

    def _add_keyframe(self, frame: _Keyframe, links: Sequence[Link]) -> list[Tracked]:
        """Keep the frame; take over an alignment of the window, which may place others, and begin the next."""
        self._keyframes = [*self._keyframes, frame][-_WINDOW:]
        self._keyframes_seen += 1
        first = self._keyframes[0].number
        self._window_links = [link for link in [*self._window_links, *links] if link.image1 >= first]
        if not self.distortion_known:
            self._vote()
        revised = self._take_over() if self._keyframes_seen >= self._taken_over_at else []
        if self._keyframes_seen + 1 >= self._next_alignment:
            grown = max(2, round(self._next_alignment * (_GROWTH - 1.0)))
            steps = _ALIGNMENT_INTERVAL if self.distortion_known else min(grown, _ALIGNMENT_INTERVAL)
            self._next_alignment += steps
            # At a keyframe and not when it is done: so that time does not decide on the result.
            waits_long = self.distortion_known and not self.waits
            self._taken_over_at = self._keyframes_seen + (_ALIGNMENT_DELAY if waits_long else 1)
            self._align_window()
        return revised

    def _vote(self) -> None:
        """λ by the pairs alone, until there is an alignment."""
        if self._planar_model is None:
            relations = [link.relation for link in self._window_links]
            consensus = vote([r.distortion for r in relations], [r.distortion_std for r in relations])
            self._distortion, self._std = consensus.distortion, consensus.std

    def _align_window(self) -> None:
        """Begin to align the keyframes of the window among themselves."""
        place = {keyframe.number: index for index, keyframe in enumerate(self._keyframes)}
        links = [replace(link, image1=place[link.image1], image2=place[link.image2]) for link in self._window_links]
        known = self._options.pair.distortion
        cameras = [keyframe.camera.with_focal() for keyframe in self._keyframes]
        if known is not None:
            cameras = [camera.with_coefficients(known) for camera in cameras]
        if self._focal is not None:
            # Another focal length would give other heights: those of one map must not depend on the window.
            cameras = [camera.with_focal(self._focal * camera.scale, "option") for camera in cameras]
        options = replace(
            self._options.alignment,
            model=self._model,
            lens="auto" if known is not None else "division",
            lens_known=known is not None,
            most=_MATCHES,
            attitudes=None,
            reference=None,
        )
        self._alignment = list(self._keyframes), self._executor.submit(align, cameras, links, options)

    def _take_over(self) -> list[Tracked]:
        """λ, the model and the places of keyframes from an alignment; those that have found their place with it."""
        if self._alignment is None:
            return []
        (keyframes, task), self._alignment = self._alignment, None
        try:
            alignment = task.result()
        except RegistrationError:
            return []
        if alignment.on_sphere:
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
        self._planar_model = alignment.model
        waiting, move = self.numbers_without_place, _to_map(placed)
        for keyframe, placement in placed:
            keyframe.place, keyframe.aligned = move.applied(placement), True
        aligned = {id(keyframe) for keyframe, _ in placed}
        for keyframe in self._keyframes:
            links = [link for link in self._window_links if link.image2 == keyframe.number]
            if id(keyframe) not in aligned and links:
                self._settle(keyframe, links)
        if not self.distortion_known and self._std <= _KNOWN_STD and len(keyframes) >= _MIN_KEYFRAMES_FOR_LENS:
            pair = replace(self._options.pair, distortion=self._distortion, solver="auto")
            self._options = replace(self._options, pair=pair)
            self._model, self._focal = alignment.model, alignment.focal
        return [
            replace(self._tracked(keyframe, keyframe=True, inliers=0), revised=True)
            for keyframe in self._keyframes[:-1]
            if keyframe.aligned and keyframe.number in waiting
        ]

    def _tracked(self, frame: _Keyframe, *, keyframe: bool, inliers: int) -> Tracked:
        distortion = math.nan if self._distortion is None else self._distortion
        known = self.distortion_known
        placement = frame.place if frame.aligned else None
        return Tracked(frame.number, placement, distortion, self._std, known, self._map, keyframe, inliers)


def _to_map(placed: Sequence[tuple[_Keyframe, Placement]]) -> PlaneSimilarity:
    """From the plane of an alignment to that of the map; the first alignment defines it."""
    shared = [(new, keyframe.place) for keyframe, new in placed if keyframe.aligned and keyframe.place is not None]
    if shared:
        return PlaneSimilarity.between(*zip(*shared, strict=True))
    pose = placed[0][1].pose
    return PlaneSimilarity(1.0, 0.0) if pose is None else PlaneSimilarity.to_origin(pose)
