"""The links of a frame with the keyframes of a map, wherever on it the frame lies."""

from rdstitch.features import Matcher
from rdstitch.matching.links import Link
from rdstitch.tracking.frame_links import links_by_corners, links_by_features
from rdstitch.tracking.keyframe_map import KeyframeMap
from rdstitch.tracking.tracked_frame import Frame, TrackedFrame


def links_with_map(frame: Frame, placed: TrackedFrame | None, keyframe_map: KeyframeMap, match: Matcher) -> list[Link]:
    """The frame with the last keyframes, as far as they can be registered; of a lost one, with more of them."""
    if placed is not None and (links := links_by_corners(placed, keyframe_map.partners, keyframe_map.knowledge)):
        return links
    further = keyframe_map.to_search()
    for others in (keyframe_map.partners, further):
        if links := links_by_features(frame, others, match, keyframe_map.knowledge):
            if (about := keyframe_map.place_by_links(frame, links)) is None:
                return links
            numbers = {link.image1 for link in links}
            shown = [keyframe for keyframe in others if keyframe.number in numbers]
            keyframe_map.found_again(shown)
            return links_by_corners(TrackedFrame(frame, about), shown, keyframe_map.knowledge) or links
    return []
