"""Whether keyframes agree with what is given of the camera: focal length, tilt, and the times of attitudes."""

import math
from dataclasses import replace

from rdstitch.alignment.given_checks import LATE, judged_focal
from rdstitch.alignment.sentences import attitudes_late, focal_contradicted
from rdstitch.tracking.camera_from_motion import CameraEstimate, SeenPairs, camera_from_motion
from rdstitch.tracking.camera_knowledge import CameraKnowledge, CameraRevision
from rdstitch.tracking.frame_links import MATCH_ERROR
from rdstitch.tracking.keyframe_map import KeyframeMap
from rdstitch.tracking.metric_plane import MetricPlane
from rdstitch.tracking.tracked_frame import Frame

_CHECKS = 3, 4, 6, 8, 12, 16, 32  # keyframes at which a map with a plane is looked at, and at each _INTERVAL
_INTERVAL = 24
_SURER = 0.5  # of the standard deviation of all lengths that earlier frames were given with: they come again


def check_camera(keyframe_map: KeyframeMap, latest: Frame) -> CameraRevision | None:
    """What the keyframes show of a camera whose lens and focal length are given; None where it is not looked at."""
    knowledge, has_plane = keyframe_map.knowledge, keyframe_map.state.has_plane
    if knowledge.focal is None or not knowledge.is_metric(latest.camera) or knowledge.model not in ("auto", "rigid"):
        return None
    if not keyframe_map.links or (has_plane and keyframe_map.seen not in _CHECKS and keyframe_map.seen % _INTERVAL):
        return None
    estimate = _estimate(keyframe_map, knowledge.focal)
    revision = CameraRevision(
        knowledge.focal, knowledge.length_std, knowledge.plane, knowledge.delay, knowledge.delay_std
    )
    if latest.attitude is not None:
        revision = replace(revision, delay=estimate.delay, delay_std=estimate.delay_std)
        if abs(estimate.delay) > LATE * estimate.delay_std:
            revision = replace(revision, messages=(attitudes_late(estimate.delay, estimate.delay_std),))
    if knowledge.focal_contradicted:
        wrong = abs(estimate.log_focal) > estimate.log_focal_std
    else:
        length_std, wrong = judged_focal(knowledge.stated_std, estimate.log_focal, estimate.log_focal_std)
        revision = replace(revision, length_std=length_std)
    if wrong:
        return _with_estimated_focal(revision, knowledge, latest.camera.scale, estimate)
    if has_plane:
        if not knowledge.focal_contradicted and abs(revision.delay - knowledge.delay) > revision.delay_std:
            return replace(revision, length_factor=1.0)
        surer = not knowledge.focal_contradicted and revision.length_std < _SURER * knowledge.given_length_std
        return replace(revision, report_again=surer)
    pixels = knowledge.focal * latest.camera.scale
    if max(estimate.tilt_std, estimate.rms) * pixels < MATCH_ERROR:
        return replace(
            revision, plane=MetricPlane(knowledge.focal, estimate.tilt, True, estimate.tilt_std), length_factor=1.0
        )
    return revision


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


def _with_estimated_focal(
    revision: CameraRevision, knowledge: CameraKnowledge, scale: float, estimate: CameraEstimate
) -> CameraRevision:
    """The focal length that the images show, instead of the one that was given."""
    focal = revision.focal * math.exp(estimate.log_focal)
    contradicted = focal_contradicted(revision.focal * scale, focal * scale, estimate.log_focal_std)
    return replace(
        revision,
        focal=focal,
        length_std=estimate.log_focal_std,
        plane=MetricPlane(focal, estimate.tilt_by_itself, True, estimate.tilt_std),
        length_factor=math.exp(-estimate.log_focal),
        messages=(*revision.messages, *(() if knowledge.focal_contradicted else (contradicted,))),
    )
