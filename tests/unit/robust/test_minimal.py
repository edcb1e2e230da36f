"""Minimal solvers as RANSAC sees them: exact samples give the truth, in the half-diagonal frame."""

import numpy as np
import pytest

import rdstitch
from rdstitch.planar_motion import rigid_in_plane, rotation_from_tilt
from rdstitch.radial_homography import transfer
from rdstitch.robust.minimal import minimal_solvers
from tests.correspondences import correspondences

FOCAL = 1.4
K = np.diag([FOCAL, FOCAL, 1.0])
TILTS = np.array([[0.1, -0.05], [-0.08, 0.12]])
DISTORTION = -0.3


@pytest.mark.parametrize("known", [None, DISTORTION])
@pytest.mark.parametrize("tilts_known", [False, True])
def test_exact_samples_give_the_truth(tilts_known: bool, known: float | None) -> None:
    """Rigid motion of a camera with the same tilt where that is not known, of two tilts where they are."""
    tilts = TILTS if tilts_known else TILTS[[0, 0]] * 0.5
    level = not tilts_known
    r1, r2 = rotation_from_tilt(tilts)
    truth = K @ r2 @ rigid_in_plane(0.4, (0.3, -0.2)) @ r1.T @ np.linalg.inv(K)
    x1 = np.random.default_rng(3).uniform(-0.6, 0.6, (60, 2))
    x2 = transfer(truth, DISTORTION, x1)
    probes = np.random.default_rng(4).uniform(-0.5, 0.5, (30, 2))
    expected = transfer(truth, DISTORTION, probes)
    for solver in minimal_solvers(FOCAL, 0.1, tilts_known, known):
        if level and solver.name in ("three_point_similarity", "two_point_similarity"):
            continue  # without known tilts these take the camera to be level
        if tilts_known and solver.name == "four_point":
            continue  # for one tilt of both images
        if solver.name == "four_point_dlt" and not solver.fixed_distortion:
            continue  # near the truth only: it samples λ
        size = solver.sample_size
        count = 60 // size
        own = np.broadcast_to(tilts, (count, 2, 2)) if tilts_known else None
        samples1, samples2 = (x[: count * size].reshape(count, size, 2) for x in (x1, x2))
        found = solver.solve(samples1, samples2, own)
        hits = set()
        for sample, matrix, distortion in zip(found.sample, found.homography, found.distortion, strict=True):
            if abs(distortion - DISTORTION) < 1e-4:
                errors = [np.abs(transfer(sign * matrix, distortion, probes) - expected).max() for sign in (1, -1)]
                if np.nanmin(errors) < 1e-3:
                    hits.add(int(sample))
        assert len(hits) > 0.7 * count, (solver.name, len(hits), count)


@pytest.mark.parametrize("distortion", [-0.93, 0.45])
def test_the_whole_range_of_lenses_is_searched(distortion: float) -> None:
    r = rotation_from_tilt(np.array([0.05, -0.03]))
    truth = K @ r @ rigid_in_plane(0.3, (0.2, 0.1)) @ r.T @ np.linalg.inv(K)
    x1 = np.random.default_rng(5).uniform(-0.45, 0.45, (60, 2))
    x2 = transfer(truth, distortion, x1)
    for solver in minimal_solvers(FOCAL, 0.1, False, None):
        if solver.name in ("three_point_similarity", "four_point_dlt"):
            continue
        size = solver.sample_size
        found = solver.solve(x1.reshape(-1, size, 2), x2.reshape(-1, size, 2), None)
        assert (np.abs(found.distortion - distortion) < 1e-3).sum() > 0.3 * len(x1) / size, solver.name
        assert (found.distortion > -0.951).all()
        assert (found.distortion < 0.501).all()


def test_sampled_distortions_are_near_every_usual_lens() -> None:
    """A tenth of inliers is found, where solvers that need five points find less than half as many pairs."""
    found = 0
    for seed in range(6):
        matches = correspondences(160, seed=seed, distortion=-0.06, motion="homography", max_tilt=0.4, outliers=0.9)
        result = rdstitch.estimate_radial_homography(
            matches.points1, matches.points2, (1000, 800), quality=matches.quality, seed=seed
        )
        if result:
            off = np.linalg.norm(result.transfer(matches.points1) - matches.points2, axis=1)[matches.inliers]
            found += bool(np.median(off) < 4.0)
    assert found >= 3
