"""Whether keyframes agree with what is given of the camera: focal length, tilt, and the times of attitudes."""

import math
from collections.abc import Callable
from dataclasses import dataclass

from rdstitch.alignment.given_checks import LATE, attitudes_late, focal_contradicted
from rdstitch.results.messages import Message
from rdstitch.tracking.camera_knowledge import CameraKnowledge
from rdstitch.tracking.frame_links import MATCH_ERROR
from rdstitch.tracking.keyframe_map import KeyframeMap
from rdstitch.tracking.metric_plane import MetricPlane
from rdstitch.tracking.shown_camera import SeenPairs, ShownCamera, judged_focal, shown_camera
from rdstitch.tracking.tracked_frame import TrackedFrame

_CHECKS = 3, 4, 6, 8, 12, 16, 32  # keyframes at which a map with a plane is looked at, and at each _INTERVAL
_INTERVAL = 24
_CONTRADICTED = 0.999  # probability that a given focal length is wrong
_SURER = 0.5  # of the standard deviation of all lengths that earlier frames were given with: they come again


@dataclass(frozen=True)
class Revision:
    """What a check changes for the frames that came before."""

    longer: float | None = None  # all keyframes are placed anew, with lengths so many times as long; None: none are
    new_focal: bool = False


def check_camera(frames: KeyframeMap, latest: TrackedFrame, tell: Callable[[Message], None]) -> Revision | None:
    """Learn what the keyframes show of a camera whose lens and focal length are given."""
    known, has_plane = frames.known, frames.state.has_plane
    if known.focal is None or not known.is_metric(latest.camera) or known.model not in ("auto", "rigid"):
        return None
    if has_plane and frames.seen not in _CHECKS and frames.seen % _INTERVAL:
        return None
    shown, before = _shown(frames, known.focal), known.delay
    if latest.attitude is not None:
        known.delay, known.delay_std = shown.delay, shown.delay_std
        if abs(shown.delay) > LATE * shown.delay_std:
            tell(attitudes_late(shown.delay, shown.delay_std))
    if known.focal_contradicted:
        wrong = abs(shown.log_focal) > shown.log_focal_std
    else:
        known.length_std, probability = judged_focal(known.stated_std, shown.log_focal, shown.log_focal_std)
        wrong = probability > _CONTRADICTED
    if wrong:
        return _with_shown_focal(known, latest.camera.scale, shown, tell)
    if has_plane and not known.focal_contradicted:
        if abs(known.delay - before) > known.delay_std:
            return Revision(1.0)
        if known.length_std < _SURER * known.given_length_std:
            known.given_length_std = known.length_std
            return Revision()
    pixels = known.focal * latest.camera.scale
    if has_plane or not max(shown.tilt_std, shown.rms) * pixels < MATCH_ERROR:
        return None
    known.plane = MetricPlane(known.focal, shown.tilt, True, shown.tilt_std)
    return Revision(1.0)


def _shown(frames: KeyframeMap, focal: float) -> ShownCamera:
    rays, attitudes, by_number = [], [], frames.by_number
    for link in frames.links:
        ends = by_number[link.image1], by_number[link.image2]
        for frame, points in zip(ends, (link.points1, link.points2), strict=True):
            rays.append((frame.camera.undistort(points) - frame.camera.center) / (focal * frame.camera.scale))
            attitudes.append(frame.attitude)
    measured = [attitude for attitude in attitudes if attitude is not None]
    tilt = None if frames.known.plane is None else frames.known.plane.tilt
    return shown_camera(SeenPairs.of(rays, measured if len(measured) == len(rays) else []), tilt)


def _with_shown_focal(
    known: CameraKnowledge, scale: float, shown: ShownCamera, tell: Callable[[Message], None]
) -> Revision:
    """The focal length that the images show, instead of the one that was given."""
    assert known.focal is not None
    found = known.focal * math.exp(shown.log_focal)
    if not known.focal_contradicted:
        tell(focal_contradicted(known.focal * scale, found * scale, shown.log_focal_std))
    known.focal, known.focal_contradicted, known.length_std = found, True, shown.log_focal_std
    known.plane = MetricPlane(found, shown.tilt_by_itself, True, shown.tilt_std)
    return Revision(math.exp(-shown.log_focal), new_focal=True)
