"""Check of what is given of the camera by keyframes: its focal length, its tilt, and the times of attitudes."""

import math
from dataclasses import dataclass, replace

from rdstitch.alignment.given_checks import LATE, judged_focal
from rdstitch.alignment.sentences import attitudes_late, focal_contradicted
from rdstitch.results.messages import Message
from rdstitch.tracking.camera_from_motion import CameraEstimate, SeenPairs, camera_from_motion
from rdstitch.tracking.camera_knowledge import CameraKnowledge, Estimate, FocalLength, FocalOrigin
from rdstitch.tracking.frame_links import MATCH_ERROR
from rdstitch.tracking.keyframe_map import KeyframeMap
from rdstitch.tracking.metric_plane import MetricPlane
from rdstitch.tracking.tracked_frame import IncomingFrame

_CHECKS = 3, 4, 6, 8, 12, 16, 32  # keyframes after the first at which a map with a plane is checked
_INTERVAL = 24  # keyframes: at multiples of it as well
_SURER = 0.5  # of the standard deviation of all lengths that earlier frames were given with: they come again


@dataclass(frozen=True)
class CameraCheck:
    """Judgement on a camera whose lens and focal length are given, by the keyframes of a map."""

    knowledge: CameraKnowledge  # with what they show
    messages: list[Message]
    length_factor: float | None = None  # by which lengths change, as keyframes are placed anew; None: they stay
    focal_replaced: bool = False  # whether motions contradict the focal length, and with it alignments under way
    surer: bool = False  # whether lengths are far surer than earlier frames were given with

    @property
    def revises(self) -> bool:
        """Whether earlier frames have other places, or surer ones, and come again."""
        return self.length_factor is not None or self.surer


def check_given_camera(keyframe_map: KeyframeMap, latest: IncomingFrame) -> CameraCheck | None:
    """Check a given camera by the keyframes; None where nothing was given, or it is not time for that."""
    knowledge, has_plane, added = keyframe_map.knowledge, keyframe_map.has_plane, keyframe_map.added
    focal, model = knowledge.focal, knowledge.one_tilt_model
    if focal is None or not knowledge.is_metric(latest.camera) or model is None or not model.keeps_height:
        return None
    if not keyframe_map.links or (has_plane and added not in _CHECKS and added % _INTERVAL):
        return None
    return judge_camera(knowledge, latest, _estimate(keyframe_map, focal.value), has_plane=has_plane)


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


def judge_camera(
    knowledge: CameraKnowledge, latest: IncomingFrame, estimate: CameraEstimate, *, has_plane: bool
) -> CameraCheck:
    """Judge what is known of a given camera, with the latest frame's, by an estimate from motions."""
    before, delay, scale, messages = knowledge.focal, knowledge.delay, latest.camera.scale, list[Message]()
    assert before is not None
    if latest.attitude is not None:
        delay = Estimate(estimate.delay, estimate.delay_std)
        if abs(delay.value) > LATE * delay.std:
            messages.append(attitudes_late(*delay))
    moved = abs(delay.value - knowledge.delay.value) > delay.std
    focal = _judged_focal(before, latest.camera.focal_log_std, estimate)
    knowledge = replace(knowledge, delay=delay, focal=focal)
    if focal.value != before.value:
        if before.origin is FocalOrigin.GIVEN:
            messages.append(focal_contradicted(before.value * scale, focal.value * scale, estimate.log_focal_std))
        plane = MetricPlane(focal.value, estimate.tilt_free_focal, True, estimate.tilt_std)
        length_factor = math.exp(-estimate.log_focal)
        return CameraCheck(replace(knowledge, plane=plane), messages, length_factor, focal_replaced=True)
    if not has_plane:
        if not max(estimate.tilt_std, estimate.rms) * focal.value * scale < MATCH_ERROR:
            return CameraCheck(knowledge, messages)
        plane = MetricPlane(focal.value, estimate.tilt_given_focal, True, estimate.tilt_std)
        return CameraCheck(replace(knowledge, plane=plane), messages, 1.0)
    if focal.origin is FocalOrigin.MOTION:
        return CameraCheck(knowledge, messages)
    if moved:
        return CameraCheck(knowledge, messages, 1.0)
    std, reported = focal.log_std, focal.reported_std
    if std is None or reported is None or not std < _SURER * reported:
        return CameraCheck(knowledge, messages)
    return CameraCheck(replace(knowledge, focal=replace(focal, reported_std=std)), messages, surer=True)


def _judged_focal(focal: FocalLength, stated_std: float, estimate: CameraEstimate) -> FocalLength:
    """The focal length, surer by what motions show; or the one that they show, where they contradict it."""
    log_std, contradicted = focal.log_std, abs(estimate.log_focal) > estimate.log_focal_std
    if focal.origin is FocalOrigin.GIVEN:
        log_std, contradicted = judged_focal(stated_std, estimate.log_focal, estimate.log_focal_std)
    if contradicted:
        return FocalLength(focal.value * math.exp(estimate.log_focal), estimate.log_focal_std, FocalOrigin.MOTION)
    return replace(focal, log_std=log_std)
