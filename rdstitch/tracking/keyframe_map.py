"""The map: the last keyframes, which are aligned together, older ones, and the frames placed by them."""

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from rdstitch.arrays import BoolArray, FloatArray
from rdstitch.matching.links import Link
from rdstitch.tracking.camera_knowledge import CameraKnowledge
from rdstitch.tracking.frame_links import MATCH_ERROR, camera_beside, fitted_homography
from rdstitch.tracking.metric_plane import chained
from rdstitch.tracking.placement import PlaneSimilarity
from rdstitch.tracking.state import TrackState
from rdstitch.tracking.tracked_frame import TrackedFrame

_WINDOW = 48  # last keyframes, that are aligned together
_KEPT = 200  # older keyframes at the most, among which a lost frame looks for its place
_SEARCHED = 12  # keyframes among which a lost frame looks at a time
_PARTNERS = 2  # last keyframes that a frame is matched with
_REVISED = 500  # frames between keyframes, whose places are revised with those of the keyframes
_ROUGH = 0.02  # sides: how far a corner may be off from frame to frame, or while the lens is not known


@dataclass(eq=False)
class KeyframeMap:
    """Keyframes in the order in which they came, or were found again, and what is known of their camera."""

    known: CameraKnowledge
    state: TrackState
    keyframes: list[TrackedFrame]  # the last ones
    older: list[TrackedFrame] = field(default_factory=list)
    links: list[Link] = field(default_factory=list)  # between the last ones
    # frames between keyframes, and the points of a keyframe that they show: before and now
    between: deque[tuple[TrackedFrame, TrackedFrame, FloatArray, FloatArray]] = field(
        default_factory=lambda: deque(maxlen=_REVISED)
    )
    seen: int = 0  # keyframes after the first
    searched: int = 0  # keyframes among which a lost frame has looked for its place

    def add(self, frame: TrackedFrame, links: Sequence[Link]) -> None:
        """The next keyframe."""
        if self.between and self.between[-1][0] is frame:
            self.between.pop()
        frame.keyframe = True
        self.older = [*self.older, *self.keyframes[: -_WINDOW + 1]][-_KEPT:]
        self.keyframes = [*self.keyframes, frame][-_WINDOW:]
        self.seen += 1
        kept = {keyframe.number for keyframe in self.keyframes}
        self.links = [link for link in (*self.links, *links) if link.image1 in kept and link.image2 in kept]

    def keep_between(self, frame: TrackedFrame, before: FloatArray, now: FloatArray) -> None:
        """Keep what a frame between keyframes shows of the last one, instead of what was kept of it."""
        if self.between and self.between[-1][0] is frame:
            self.between.pop()
        self.between.append((frame, self.keyframes[-1], before, now))

    @property
    def whole(self) -> bool:
        """Whether the last keyframes are all of them."""
        return not self.older

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
        return self.known.focal is not None and (self.known.stated_std > 0.0 or not self.whole)

    @property
    def partners(self) -> list[TrackedFrame]:
        """What a frame is matched with."""
        return self.keyframes[: -_PARTNERS - 1 : -1]

    def to_search(self) -> list[TrackedFrame]:
        """Further keyframes for a frame without a place, others each time while the track is lost."""
        further = [*self.keyframes[:-_PARTNERS][::-1], *self.older[::-1]]
        start = self.searched % max(len(further), 1) if self.state.lost else 0
        chosen = further[start : start + _SEARCHED]
        self.searched = len(chosen) + (self.searched if self.state.lost else 0)
        return chosen

    @property
    def all_searched(self) -> bool:
        """Whether a lost frame was compared with all."""
        return self.searched >= len(self.older) + max(len(self.keyframes) - _PARTNERS, 0)

    def found_again(self, shown: Sequence[TrackedFrame]) -> None:
        """Keyframes that a frame shows again are neighbours again."""
        self.keyframes = [k for k in self.keyframes if k not in shown] + list(shown)[::-1]
        self.older = [k for k in self.older if k not in shown]

    def place(
        self, frame: TrackedFrame, other: TrackedFrame, before: FloatArray, now: FloatArray, *, rough: bool = False
    ) -> BoolArray:
        """Place a frame by points (N, 2) of a keyframe that it shows too; which of them (N,) agree."""
        assert other.place is not None
        start, known = other.place, self.known
        stay = replace(start, camera=camera_beside(frame, start, lens_given=known.lens_given))
        rough |= self.state.initialising and not known.distortion_known
        error = _ROUGH * max(frame.camera.image_size) if rough else MATCH_ERROR
        homography, inliers = fitted_homography(start.camera, stay.camera, before, now, error)
        frame.unplace()
        if homography is None:
            return inliers
        frame.quality, frame.aligned = float(inliers.mean()), other.aligned
        if known.plane is None or other.covariance is None:
            frame.place = replace(stay, homography=start.homography @ homography)
            return inliers
        below = known.plane.below(stay.camera, known.attitude(frame))
        tilt_std = 0.0 if frame.attitude is None else known.attitude_std(frame)
        frame.place, step = known.plane.placed(below, now[inliers], start.to_plane(before[inliers]), tilt_std=tilt_std)
        at, was = frame.place.pose, start.pose
        if at is not None and was is not None:
            frame.covariance = chained(other.covariance, step, (at.x - was.x, at.y - was.y), was.height)
        return inliers

    def settle(self, frame: TrackedFrame, links: Sequence[Link] | None = None) -> None:
        """Place a frame by its largest link, None: of those kept, with a keyframe of the map that has a place."""
        by_number = self.by_number
        known = [link for link in self.links if link.image2 == frame.number] if links is None else links
        if known := [link for link in known if link.image1 in by_number]:
            best = max(known, key=lambda link: (by_number[link.image1].aligned, len(link)))
            self.place(frame, by_number[best.image1], best.points1, best.points2)

    def place_anew(self, longer: float) -> None:
        """Place all keyframes by the camera as it is known now, by which lengths are so many times as long."""
        assert self.known.plane is not None
        first, *others = self.keyframes
        assert first.place is not None
        was, move = first.place.pose, PlaneSimilarity(1.0, 0.0)
        if was is not None and first.aligned:
            move = PlaneSimilarity(np.exp(-1j * was.yaw).item(), longer * complex(was.x, was.y))
        first.place = move.applied(self.known.plane.below(first.camera, self.known.attitude(first)))
        first.covariance = np.zeros((4, 4)) if first.covariance is None else first.covariance
        first.aligned, self.state = True, self.state.with_plane()
        for keyframe in self.older:
            assert keyframe.place is not None
            keyframe.place = PlaneSimilarity(longer, 0.0).applied(keyframe.place)
        for keyframe in others:
            assert keyframe.place is not None
            about = PlaneSimilarity(longer, 0.0).applied(keyframe.place)
            self.settle(keyframe)
            keyframe.place = keyframe.place or about  # a keyframe always has one

    def revise(self, waiting: set[int] | None = None) -> list[TrackedFrame]:
        """Place the frames between keyframes anew; of all that have a place those that were waiting, None: all."""
        keyframes = self.by_number
        for frame, keyframe, before, now in self.between:
            if keyframe.aligned and (waiting is None or frame.number in waiting):
                self.place(frame, keyframe, before, now)
                keyframes.setdefault(frame.number, frame)
        found = sorted(keyframes.items())
        return [frame for number, frame in found if frame.aligned and (waiting is None or number in waiting)]
