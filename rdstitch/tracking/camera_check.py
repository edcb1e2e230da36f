"""Whether keyframes agree with what is given of the camera: focal length, tilt, and the times of attitudes."""

import math
from dataclasses import replace

from rdstitch.alignment.given_checks import LATE, attitudes_late, focal_contradicted, judged_focal
from rdstitch.tracking.camera_knowledge import CameraKnowledge, CameraRevision
from rdstitch.tracking.frame_links import MATCH_ERROR
from rdstitch.tracking.keyframe_map import KeyframeMap
from rdstitch.tracking.metric_plane import MetricPlane
from rdstitch.tracking.shown_camera import SeenPairs, ShownCamera, shown_camera
from rdstitch.tracking.tracked_frame import Frame

_CHECKS = 3, 4, 6, 8, 12, 16, 32  # keyframes at which a map with a plane is looked at, and at each _INTERVAL
_INTERVAL = 24
_SURER = 0.5  # of the standard deviation of all lengths that earlier frames were given with: they come again


def check_camera(frames: KeyframeMap, latest: Frame) -> CameraRevision | None:
    """What the keyframes show of a camera whose lens and focal length are given; None where it is not looked at."""
    known, has_plane = frames.known, frames.state.has_plane
    if known.focal is None or not known.is_metric(latest.camera) or known.model not in ("auto", "rigid"):
        return None
    if has_plane and frames.seen not in _CHECKS and frames.seen % _INTERVAL:
        return None
    shown = _shown(frames, known.focal)
    revision = CameraRevision(known.focal, known.length_std, known.plane, known.delay, known.delay_std)
    if latest.attitude is not None:
        revision = replace(revision, delay=shown.delay, delay_std=shown.delay_std)
        if abs(shown.delay) > LATE * shown.delay_std:
            revision = replace(revision, messages=(attitudes_late(shown.delay, shown.delay_std),))
    if known.focal_contradicted:
        wrong = abs(shown.log_focal) > shown.log_focal_std
    else:
        length_std, wrong = judged_focal(known.stated_std, shown.log_focal, shown.log_focal_std)
        revision = replace(revision, length_std=length_std)
    if wrong:
        return _with_shown_focal(revision, known, latest.camera.scale, shown)
    if has_plane:
        if not known.focal_contradicted and abs(revision.delay - known.delay) > revision.delay_std:
            return replace(revision, longer=1.0)
        surer = not known.focal_contradicted and revision.length_std < _SURER * known.given_length_std
        return replace(revision, given_again=surer)
    pixels = known.focal * latest.camera.scale
    if max(shown.tilt_std, shown.rms) * pixels < MATCH_ERROR:
        return replace(revision, plane=MetricPlane(known.focal, shown.tilt, True, shown.tilt_std), longer=1.0)
    return revision


def _shown(frames: KeyframeMap, focal: float) -> ShownCamera:
    rays, attitudes, by_number = [], [], frames.by_number
    for link in frames.links:
        ends = by_number[link.image1].frame, by_number[link.image2].frame
        for frame, points in zip(ends, (link.points1, link.points2), strict=True):
            camera = frame.camera
            rays.append((camera.undistort(points) - camera.center) / (focal * camera.scale))
            attitudes.append(frame.attitude)
    measured = [attitude for attitude in attitudes if attitude is not None]
    tilt = None if frames.known.plane is None else frames.known.plane.tilt
    return shown_camera(SeenPairs.of(rays, measured if len(measured) == len(rays) else []), tilt)


def _with_shown_focal(
    revision: CameraRevision, known: CameraKnowledge, scale: float, shown: ShownCamera
) -> CameraRevision:
    """The focal length that the images show, instead of the one that was given."""
    focal = revision.focal * math.exp(shown.log_focal)
    contradicted = focal_contradicted(revision.focal * scale, focal * scale, shown.log_focal_std)
    return replace(
        revision,
        focal=focal,
        length_std=shown.log_focal_std,
        plane=MetricPlane(focal, shown.tilt_by_itself, True, shown.tilt_std),
        longer=math.exp(-shown.log_focal),
        messages=(*revision.messages, *(() if known.focal_contradicted else (contradicted,))),
    )
