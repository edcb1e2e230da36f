"""States of a frame that is tracked, and the words by which users read why it has no place."""

from enum import Enum


class TrackingState(Enum):
    """The state of one frame; its value is the reason why the frame has no place."""

    TRACKED = ""
    UNREAD = "it could not be read"
    FIRST = "first frame"
    NEW_MAP = "no keyframe shows what it shows: it begins a new map"
    NOT_MOVED = "the camera has not moved far enough yet"
    INITIALISING = "the first keyframes are being aligned"
    NOT_LINKED = "it is not linked with the map yet"
    NO_TEXTURE = "no floor texture"
    LOST = "no keyframe shows what it shows"
    NOT_FINITE = "its place is not finite"
    NO_METRIC_POSE = "the model has no metric poses"
