"""Minimal samples: which solver, in what order, and what its solutions are kept by."""

import math
from dataclasses import replace

import numpy as np
import pytest

import rdstitch
from examples.worlds.correspondences import correspondences
from rdstitch.arrays import FloatArray, IntArray
from rdstitch.geometry.camera import Camera
from rdstitch.geometry.planar_motion import rigid_in_plane, rotation_from_tilt
from rdstitch.geometry.radial_homography import transfer
from rdstitch.robust import SolverName, estimate_radial_homography
from rdstitch.robust.measurements import Measurements
from rdstitch.robust.minimal import minimal_solvers
from rdstitch.robust.per_image_distortion import PerImageDistortion, estimate_per_image_distortion
from rdstitch.robust.priors import focal_prior
from rdstitch.robust.sampling import Sampler

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
    for solver in minimal_solvers(FOCAL, focal_prior(math.log(FOCAL), 0.1, "guess"), tilts_known, known):
        if solver.name.startswith("rotation"):
            continue  # for cameras that only turn
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
    for solver in minimal_solvers(FOCAL, focal_prior(math.log(FOCAL), 0.1, "guess"), False, None):
        if solver.name in ("three_point_similarity", "four_point_dlt", "rotation_two_point"):
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


def _draw(sampler: Sampler, count: int, batch: int, *, start: int = 0, ordered: bool = False) -> IntArray:
    picks: IntArray = sampler.draw(np.array([start]), batch, np.array([count]), np.array([ordered]))[0]
    return picks


@pytest.mark.parametrize("ordered", [False, True])
def test_samples_are_distinct_and_in_range(ordered: bool) -> None:
    picks = _draw(Sampler(5, 1000, 3), 40, 2000, ordered=ordered)
    assert picks.min() == 0
    assert picks.max() == 39
    assert (np.diff(np.sort(picks, axis=1), axis=1) > 0).all()


def test_uniform_samples_use_every_match_equally() -> None:
    picks = _draw(Sampler(4, 1000, 0), 20, 20000)
    shares = np.bincount(picks.ravel(), minlength=20) / picks.size
    np.testing.assert_allclose(shares, 0.05, rtol=0.06)


def test_the_best_come_first_in_every_other_sample_and_all_come_in_the_end() -> None:
    sampler = Sampler(3, 4000, 1)
    assert (_draw(sampler, 100, 32, ordered=True)[::2] < 20).mean() > 0.9
    assert 0.1 < (_draw(sampler, 100, 400, ordered=True)[1::2] < 20).mean() < 0.3
    assert (_draw(sampler, 100, 400, start=8000, ordered=True)[::2] < 20).mean() < 0.3


def test_same_seed_same_samples_whatever_the_batches_and_the_other_pairs() -> None:
    together = Sampler(3, 1000, 7).draw(np.zeros(2, dtype=np.intp), 64, np.array([50, 80]), np.array([True, False]))
    sampler = Sampler(3, 1000, 7)
    parts = [_draw(sampler, 50, 32, start=start, ordered=True) for start in (0, 32)]
    assert np.array_equal(together[0], np.concatenate(parts))
    assert np.array_equal(together[1], _draw(Sampler(3, 1000, 7), 80, 64))
    assert not np.array_equal(together[1], _draw(Sampler(3, 1000, 8), 80, 64))
    # As many matches as a sample needs.
    picks = _draw(Sampler(3, 10, 0), 3, 4, ordered=True)
    assert np.array_equal(np.sort(picks, axis=1), np.tile([0, 1, 2], (4, 1)))


@pytest.mark.parametrize(("solver", "size"), [("three_point", 3), ("four_point", 4), ("five_point", 5)])
def test_sampling_goes_on_until_a_sample_without_outliers_is_likely(solver: SolverName, size: int) -> None:
    """Fischler and Bolles: a share w of inliers needs log(1 - confidence) / log(1 - w^size) samples."""
    matches = correspondences(300, seed=1, outliers=0.6)
    lens = matches.truth.camera
    found = rdstitch.estimate_radial_homography(
        matches.points1, matches.points2, lens.image_size, focal=lens.focal, solver=solver
    )
    assert found
    # Without the exponent, less than a hundred.
    enough = np.log(1e-3) / np.log1p(-(found.inliers.mean() ** size))
    assert enough < found.iterations < 8 * enough
    assert "stopped at its limit" not in found.reason


def test_more_confidence_takes_more_samples() -> None:
    matches = correspondences(300, seed=1, outliers=0.6)
    given = matches.points1, matches.points2, matches.truth.camera.image_size
    few, many = (
        rdstitch.estimate_radial_homography(*given, solver="five_point", confidence=confidence).iterations
        for confidence in (0.9, 0.999999)
    )
    assert many > 2 * few


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


_THRESHOLD = 3.0


def _seen(first: Camera | None, second: Camera | None, seed: int, motion: str = "similarity") -> PerImageDistortion:
    """What own lenses come to where images of one lens were taken with others instead."""
    matches = correspondences(400, seed=seed, motion=motion, noise=0.3)
    lens = matches.truth.camera

    def taken(points: FloatArray, other: Camera | None) -> FloatArray:
        return points if other is None else other.distort(lens.undistort(points))

    points1, points2 = taken(matches.points1, first), taken(matches.points2, second)
    kept = np.isfinite(points1).all(axis=1) & np.isfinite(points2).all(axis=1)
    points1, points2 = points1[kept], points2[kept]
    relation = estimate_radial_homography(points1, points2, lens.image_size)
    data = Measurements.from_pixels(points1, points2, relation.camera, relation.camera2)
    return estimate_per_image_distortion([relation], data, _THRESHOLD)[0]


def _difference(found: PerImageDistortion) -> tuple[float, float]:
    """λ of the second image less that of the first, and its standard deviation."""
    sign = np.array([-1.0, 1.0])
    return float(sign @ found.distortion), float(np.sqrt(sign @ found.covariance @ sign))


@pytest.mark.parametrize("motion", ["rigid", "homography"])
@pytest.mark.parametrize("other", [-0.15, -0.05])
def test_two_lenses_are_seen_for_what_they_are(other: float, motion: str) -> None:
    for seed in range(4):
        found = _seen(None, Camera((1000, 800), other), seed, motion)
        difference, std = _difference(found)
        assert abs(difference) > 10.0 * std
        np.testing.assert_allclose(difference, other + 0.25, atol=min(0.02, 5.0 * std))
        missed = np.abs(found.distortion - (-0.25, other)) / np.sqrt(np.diag(found.covariance))
        assert missed.max() < 5.0


@pytest.mark.parametrize(
    "other", [None, Camera((1000, 800), -0.25, center=(525.0, 385.0)), Camera((1000, 800), -0.25, distortion2=0.05)]
)
def test_one_lens_is_one_wherever_its_centre_is(other: Camera | None) -> None:
    for seed in range(6):
        difference, std = _difference(_seen(other, other, seed))
        assert abs(difference) < 5.0 * std


def test_rotation_about_the_axis_does_not_show_the_lens() -> None:
    rng = np.random.default_rng(3)
    lens = Camera((640, 480), -0.2)
    points1 = rng.uniform((0, 0), (639, 479), (300, 2))
    c, s = np.cos(0.3), np.sin(0.3)
    points2 = (points1 - lens.center) @ np.array([[c, s], [-s, c]]) + lens.center + 0.3 * rng.standard_normal((300, 2))
    relation = estimate_radial_homography(points1, points2, lens.image_size)
    data = Measurements.from_pixels(points1, points2, lens, lens)
    found = estimate_per_image_distortion([replace(relation, camera=lens, camera2=lens)], data, _THRESHOLD)[0]
    assert np.sqrt(np.diag(found.covariance)).min() > 0.1
