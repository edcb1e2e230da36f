"""Pairs with many wrong matches, at the rates and noise that users meet: recall, λ, and the same bytes again."""

import numpy as np
import pytest

import rdstitch
from tests.correspondences import SyntheticMatches, correspondences

PAIRS = 20


def _estimate(matches: SyntheticMatches, *, tilt: bool, seed: int = 0) -> rdstitch.RadialHomography:
    motion = matches.truth.motion
    return rdstitch.estimate_radial_homography(
        matches.points1,
        matches.points2,
        matches.truth.camera.image_size,
        focal=matches.truth.camera.focal,
        tilt=motion.tilt if tilt else None,
        seed=seed,
    )


@pytest.mark.parametrize(("outliers", "tilt"), [(0.3, False), (0.5, False), (0.8, False), (0.9, True)])
def test_recall_and_distortion(outliers: float, tilt: bool) -> None:
    recall, error = [], []
    for seed in range(PAIRS):
        matches = correspondences(400, seed=seed, outliers=outliers)
        found = _estimate(matches, tilt=tilt)
        recall.append((found.inliers & matches.inliers).sum() / matches.inliers.sum())
        error.append(abs(found.distortion - matches.truth.distortion))
    assert np.median(recall) > 0.97
    assert np.median(error) < 0.012


@pytest.mark.parametrize("motion", ["similarity", "homography"])
def test_freer_motions_without_a_focal_length(motion: str) -> None:
    recall, error = [], []
    for seed in range(PAIRS // 2):
        matches = correspondences(400, seed=seed, outliers=0.5, motion=motion)
        found = rdstitch.estimate_radial_homography(matches.points1, matches.points2, matches.truth.camera.image_size)
        recall.append((found.inliers & matches.inliers).sum() / matches.inliers.sum())
        error.append(abs(found.distortion - matches.truth.distortion))
    assert np.median(recall) > 0.97
    assert np.median(error) < 0.012


def test_a_seed_fixes_every_bit() -> None:
    matches = correspondences(400, seed=3, outliers=0.8)
    first, again = (_estimate(matches, tilt=False, seed=5) for _ in range(2))
    assert first.homography.tobytes() == again.homography.tobytes()
    assert first.inliers.tobytes() == again.inliers.tobytes()
    assert (first.distortion, first.distortion_std) == (again.distortion, again.distortion_std)


def test_matches_without_any_truth_are_refused() -> None:
    rng = np.random.default_rng(0)
    for count in (8, 30, 400):
        points1, points2 = rng.uniform((0, 0), (999, 799), (2, count, 2))
        found = rdstitch.estimate_radial_homography(points1, points2, (1000, 800))
        assert not found
        assert found.reason
