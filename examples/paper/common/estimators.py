"""Robust estimators of a homography from matches, ours and the peers', with one calling convention."""

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from examples.paper.common.contenders import optional_module
from examples.paper.common.estimation_pairs import JudgedPair
from rdstitch.arrays import FloatArray
from rdstitch.geometry.camera import Camera
from rdstitch.geometry.radial_homography import RadialHomography, transfer
from rdstitch.robust import SolverName, estimate_radial_homography

THRESHOLD = 3.0
"""Largest error of an inlier, px, for all."""

CONFIDENCE, ITERATIONS = 0.999, 10_000

_LOMSAC = {
    "homlib LOMSAC, Fitzgibbon": "lomsac_fitzgibbon_cvpr_2001_two_sided_equal",
    "homlib LOMSAC, Kukelova": "lomsac_kukelova_cvpr_2015_two_sided_equal",
    "homlib LOMSAC, Wadenbäck": "lomsac_wadenback_3dv_2026_two_sided_equal",
}


@dataclass(frozen=True)
class Estimate:
    """Homography (3, 3) between undistorted half diagonals and λ; None where the estimator gave up."""

    homography: FloatArray | None
    distortion: float = 0.0


@dataclass(frozen=True)
class Estimator:
    """A way to estimate.

    ``run``: takes matches, px (N, 2), and the size of the images.
    """

    name: str
    run: Callable[[FloatArray, FloatArray, tuple[int, int]], Estimate]


@dataclass(frozen=True)
class Judgement:
    """What became of one pair."""

    error: float  # mean distance from the truth over what both images show, px of image 2; inf without an estimate
    distortion_error: float
    seconds: float  # of processor time


def installed_estimators() -> tuple[list[Estimator], tuple[str, ...]]:
    """All estimators whose libraries are here, and a note for each library that is not."""
    found = [Estimator("rdstitch", _own("auto")), Estimator("rdstitch, five points", _own("five_point"))]
    notes = []
    homlib, poselib, cv2 = (optional_module(name) for name in ("homlib", "poselib", "cv2"))
    if homlib is None:
        notes.append("homlib is not installed and was left out")
    else:
        found += lomsac_estimators()
    if poselib is None:
        notes.append("poselib is not installed and was left out")
    else:
        found.append(Estimator("poselib, no λ", _poselib(poselib)))
    if cv2 is not None:
        found.append(Estimator("OpenCV USAC_MAGSAC, no λ", _magsac(cv2)))
    return found, tuple(notes)


def lomsac_estimators() -> list[Estimator]:
    """Those of homlib; none where it is not installed."""
    homlib = optional_module("homlib")
    return [Estimator(name, _lomsac(homlib, function)) for name, function in _LOMSAC.items() if homlib]


def judge(estimator: Estimator, pair: JudgedPair) -> Judgement:
    """Run an estimator on a pair and compare with the truth."""
    begun = time.process_time()
    found = estimator.run(pair.points1, pair.points2, pair.image_size)
    seconds = time.process_time() - begun
    if found.homography is None:
        return Judgement(np.inf, np.inf, seconds)
    camera = Camera(pair.image_size)
    h = found.homography * np.sign(np.linalg.det(found.homography))
    moved = camera.denormalize(transfer(h, found.distortion, camera.normalize(pair.grid1)))
    error = np.linalg.norm(moved - pair.grid2, axis=1)
    mean = float(np.where(np.isfinite(error), error, np.inf).mean())
    return Judgement(mean, abs(found.distortion - pair.distortion), seconds)


def _own(solver: SolverName) -> Callable[[FloatArray, FloatArray, tuple[int, int]], Estimate]:
    def run(points1: FloatArray, points2: FloatArray, size: tuple[int, int]) -> Estimate:
        found: RadialHomography = estimate_radial_homography(
            points1, points2, size, solver=solver, threshold=THRESHOLD, confidence=CONFIDENCE, max_iterations=ITERATIONS
        )
        return Estimate(found.homography, found.distortion) if found else Estimate(None)

    return run


def _lomsac(homlib: Any, function: str) -> Callable[[FloatArray, FloatArray, tuple[int, int]], Estimate]:
    def run(points1: FloatArray, points2: FloatArray, size: tuple[int, int]) -> Estimate:
        camera = Camera(size)
        options = homlib.LORansacOptions()
        options.squared_inlier_threshold = (THRESHOLD / camera.scale) ** 2
        options.success_probability = CONFIDENCE
        options.max_num_iterations = ITERATIONS
        options.final_least_squares = True
        x1, x2 = (np.asfortranarray(camera.normalize(points).T) for points in (points1, points2))
        pose, _ = getattr(homlib, function)(x1, x2, options)
        return _checked(np.asarray(pose.homography), float(pose.distortion_parameter))

    return run


def _poselib(poselib: Any) -> Callable[[FloatArray, FloatArray, tuple[int, int]], Estimate]:
    options = {"max_reproj_error": THRESHOLD, "success_prob": CONFIDENCE, "max_iterations": ITERATIONS}

    def run(points1: FloatArray, points2: FloatArray, size: tuple[int, int]) -> Estimate:
        homography, _ = poselib.estimate_homography(points1, points2, options)
        return _checked(_normalized(homography, Camera(size)), 0.0)

    return run


def _magsac(cv2: Any) -> Callable[[FloatArray, FloatArray, tuple[int, int]], Estimate]:
    def run(points1: FloatArray, points2: FloatArray, size: tuple[int, int]) -> Estimate:
        homography, _ = cv2.findHomography(
            points1, points2, cv2.USAC_MAGSAC, THRESHOLD, maxIters=ITERATIONS, confidence=CONFIDENCE
        )
        return Estimate(None) if homography is None else _checked(_normalized(homography, Camera(size)), 0.0)

    return run


def _normalized(homography: FloatArray, camera: Camera) -> FloatArray:
    """From px to half diagonals."""
    (cx, cy), s = camera.center, camera.scale
    to_pixels = np.array([[s, 0.0, cx], [0.0, s, cy], [0.0, 0.0, 1.0]])
    normalized: FloatArray = np.linalg.inv(to_pixels) @ homography @ to_pixels
    return normalized


def _checked(homography: FloatArray, distortion: float) -> Estimate:
    possible = np.isfinite(homography).all() and np.isfinite(distortion) and np.linalg.det(homography) != 0.0
    return Estimate(homography, distortion) if possible else Estimate(None)
