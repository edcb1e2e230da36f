"""Whether keyframes agree with what is given of the camera: focal length, tilt, and the times of attitudes."""

import math
from collections.abc import Callable

from rdstitch.alignment.given_checks import LATE, judged_focal
from rdstitch.alignment.sentences import attitudes_late, focal_contradicted
from rdstitch.results.messages import Message
from rdstitch.tracking.camera_from_motion import CameraEstimate, SeenPairs, camera_from_motion
from rdstitch.tracking.frame_links import MATCH_ERROR
from rdstitch.tracking.keyframe_map import KeyframeMap
from rdstitch.tracking.metric_plane import MetricPlane
from rdstitch.tracking.tracked_frame import Frame

_CHECKS = 3, 4, 6, 8, 12, 16, 32  # keyframes after the first at which a map with a plane is checked, and each _INTERVAL
_INTERVAL = 24
_SURER = 0.5  # of the standard deviation of all lengths that earlier frames were given with: they come again


def check_given_camera(keyframe_map: KeyframeMap, latest: Frame, report: Callable[[Message], None]) -> bool:
    """Adopt what the keyframes show of a camera whose lens and focal length are given, where it is time to check it.

    True where earlier frames have other places by it, or lengths that are far surer: they come again.
    """
    knowledge, has_plane = keyframe_map.knowledge, keyframe_map.has_plane
    if knowledge.focal is None or not knowledge.is_metric(latest.camera) or knowledge.model not in ("auto", "rigid"):
        return False
    if not keyframe_map.links or (has_plane and keyframe_map.added not in _CHECKS and keyframe_map.added % _INTERVAL):
        return False
    estimate, delay = _estimate(keyframe_map, knowledge.focal), knowledge.delay
    if latest.attitude is not None:
        knowledge.delay, knowledge.delay_std = estimate.delay, estimate.delay_std
        if abs(estimate.delay) > LATE * estimate.delay_std:
            report(attitudes_late(estimate.delay, estimate.delay_std))
    if knowledge.focal_contradicted:
        wrong = abs(estimate.log_focal) > estimate.log_focal_std
    else:
        knowledge.length_std, wrong = judged_focal(knowledge.stated_std, estimate.log_focal, estimate.log_focal_std)
    scale = latest.camera.scale
    if wrong:  # the focal length that the images show, instead of the one that was given
        focal = knowledge.focal * math.exp(estimate.log_focal)
        if not knowledge.focal_contradicted:
            report(focal_contradicted(knowledge.focal * scale, focal * scale, estimate.log_focal_std))
        knowledge.focal, knowledge.length_std, knowledge.focal_contradicted = focal, estimate.log_focal_std, True
        knowledge.plane = MetricPlane(focal, estimate.tilt_by_itself, True, estimate.tilt_std)
        keyframe_map.rescale(math.exp(-estimate.log_focal))
        return True
    if not has_plane:
        shown = max(estimate.tilt_std, estimate.rms) * knowledge.focal * scale < MATCH_ERROR
        if shown:
            knowledge.plane = MetricPlane(knowledge.focal, estimate.tilt, True, estimate.tilt_std)
            keyframe_map.rescale(1.0)
        return shown
    if knowledge.focal_contradicted:
        return False
    if abs(knowledge.delay - delay) > knowledge.delay_std:
        keyframe_map.rescale(1.0)
        return True
    surer = knowledge.length_std < _SURER * knowledge.given_length_std
    if surer:
        knowledge.given_length_std = knowledge.length_std
    return surer


def _estimate(keyframe_map: KeyframeMap, focal: float) -> CameraEstimate:
    rays, attitudes, by_number = [], [], keyframe_map.by_number
    for link in keyframe_map.links:
        ends = by_number[link.image1].frame, by_number[link.image2].frame
        for frame, points in zip(ends, (link.points1, link.points2), strict=True):
            camera = frame.camera
            rays.append((camera.undistort(points) - camera.center) / (focal * camera.scale))
            attitudes.append(frame.attitude)
    measured = [attitude for attitude in attitudes if attitude is not None]
    tilt = None if keyframe_map.knowledge.plane is None else keyframe_map.knowledge.plane.tilt
    return camera_from_motion(SeenPairs.of(rays, measured if len(measured) == len(rays) else []), tilt)
