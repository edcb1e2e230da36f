"""What two-view estimation decides by: when it stops, which model it takes, what it takes for chance."""

import numpy as np
import pytest

import rdstitch
from rdstitch.robust import SolverName
from tests.correspondences import correspondences


@pytest.mark.parametrize(("solver", "size"), [("three_point", 3), ("four_point", 4), ("five_point", 5)])
def test_sampling_goes_on_until_a_sample_without_outliers_is_likely(solver: SolverName, size: int) -> None:
    """Fischler and Bolles: a share w of inliers needs log(1 - confidence) / log(1 - w^size) samples."""
    matches = correspondences(300, seed=1, outliers=0.6)
    found = rdstitch.estimate_radial_homography(
        matches.points1,
        matches.points2,
        matches.truth.camera.image_size,
        focal=matches.truth.camera.focal,
        solver=solver,
    )
    assert found
    # Without the exponent, less than a hundred.
    enough = np.log(1e-3) / np.log1p(-(found.inliers.mean() ** size))
    assert enough < found.iterations < 8 * enough
    assert "stopped at its limit" not in found.reason


def test_more_confidence_takes_more_samples() -> None:
    matches = correspondences(300, seed=1, outliers=0.6)
    drawn = [
        rdstitch.estimate_radial_homography(
            matches.points1,
            matches.points2,
            matches.truth.camera.image_size,
            solver="five_point",
            confidence=confidence,
        ).iterations
        for confidence in (0.9, 0.999999)
    ]
    assert drawn[1] > 2 * drawn[0]


def test_the_least_free_model_is_chosen() -> None:
    """A freer one always fits a little better; without a price for freedom it would nearly always be chosen."""
    chosen = []
    for seed in range(12):
        for motion in ("rigid", "similarity", "homography"):
            matches = correspondences(200, seed=seed, outliers=0.2, motion=motion)
            camera = matches.truth.camera
            found = rdstitch.estimate_radial_homography(
                matches.points1, matches.points2, camera.image_size, focal=camera.focal
            )
            chosen.append(found.model == motion)
    assert np.mean(chosen) > 0.9
