"""The last keyframes aligned among themselves while further frames come: λ, the model, and better places."""

import math
import weakref
from collections.abc import Callable, Sequence
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from concurrent.futures import TimeoutError as NotYet
from dataclasses import dataclass, replace
from importlib import import_module

import numpy as np

from rdstitch.alignment import Alignment, align
from rdstitch.results.messages import Message
from rdstitch.tracking.keyframe_map import KeyframeMap
from rdstitch.tracking.placement import Placement, PlaneSimilarity
from rdstitch.tracking.tracked_frame import TrackedFrame

_IMPORTS = "scipy.sparse.csgraph", "scipy.sparse.linalg", "scipy.spatial"  # of alignments
_FIRST = 5  # keyframes that the first alignment takes; 4: 3.5 mm; 8: 4.8 mm
_GROWTH = 1.5  # from one alignment to the next, while λ is not known
_INTERVAL = 24  # keyframes from one alignment to the next afterwards
_FIRST_DELAY = 1  # keyframes after which an alignment is taken over, before λ is known
_DELAY = 8  # the same afterwards
_EXACT = 1e-4  # of the logarithm of a focal length that an alignment keeps
_SAME_LENGTHS = 0.1  # of their standard deviation: change of all lengths that leaves the places of earlier frames
_MATCHES = 80  # of a link, that the alignment uses; 40: 3.2 mm; 160: 2.4 mm


@dataclass(frozen=True)
class _Window:
    """Keyframes that are being aligned."""

    keyframes: list[TrackedFrame]
    future: Future[Alignment]
    keeps_focal: bool


class MapRefinement:
    """One alignment at a time. Where it is waited for (``patient``), the same frames give the same poses."""

    def __init__(self, executor: Executor, *, patient: bool, report: Callable[[Message], None]) -> None:
        self.patient, self._report = patient, report
        # The first alignment is small, and starting a process takes longer.
        self._executor = self._first_executor = executor
        if not patient:
            self._first_executor = ThreadPoolExecutor(1)
            weakref.finalize(self, self._first_executor.shutdown, wait=False, cancel_futures=True)
            for name in _IMPORTS:  # now: nothing that follows should wait for them
                import_module(name)
        self._window: _Window | None = None
        self.start_map()

    def start_map(self) -> None:
        """Forget the alignments of the last map."""
        self._next = _FIRST
        self._taken_over_at = 0  # keyframes after the first from which on the alignment is
        self.drop()

    def drop(self) -> None:
        """Do not take over the alignment that is under way; one that has not begun keeps no worker busy."""
        if self._window is not None:
            self._window.future.cancel()
        self._window = None

    def begin_if_due(self, keyframe_map: KeyframeMap) -> None:
        """Begin the next alignment of a map to which a keyframe was added, if it is time for it."""
        if keyframe_map.added + 1 < self._next or self._window is not None:
            return
        lens_known = keyframe_map.knowledge.distortion_known
        grown = max(2, round(self._next * (_GROWTH - 1.0)))
        self._next += _INTERVAL if lens_known else min(grown, _INTERVAL)
        # At a keyframe and not when it is done: so that time does not decide on the result.
        self._taken_over_at = keyframe_map.added + (_DELAY if lens_known and keyframe_map.has_plane else _FIRST_DELAY)
        self.begin(keyframe_map)

    def begin(self, keyframe_map: KeyframeMap) -> None:
        """Begin to align the last keyframes among themselves."""
        window, knowledge, keeps_focal = list(keyframe_map.keyframes), keyframe_map.knowledge, keyframe_map.keeps_focal
        executor = self._executor if keyframe_map.has_plane else self._first_executor
        frames = [keyframe.frame for keyframe in window]
        options = replace(knowledge.options_for(frames), max_matches_per_link=_MATCHES, reference=None)
        cameras = knowledge.cameras_for(frames, _EXACT if keeps_focal else None)
        place = {keyframe.number: index for index, keyframe in enumerate(window)}
        links = [replace(link, image1=place[link.image1], image2=place[link.image2]) for link in keyframe_map.links]
        self._window = _Window(window, executor.submit(align, cameras, links, options), keeps_focal)

    def take_over(self, keyframe_map: KeyframeMap, patience: float | None) -> list[TrackedFrame]:
        """Take over what has been aligned; the frames whose places are new, those between keyframes among them.

        An alignment is waited for so many seconds at most, None for as long as it takes.
        """
        window = self._window
        if window is None or (alignment := self._finished(window, patience)) is None:
            return []
        waiting = {number for number, frame in keyframe_map.frames.items() if not frame.aligned}
        placements, length_factor = _on_map(keyframe_map, window, alignment)
        frames = [keyframe.frame for keyframe in window.keyframes]
        knowledge = keyframe_map.knowledge.with_alignment(alignment, frames, keeps_focal=window.keeps_focal)
        keyframe_map.align(placements, knowledge)
        # What was said of the lengths before is replaced, so that all lengths of a map are wrong by the same.
        std = None if window.keeps_focal else knowledge.length_std
        rescaled = std is not None and abs(math.log(length_factor)) > _SAME_LENGTHS * std
        return keyframe_map.revise(keyframe_map.frames if rescaled else waiting)

    def _finished(self, window: _Window, patience: float | None) -> Alignment | None:
        """The alignment of a window; None while it is under way, and, once the user knows, where there is none."""
        try:
            alignment = window.future.result(patience)
        except NotYet:
            return None
        except Exception as error:  # noqa: BLE001 - whatever it is, the frames that follow are worth more
            self.drop()
            self._report(Message(f"an alignment of the last keyframes failed ({error}); the next one is tried"))
            return None
        self.drop()
        for message in alignment.messages:
            if message.severity in ("warning", "note"):
                self._report(message)
        if alignment.on_sphere:
            self._report(Message("the camera turns on the spot: there is no path"))
            return None
        return alignment

    def is_waited_for(self, added: int) -> bool:
        """Whether the alignment is taken over when so many keyframes were added to the first."""
        return self.patient and added >= self._taken_over_at


def _on_map(keyframe_map: KeyframeMap, window: _Window, alignment: Alignment) -> tuple[dict[int, Placement], float]:
    """Places of keyframes, by number, on the map as they were aligned; by what factor lengths change."""
    aligned = zip(window.keyframes, alignment.cameras, alignment.homographies, alignment.used, strict=True)
    placed = [(keyframe, Placement(camera, h, alignment.focal)) for keyframe, camera, h, used in aligned if used]
    move, length_factor = _to_map(placed)
    first, placement = placed[0]  # an alignment uses its reference at least
    is_first = not keyframe_map.older and first.number == keyframe_map.keyframes[0].number
    if is_first and (pose := placement.pose) is not None:
        move = PlaneSimilarity.to_origin(pose)  # the others are relative to it
    return {keyframe.number: move.applied(placement) for keyframe, placement in placed}, length_factor


def _to_map(placed: Sequence[tuple[TrackedFrame, Placement]]) -> tuple[PlaneSimilarity, float]:
    """The move from the plane of an alignment to that of the map; by what factor lengths change.

    The first keyframe defines the map where there is none yet, and its height is the unit of lengths: heights stay as
    they are, whatever focal length they are computed by.
    """
    shared = [(new, keyframe.placement) for keyframe, new in placed if keyframe.aligned]
    if not shared:
        pose = placed[0][1].pose
        return PlaneSimilarity(1.0, 0.0) if pose is None else PlaneSimilarity.to_origin(pose), 1.0
    news, olds = zip(*shared, strict=True)
    move = PlaneSimilarity.between(news, olds)
    poses = [(one.pose, two.pose) for one, two in shared]
    known = [(new, old) for new, old in poses if new is not None and old is not None]
    if len(known) < len(poses):
        return move, 1.0
    length_factor = float(np.median([old.height / new.height for new, old in known])) / abs(move.turn)
    turn = move.turn * length_factor
    now, then = (np.mean([complex(pose.x, pose.y) for pose in side]) for side in zip(*known, strict=True))
    return PlaneSimilarity(turn, complex(length_factor * then - turn * now)), length_factor
