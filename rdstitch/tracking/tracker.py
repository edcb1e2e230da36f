"""The tracker: a frame comes in, its place on the plane comes out."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from rdstitch.alignment import Alignment, AlignmentOptions, align
from rdstitch.arrays import FloatArray
from rdstitch.camera import Camera
from rdstitch.errors import RegistrationError
from rdstitch.features import Features, Matcher
from rdstitch.features.prepared_image import PreparedImage
from rdstitch.inputs.corner_flow import CornerFlow, fitted_affine
from rdstitch.matching.distortion_consensus import vote
from rdstitch.matching.links import Link
from rdstitch.radial_homography import from_plane
from rdstitch.robust import EstimationOptions, PairMatches, estimate_radial_homographies
from rdstitch.tracking.placement import CameraPose, Placement, PlaneSimilarity

_WINDOW = 48  # keyframes that are kept
_PARTNERS = 2  # last keyframes that a frame is matched with
_SEARCHED = 12  # last keyframes among which a lost frame looks for its place
_FIRST_ALIGNMENT = 5  # keyframes that the first alignment takes
_GROWTH = 1.5  # from one alignment to the next, while λ is not known
_ALIGNMENT_INTERVAL = 24  # keyframes from one alignment to the next afterwards
_KNOWN_STD = 0.002  # of λ: a tenth of a pixel in the corner of an image of 640 x 480 pixels, over half of it
_MIN_KEYFRAMES_FOR_LENS = 12  # keyframes that λ is not known before
_KEYFRAME_OVERLAP = 0.8  # share of a frame that its last keyframe shows, below which it becomes a keyframe
_GRID = 8  # points a side by which that is measured
_MAX_LOST_FRAMES = 10  # frames in a row without a place, after which a new map begins
_MIN_INLIERS = 15
_MATCHES = 80  # of a link, that the alignment uses
_SAME_TILT = ("rigid", "similarity")
_FLOW_ERROR = 1.5  # pixels by which a corner that was followed may be off the motion of the plane
_AFFINE_ERROR = 0.02  # the same of an affine motion, in sides: lenses and tilts are not affine
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
    features: Features
    placement: Placement | None = None


class Tracker:
    """Registers frames of one camera one after the other."""

    def __init__(self, options: TrackingOptions, matcher: Matcher) -> None:
        self._options, self._match = options, matcher
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
        return {keyframe.number for keyframe in self._keyframes if keyframe.placement is None}

    def add(
        self, features: Features | Callable[[], Features], camera: Camera, image: PreparedImage | None = None
    ) -> list[Tracked]:
        """Register the next frame; it comes last, after those before it that only now have found their place.

        Parameters
        ----------
        features : Features or callable
            Of the frame, or what finds them: they are asked for only where corners of the last keyframe, which are
            followed from frame to frame, do not place it, or it becomes a keyframe.
        camera : Camera
            Of the size that the features' points are measured at.
        image : PreparedImage, optional
            The frame at that size, in which corners are followed; without it none are.
        """
        number, self._count = self._count, self._count + 1
        if (followed := self._followed(number, camera, image)) is not None:
            return [followed]
        results = self._registered_frame(_Keyframe(number, camera, features() if callable(features) else features))
        if results[-1].keyframe:
            self._flow.begin(image)
        return results

    def _followed(self, number: int, camera: Camera, image: PreparedImage | None) -> Tracked | None:
        """The frame placed by the corners of the last keyframe, where these show enough of it."""
        matched = None if image is None else self._flow.follow(image)
        last = self._keyframes[-1] if self._keyframes else None
        if matched is None or last is None or image is None or image.grey.shape[::-1] != camera.image_size:
            return None
        frame = _Keyframe(number, camera, last.features)
        if last.placement is None and self.waits:
            lens = camera.with_coefficients(self._distortion if self._distortion and math.isfinite(self._std) else 0.0)
            error = _AFFINE_ERROR * max(camera.image_size)
            move, inliers = fitted_affine(lens.undistort(matched[0]), lens.undistort(matched[1]), error)
            if move is None:
                return None
            seen = lens.distort(lens.undistort(self._grid(camera)) @ move[:, :2].T + move[:, 2])
        elif last.placement is not None and self._planar_model in _SAME_TILT:
            coefficients = last.placement.camera.coefficients
            stay = replace(last.placement, camera=camera.with_coefficients(*coefficients))
            target, source = last.placement.to_plane(matched[0]), stay.to_plane(matched[1])
            pixel = float(np.std(target)) / max(float(np.std(matched[0])), 1e-9)
            _, inliers = fitted_affine(target, source, _FLOW_ERROR * pixel)
            if inliers.sum() < _MIN_INLIERS:
                return None
            rigid = self._planar_model == "rigid"
            frame.placement = PlaneSimilarity.fitted(source[inliers], target[inliers], keep_size=rigid).applied(stay)
            ground = frame.placement.to_plane(self._grid(camera))
            seen = from_plane(last.placement.camera, last.placement.homography, ground)
        else:
            return None
        if inliers.sum() < max(_MIN_INLIERS, _FLOW_AGREEING * len(inliers)):
            return None
        if self._share_inside(seen, last.camera) < _KEYFRAME_OVERLAP:
            return None
        self._lost = 0
        return self._tracked(frame, keyframe=False, inliers=int(inliers.sum()))

    def _registered_frame(self, frame: _Keyframe) -> list[Tracked]:
        """Register a frame by its features."""
        if not self._keyframes:
            self._keyframes.append(frame)
            return [self._tracked(frame, keyframe=True, inliers=0)]
        links = self._links(frame)
        inliers = max((len(link) for link in links), default=0)
        if not links:
            return [self._without_place(frame)]
        self._lost = 0
        frame.placement = self._placed(frame, links)
        if self._shown_by_last(frame, links) >= _KEYFRAME_OVERLAP:
            return [self._tracked(frame, keyframe=False, inliers=inliers)]
        return [*self._add_keyframe(frame, links), self._tracked(frame, keyframe=True, inliers=inliers)]

    def _start_map(self) -> None:
        self._keyframes: list[_Keyframe] = []
        self._window_links: list[Link] = []
        self._keyframes_seen, self._next_alignment = 0, _FIRST_ALIGNMENT
        self._planar_model: str | None = None

    def _without_place(self, frame: _Keyframe) -> Tracked:
        """A frame that no keyframe shows; after many of them, a new map begins with the last."""
        self._lost += 1
        waiting = self._planar_model is None and len(self._keyframes) == 1
        if self._lost >= _MAX_LOST_FRAMES or waiting:
            self._map += not waiting
            self._lost = 0
            self._start_map()
            self._keyframes.append(frame)
            return self._tracked(frame, keyframe=True, inliers=0)
        return self._tracked(frame, keyframe=False, inliers=0)

    def _links(self, frame: _Keyframe) -> list[Link]:
        """The frame with the last keyframes, as far as they can be registered; of a lost one, with more of them."""
        recent = self._keyframes[::-1]
        links = self._registered(frame, recent[:_PARTNERS])
        return links or self._registered(frame, recent[_PARTNERS:_SEARCHED])

    def _registered(self, frame: _Keyframe, others: Sequence[_Keyframe]) -> list[Link]:
        """Links of other frames with the frame, by the numbers of all."""
        if not others:
            return []
        matched = [self._match(other.features, frame.features) for other in others]
        pairs = [
            PairMatches(
                matches.points1, matches.points2, other.camera.with_focal(), frame.camera.with_focal(), -matches.ratio
            )
            for other, matches in zip(others, matched, strict=True)
        ]
        relations = estimate_radial_homographies(pairs, self._options.pair)
        return [
            Link(other.number, frame.number, matches.points1[fit.inliers], matches.points2[fit.inliers], fit)
            for other, matches, fit in zip(others, matched, relations, strict=True)
            if fit and fit.inliers.sum() >= _MIN_INLIERS
        ]

    def _placed(self, frame: _Keyframe, links: Sequence[Link]) -> Placement | None:
        """The place of a frame by its links with keyframes that have one."""
        by_number = {keyframe.number: keyframe for keyframe in self._keyframes}
        known = [(by_number[k.image1].placement, k) for k in links]
        placed = [(placement, link) for placement, link in known if placement is not None]
        if not placed:
            return None
        nearest, best = max(placed, key=lambda pair: len(pair[1]))
        camera = frame.camera.with_coefficients(*nearest.camera.coefficients)
        if self._planar_model not in _SAME_TILT:
            inverse = np.linalg.inv(best.relation.homography)
            return Placement(camera, nearest.homography @ inverse, nearest.focal)
        # Where the camera of that keyframe would see the matches, and where they are: one motion of the plane.
        stay = Placement(camera, nearest.homography, nearest.focal)
        source = np.concatenate([stay.to_plane(link.points2) for _, link in placed])
        target = np.concatenate([placement.to_plane(link.points1) for placement, link in placed])
        seen = np.isfinite(source).all(axis=1) & np.isfinite(target).all(axis=1)
        return PlaneSimilarity.fitted(source[seen], target[seen], keep_size=self._planar_model == "rigid").applied(stay)

    def _shown_by_last(self, frame: _Keyframe, links: Sequence[Link]) -> float:
        """Share of the frame that the newest of its partners shows."""
        last = max(links, key=lambda link: link.image1)
        transferred = last.relation.transfer(self._grid(frame.camera))  # the camera moved by about as much either way
        return self._share_inside(transferred, frame.camera)

    @staticmethod
    def _grid(camera: Camera) -> FloatArray:
        """Points all over an image, pixels (N, 2)."""
        axes = [(np.arange(_GRID) + 0.5) * side / _GRID - 0.5 for side in camera.image_size]
        return np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, 2)

    @staticmethod
    def _share_inside(points: FloatArray, camera: Camera) -> float:
        """Share of points (N, 2) that lie in an image."""
        inside = (points >= 0.0).all(axis=1) & (points <= np.array(camera.image_size) - 1.0).all(axis=1)
        return float(inside.mean())

    def _add_keyframe(self, frame: _Keyframe, links: Sequence[Link]) -> list[Tracked]:
        """Keep the frame; align the window when it is due, which may place frames that had none."""
        self._keyframes = [*self._keyframes, frame][-_WINDOW:]
        self._keyframes_seen += 1
        first = self._keyframes[0].number
        self._window_links = [link for link in [*self._window_links, *links] if link.image1 >= first]
        if not self.distortion_known:
            self._vote()
        if self._keyframes_seen + 1 < self._next_alignment:
            return []
        steps = _ALIGNMENT_INTERVAL if self.distortion_known else max(2, round(self._next_alignment * (_GROWTH - 1.0)))
        self._next_alignment += min(steps, _ALIGNMENT_INTERVAL)
        without = [keyframe for keyframe in self._keyframes[:-1] if keyframe.placement is None]
        self._align_window()
        placed = [keyframe for keyframe in without if keyframe.placement is not None]
        return [replace(self._tracked(keyframe, keyframe=True, inliers=0), revised=True) for keyframe in placed]

    def _vote(self) -> None:
        """λ by the pairs alone, until there is an alignment."""
        if self._planar_model is None:
            relations = [link.relation for link in self._window_links]
            consensus = vote([r.distortion for r in relations], [r.distortion_std for r in relations])
            self._distortion, self._std = consensus.distortion, consensus.std

    def _align_window(self) -> None:
        """Align the keyframes of the window among themselves, and bring them to the plane of the map."""
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
        try:
            alignment = align(cameras, links, options)
        except RegistrationError:
            return
        if alignment.on_sphere:
            return
        self._take_over(alignment)

    def _take_over(self, alignment: Alignment) -> None:
        """λ, the model and the places of the keyframes from an alignment of the window."""
        if not self.distortion_known and alignment.distortion_std < self._std:
            self._distortion, self._std = alignment.distortion, alignment.distortion_std
        placements: list[Placement | None] = [
            Placement(camera, homography, alignment.focal) if used else None
            for camera, homography, used in zip(alignment.cameras, alignment.homographies, alignment.used, strict=True)
        ]
        self._planar_model = alignment.model
        move = self._to_map(placements)
        if move is None:
            return
        for keyframe, placement in zip(self._keyframes, placements, strict=True):
            if placement is not None:
                keyframe.placement = move.applied(placement)
        if not self.distortion_known and self._std <= _KNOWN_STD and len(self._keyframes) >= _MIN_KEYFRAMES_FOR_LENS:
            self._options = replace(
                self._options, pair=replace(self._options.pair, distortion=self._distortion, solver="auto")
            )
            self._model, self._focal = alignment.model, alignment.focal

    def _to_map(self, placements: Sequence[Placement | None]) -> PlaneSimilarity | None:
        """From the plane of an alignment to that of the map; the first alignment defines it."""
        both = [(new, keyframe.placement) for new, keyframe in zip(placements, self._keyframes, strict=True)]
        shared = [(new, old) for new, old in both if new is not None and old is not None]
        if shared:
            return PlaneSimilarity.between(*zip(*shared, strict=True))
        first = next((placement for placement in placements if placement is not None), None)
        if first is None:
            return None
        return PlaneSimilarity(1.0, 0.0) if first.pose is None else PlaneSimilarity.to_origin(first.pose)

    def _tracked(self, frame: _Keyframe, *, keyframe: bool, inliers: int) -> Tracked:
        distortion = math.nan if self._distortion is None else self._distortion
        known = self.distortion_known
        return Tracked(frame.number, frame.placement, distortion, self._std, known, self._map, keyframe, inliers)
