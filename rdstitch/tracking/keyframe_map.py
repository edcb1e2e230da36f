"""The keyframes of a map: the last ones, which are aligned together, older ones, and the links between them."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

from rdstitch.matching.links import Link
from rdstitch.tracking.tracked_frame import TrackedFrame

_KEPT = 200  # older keyframes at the most, among which a lost frame looks for its place
_SEARCHED = 12  # keyframes among which a lost frame looks at a time
_PARTNERS = 2  # last keyframes that a frame is matched with


@dataclass
class KeyframeMap:
    """Keyframes in the order in which they came, or were found again."""

    window: int  # keyframes that are aligned together
    keyframes: list[TrackedFrame] = field(default_factory=list)  # the last ones
    older: list[TrackedFrame] = field(default_factory=list)
    links: list[Link] = field(default_factory=list)  # between the last ones
    seen: int = 0
    searched: int = 0  # keyframes among which a lost frame has looked for its place

    def add(self, frame: TrackedFrame, links: Sequence[Link]) -> None:
        """The next keyframe."""
        self.older = [*self.older, *self.keyframes[: -self.window + 1]][-_KEPT:]
        self.keyframes = [*self.keyframes, frame][-self.window :]
        self.seen += 1
        kept = {keyframe.number for keyframe in self.keyframes}
        self.links = [link for link in (*self.links, *links) if link.image1 in kept and link.image2 in kept]

    @property
    def whole(self) -> bool:
        """Whether the last keyframes are all of them."""
        return not self.older

    @property
    def by_number(self) -> dict[int, TrackedFrame]:
        """All keyframes."""
        return {keyframe.number: keyframe for keyframe in (*self.older, *self.keyframes)}

    def links_to(self, frame: TrackedFrame) -> list[Link]:
        """Links of a keyframe with those before it."""
        return [link for link in self.links if link.image2 == frame.number]

    def window_links(self) -> list[Link]:
        """The links by the places of the keyframes in the window."""
        place = {keyframe.number: index for index, keyframe in enumerate(self.keyframes)}
        return [replace(link, image1=place[link.image1], image2=place[link.image2]) for link in self.links]

    @property
    def partners(self) -> list[TrackedFrame]:
        """What a frame is matched with."""
        return self.keyframes[: -_PARTNERS - 1 : -1]

    def to_search(self) -> list[TrackedFrame]:
        """Further keyframes for a lost frame, others each time."""
        further = [*self.keyframes[:-_PARTNERS][::-1], *self.older[::-1]]
        start = self.searched % max(len(further), 1)
        return further[start : start + _SEARCHED]

    @property
    def all_searched(self) -> bool:
        """Whether a lost frame was compared with all."""
        return self.searched >= len(self.older) + max(len(self.keyframes) - _PARTNERS, 0)

    def found_again(self, shown: Sequence[TrackedFrame]) -> None:
        """Keyframes that a frame shows again are neighbours again."""
        self.keyframes = [k for k in self.keyframes if k not in shown] + list(shown)[::-1]
        self.older = [k for k in self.older if k not in shown]
