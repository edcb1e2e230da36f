"""The links of a frame with the keyframes of a map, wherever on it the frame lies."""

from rdstitch.features import Matcher
from rdstitch.matching.links import Link
from rdstitch.tracking.frame_links import links_by_corners, links_by_features
from rdstitch.tracking.keyframe_map import KeyframeMap
from rdstitch.tracking.tracked_frame import Frame, PlacedFrame


def links_with_map(frame: Frame, placed: PlacedFrame | None, frames: KeyframeMap, match: Matcher) -> list[Link]:
    """The frame with the last keyframes, as far as they can be registered; of a lost one, with more of them."""
    if placed is not None and (links := links_by_corners(placed, frames.partners, frames.known)):
        return links
    further = frames.to_search()
    for others in (frames.partners, further):
        if links := links_by_features(frame, others, match, frames.known):
            numbers = {link.image1 for link in links}
            shown = [keyframe for keyframe in others if keyframe.number in numbers]
            about = frames.place_by_links(frame, links)
            frames.found_again(shown)
            exact = [] if about is None else links_by_corners(PlacedFrame(frame, about), shown, frames.known)
            return exact or links
    return []
