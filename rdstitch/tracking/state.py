"""What a tracker is doing on a map, and what leads from one state to the next."""

from dataclasses import dataclass, replace
from typing import Self

_MAX_LOST_FRAMES = 10  # frames in a row without a place, after which a new map begins, if all keyframes were searched


@dataclass(frozen=True)
class TrackState:
    """The state of the track: ::

    a first keyframe --> initialising --with_plane--> tracking --unplaced--> lost --placed--> tracking
                                ^                                              |
                                +-----------------next_map---------------------+
    """

    map_number: int = 0
    has_plane: bool = False  # whether keyframes of the map lie on a plane
    lost_frames: int = 0  # the last ones, which no keyframe shows

    @property
    def initialising(self) -> bool:
        """Whether there are too few keyframes for a plane: frames wait for their place."""
        return not self.has_plane

    @property
    def lost(self) -> bool:
        """Whether no keyframe shows the latest frame."""
        return self.lost_frames > 0

    def with_plane(self) -> Self:
        """When keyframes have their places on the plane of the map."""
        return replace(self, has_plane=True)

    def placed(self) -> Self:
        """After a frame that keyframes show, or that is the next keyframe."""
        return replace(self, lost_frames=0)

    def unplaced(self) -> Self:
        """After a frame that no keyframe shows."""
        return replace(self, lost_frames=self.lost_frames + 1)

    def next_map(self, keyframes: int, *, all_searched: bool) -> "TrackState | None":
        """At the beginning of another map, if it is time for one; a first keyframe that no frame shows is replaced."""
        if self.initialising and keyframes == 1:
            return TrackState(self.map_number)
        return TrackState(self.map_number + 1) if self.lost_frames >= _MAX_LOST_FRAMES and all_searched else None

    def why_waiting(self, keyframes: int, *, is_keyframe: bool) -> str:
        """Why a frame that some of so many keyframes show has no place on the plane of the map yet."""
        if not self.initialising:
            return "it is not linked with the map yet"
        moved = keyframes > 1 or is_keyframe
        return "the first keyframes are being aligned" if moved else "the camera has not moved far enough yet"
