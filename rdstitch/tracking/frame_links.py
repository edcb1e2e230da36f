"""A frame registered with keyframes: by corners where its place is about known, else by features."""

from collections.abc import Sequence
from functools import partial
from typing import Any

import cv2
import numpy as np

from rdstitch.arrays import BoolArray, FloatArray
from rdstitch.features import Matcher
from rdstitch.features.corner_flow import matched_corners
from rdstitch.geometry.camera import Camera
from rdstitch.geometry.radial_homography import RadialHomography
from rdstitch.matching.links import Link
from rdstitch.robust import PairMatches, estimate_radial_homographies
from rdstitch.tracking.camera_knowledge import CameraKnowledge
from rdstitch.tracking.tracked_frame import MIN_INLIERS, IncomingFrame, TrackedFrame

MATCH_ERROR = 1.5  # pixels by which a corner may be off the motion of the plane; 1: NEES 0.83; 2.5: 1.02
_AGREEING = 0.5  # fraction of the corners that must agree on it; 0.3: the same; 0.7: the slowest take 1.8 times as long
_WRONG = 0.05  # fraction of the matches that agree by chance

# A keyframe, its points (N, 2), those of the frame, and their quality (N,).
Matched = tuple[TrackedFrame, FloatArray, FloatArray, FloatArray | None]


def agree(inliers: BoolArray) -> bool:
    """Whether so many of the corners (N,) agree that they show where a frame lies."""
    return bool(inliers.sum() >= max(MIN_INLIERS, _AGREEING * len(inliers)))


def fitted_homography(
    camera: Camera, camera2: Camera, points: FloatArray, points2: FloatArray, error: float
) -> tuple[FloatArray | None, BoolArray]:
    """Homography (3, 3) from undistorted normalized points of a second image to those of a first, and inliers (N,)."""
    inliers = np.zeros(len(points), dtype=np.bool_)
    target, source = camera.undistort(points), camera2.undistort(points2)
    seen = np.flatnonzero(np.isfinite(source).all(axis=1) & np.isfinite(target).all(axis=1))
    if len(seen) < MIN_INLIERS:
        return None, inliers
    # Without the lens, where all numbers are of the size of an image: OpenCV computes in single precision.
    source, target = camera2.normalize(source[seen]), camera.normalize(target[seen])
    fit: Any = cv2.findHomography(source, target, cv2.RANSAC, error / camera.scale)
    homography, agreeing = fit
    if homography is None or not np.linalg.det(homography) > 0.0:
        return None, inliers
    inliers[seen[agreeing[:, 0] > 0]] = True
    return np.asarray(homography, dtype=np.float64), inliers


def links_by_corners(placed: TrackedFrame, others: Sequence[TrackedFrame], knowledge: CameraKnowledge) -> list[Link]:
    """Links of keyframes with a frame whose place is about known."""
    frame = placed.frame
    matched: list[Matched] = [
        (other, *matched_corners(other.frame.image, frame.image, frame.corners, partial(placed.points_in, other)), None)
        for other in others
    ]
    return _registered(frame, matched, knowledge)


def links_by_features(
    frame: IncomingFrame, others: Sequence[TrackedFrame], match: Matcher, knowledge: CameraKnowledge
) -> list[Link]:
    """Links of keyframes with a frame whose place is not known."""
    matched = [(other, match(other.frame.features, frame.features)) for other in others]
    return _registered(frame, [(other, m.points1, m.points2, -m.ratio) for other, m in matched], knowledge)


def _registered(frame: IncomingFrame, matched: Sequence[Matched], knowledge: CameraKnowledge) -> list[Link]:
    if not knowledge.distortion_known:
        pairs = [
            PairMatches(points1, points2, other.frame.camera, frame.camera, quality)
            for other, points1, points2, quality in matched
        ]
        return [
            Link(other.number, frame.number, points1[fit.inliers], points2[fit.inliers], fit)
            for (other, points1, points2, _), fit in zip(
                matched, estimate_radial_homographies(pairs, knowledge.pair), strict=True
            )
            if fit and fit.inliers.sum() >= MIN_INLIERS
        ]
    links = []  # where the lens is known, a homography of undistorted points
    for other, points1, points2, _ in matched:
        camera, camera2 = (knowledge.camera_with_lens_of(other.placement, one) for one in (other.frame, frame))
        homography, inliers = fitted_homography(camera2, camera, points2, points1, MATCH_ERROR)
        # A few wrong matches do not make a link: a homography takes four of any.
        if homography is None or inliers.sum() < MIN_INLIERS + _WRONG * len(points1):
            continue
        cameras = camera.with_guessed_focal(), camera2.with_guessed_focal()
        relation = RadialHomography(homography, *cameras, inliers, distortion_std=0.0, model="homography")
        links.append(Link(other.number, frame.number, points1[inliers], points2[inliers], relation))
    return links
