"""The map: the last keyframes, which are aligned together, older ones, and the frames placed by them."""

from collections import deque
from collections.abc import Container, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from rdstitch.arrays import FloatArray
from rdstitch.features import Matcher
from rdstitch.matching.links import Link
from rdstitch.tracking.camera_knowledge import CameraKnowledge, FocalOrigin
from rdstitch.tracking.frame_links import MATCH_ERROR, fitted_homography, links_by_corners, links_by_features
from rdstitch.tracking.metric_plane import chained
from rdstitch.tracking.placement import Placement, PlaneSimilarity
from rdstitch.tracking.tracked_frame import IncomingFrame, TrackedFrame

_WINDOW = 48  # last keyframes, that are aligned together
_KEPT = 200  # older keyframes at the most, among which a lost frame looks for its place
_SEARCHED = 12  # keyframes among which a lost frame looks at a time
# Last keyframes that a frame is matched with; 1: 4.8 mm, 13 beyond 5 σ; 4: 2.1 mm, keyframes take 1.5 times the time.
_PARTNERS = 2
_REVISED = 500  # frames between keyframes, whose places are revised with those of the keyframes
# sides: how far a corner may be off from frame to frame, or while the lens is not known; 0.01, 0.04: much the same
_ROUGH = 0.02
_MAX_LOST_FRAMES = 10  # frames in a row without a place, after which a new map begins, if all keyframes were searched


@dataclass(eq=False)
class KeyframeMap:
    """Keyframes in the order in which they came, or were found again, and what is known of their camera.

    The track is initialising until the map has a plane, and lost while no keyframe shows the latest frames.
    """

    knowledge: CameraKnowledge  # the latest; each is a value, which nobody changes
    keyframes: list[TrackedFrame]  # the last ones
    number: int = 0  # of the map
    has_plane: bool = False  # whether keyframes lie on a plane
    lost_frames: int = 0  # the last ones, which no keyframe shows
    older: list[TrackedFrame] = field(default_factory=list)
    links: list[Link] = field(default_factory=list)  # between the last ones
    # frames between keyframes, and the points of a keyframe that they show: before and now
    between: deque[tuple[TrackedFrame, TrackedFrame, FloatArray, FloatArray]] = field(
        default_factory=lambda: deque(maxlen=_REVISED)
    )
    added: int = 0  # keyframes after the first
    searched: int = 0  # keyframes among which a lost frame has looked for its place

    def add(self, frame: TrackedFrame, links: Sequence[Link]) -> None:
        """Add the next keyframe, and its links with others."""
        if self.between and self.between[-1][0].number == frame.number:
            self.between.pop()
        frame.keyframe = True
        self.older = [*self.older, *self.keyframes[: -_WINDOW + 1]][-_KEPT:]
        self.keyframes = [*self.keyframes, frame][-_WINDOW:]
        self.added += 1
        kept = {keyframe.number for keyframe in self.keyframes}
        self.links = [link for link in (*self.links, *links) if link.image1 in kept and link.image2 in kept]

    def keep_between(self, frame: TrackedFrame, before: FloatArray, now: FloatArray) -> None:
        """Keep what a frame between keyframes shows of the last one, instead of what was kept of it."""
        if self.between and self.between[-1][0].number == frame.number:
            self.between.pop()
        self.between.append((frame, self.keyframes[-1], before, now))

    @property
    def by_number(self) -> dict[int, TrackedFrame]:
        """All keyframes."""
        return {keyframe.number: keyframe for keyframe in (*self.older, *self.keyframes)}

    @property
    def frames(self) -> dict[int, TrackedFrame]:
        """All frames that may still find their place, or another one."""
        return {frame.number: frame for frame, *_ in self.between} | self.by_number

    @property
    def keeps_focal(self) -> bool:
        """Whether alignments keep the focal length: that of one map must not depend on the window."""
        focal = self.knowledge.focal
        return focal is not None and (focal.origin is not FocalOrigin.ALIGNMENT or bool(self.older))

    def links_with(self, frame: IncomingFrame, placed: TrackedFrame | None, match: Matcher) -> list[Link]:
        """Links of a frame with the last keyframes, as far as they can be registered; of a lost one, with more."""
        last = self.keyframes[: -_PARTNERS - 1 : -1]
        if placed is not None and (links := links_by_corners(placed, last, self.knowledge)):
            return links
        for others in (last, self._to_search()):
            if links := links_by_features(frame, others, match, self.knowledge):
                if (about := self.place_by_links(frame, links)) is None:
                    return links
                numbers = {link.image1 for link in links}
                shown = [keyframe for keyframe in others if keyframe.number in numbers]
                # What a frame shows again is among the last keyframes again.
                self.keyframes = [k for k in self.keyframes if k not in shown] + shown[::-1]
                self.older = [k for k in self.older if k not in shown]
                return links_by_corners(about, shown, self.knowledge) or links
        return []

    def _to_search(self) -> list[TrackedFrame]:
        """Further keyframes for a frame without a place, others each time while the track is lost."""
        further = [*self.keyframes[:-_PARTNERS][::-1], *self.older[::-1]]
        start = self.searched % max(len(further), 1) if self.lost_frames else 0
        chosen = further[start : start + _SEARCHED]
        self.searched = len(chosen) + (self.searched if self.lost_frames else 0)
        return chosen

    @property
    def next_number(self) -> int | None:
        """Number of the map that a frame begins which no keyframe shows; None while it is too early for one.

        A first keyframe that no frame shows is replaced.
        """
        if not self.has_plane and len(self.keyframes) == 1:
            return self.number
        all_searched = self.searched >= len(self.older) + max(len(self.keyframes) - _PARTNERS, 0)
        return self.number + 1 if self.lost_frames >= _MAX_LOST_FRAMES and all_searched else None

    def place(
        self, frame: IncomingFrame, other: TrackedFrame, before: FloatArray, now: FloatArray, *, rough: bool = False
    ) -> TrackedFrame | None:
        """Place a frame by points (N, 2) of a keyframe that it shows too; None where no homography fits."""
        start, knowledge = other.placement, self.knowledge
        camera = knowledge.camera_with_lens_of(start, frame)
        rough |= not (self.has_plane or knowledge.distortion_known)
        error = _ROUGH * max(frame.camera.image_size) if rough else MATCH_ERROR
        homography, inliers = fitted_homography(start.camera, camera, before, now, error)
        if homography is None:
            return None
        if knowledge.plane is None or other.covariance is None:
            placement = replace(start, camera=camera, homography=start.homography @ homography)
            return TrackedFrame(frame, placement, other.aligned, None, inliers)
        below = knowledge.plane.below(camera, knowledge.attitude(frame))
        tilt_std = 0.0 if frame.attitude is None else knowledge.attitude_std(frame)
        places = start.to_plane(before[inliers])
        placement, step = knowledge.plane.placed(below, now[inliers], places, tilt_std=tilt_std)
        at, was, covariance = placement.pose, start.pose, None
        if at is not None and was is not None:
            covariance = chained(other.covariance, step, (at.x - was.x, at.y - was.y), was.height)
        return TrackedFrame(frame, placement, other.aligned, covariance, inliers)

    def place_by_links(self, frame: IncomingFrame, links: Sequence[Link]) -> TrackedFrame | None:
        """Place a frame by the largest of its links with keyframes; None where there is none that fits."""
        by_number = self.by_number
        usable = [link for link in links if link.image2 == frame.number and link.image1 in by_number]
        if not usable:
            return None
        best = max(usable, key=lambda link: (by_number[link.image1].aligned, len(link)))
        return self.place(frame, by_number[best.image1], best.points1, best.points2)

    def confirm_first(self, second: TrackedFrame) -> TrackedFrame | None:
        """The first keyframe, if it lies below a given camera, and a second frame is the first to show that."""
        first = self.keyframes[0]
        unconfirmed = len(self.keyframes) == 1 and not first.aligned and self.knowledge.plane is not None
        if not unconfirmed or second.covariance is None:
            return None
        self.has_plane = True
        first.aligned = second.aligned = True
        return first

    def align(self, placements: Mapping[int, Placement], knowledge: CameraKnowledge) -> None:
        """Move keyframes, by number, to where an alignment has them, which shows this of the camera.

        The last ones that it left out move to where their links with the others have them.
        """
        self.knowledge, self.has_plane = knowledge, True
        for number, keyframe in self.by_number.items():
            if number in placements:
                keyframe.placement, keyframe.aligned, keyframe.predicted = placements[number], True, False
        covariance = np.zeros((4, 4))
        for keyframe in self.keyframes if knowledge.plane is not None else []:
            if keyframe.aligned:  # without a covariance, errors grow again from that of the keyframe before
                covariance = covariance if keyframe.covariance is None else keyframe.covariance
                keyframe.covariance = covariance
        self._place_again(keyframe for keyframe in self.keyframes if keyframe.number not in placements)

    def _place_again(self, keyframes: Iterable[TrackedFrame]) -> None:
        """Move keyframes, one after the other, to where their links with others have them."""
        for keyframe in keyframes:
            if (placed := self.place_by_links(keyframe.frame, self.links)) is not None:
                keyframe.move_to(placed)

    def rescale(self, length_factor: float) -> None:
        """Place all keyframes again by the camera as it is known now, which changes all lengths by a factor."""
        assert self.knowledge.plane is not None
        first, *others = self.keyframes
        was, move = first.pose, PlaneSimilarity(1.0, 0.0)
        if was is not None:
            move = PlaneSimilarity(np.exp(-1j * was.yaw).item(), length_factor * complex(was.x, was.y))
        below = move.applied(self.knowledge.plane.below(first.frame.camera, self.knowledge.attitude(first.frame)))
        first.placement, first.aligned = below, True
        first.covariance = np.zeros((4, 4)) if first.covariance is None else first.covariance
        self.has_plane, enlarge = True, PlaneSimilarity(length_factor, 0.0)
        for keyframe in (*self.older, *others):
            keyframe.placement = enlarge.applied(keyframe.placement)
        self._place_again(others)

    def revise(self, numbers: Container[int]) -> list[TrackedFrame]:
        """Place frames of these numbers anew where they lie between keyframes; all of these that have a place."""
        revised = self.by_number
        for placed, keyframe, before, now in self.between:
            if keyframe.aligned and placed.number in numbers:
                again = self.place(placed.frame, keyframe, before, now)
                placed.aligned = again is not None
                if again is not None:
                    placed.move_to(again)
                revised.setdefault(placed.number, placed)
        return [frame for number, frame in sorted(revised.items()) if frame.aligned and number in numbers]
