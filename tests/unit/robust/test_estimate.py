"""The public functions of two-view estimation: their arguments, and what known tilts and solvers change."""

from typing import Any

import numpy as np
import pytest

from examples.worlds.alignment_scenes import grid_scene
from examples.worlds.correspondences import correspondences
from examples.worlds.turns import panorama_rotations
from rdstitch.choices import SOLVERS, SolverName
from rdstitch.errors import ArgumentError
from rdstitch.geometry.camera import Camera
from rdstitch.geometry.radial_homography import RadialHomography
from rdstitch.robust import EstimationOptions, PairMatches, estimate_radial_homographies, estimate_radial_homography
from rdstitch.robust.priors import prior_costs

MATCHES = correspondences(150, seed=4, outliers=0.3)
LENS = MATCHES.truth.camera
TRUE = MATCHES.truth.motion


@pytest.mark.parametrize(
    ("wrong", "says"),
    [
        ({"solver": "six_point"}, "solver must be one of"),
        ({"solver": "three_point", "distortion": -0.1}, "no solver can be chosen"),
        ({"distortion": np.nan}, "below 1"),
        ({"distortion": 1.0}, "below 1"),
        ({"threshold": 0.0}, "above 0"),
        ({"confidence": 0.0}, "above 0 and below 1"),
        ({"confidence": 1.0}, "above 0 and below 1"),
        ({"max_iterations": 0}, "at least 1"),
        ({"tilt": (0.1, 0.2, 0.3)}, "tilt must be"),
        ({"tilt": (np.nan, 0.2)}, "tilt must be"),
        ({"tilt": np.zeros((3, 2))}, "tilt must be"),
        ({"tilt": "a"}, "tilt must be an array of numbers"),
        ({"tilt": (0.0, 2.0)}, "below a right angle"),
        ({"center": (340.0, 240.0), "image_size2": (480, 640)}, "turned by a quarter"),
        ({"quality": np.ones(7)}, "quality must have shape"),
        ({"quality": ["a"] * 150}, "quality must be an array of numbers"),
        ({"quality": np.full(150, np.nan)}, "quality has values that are NaN"),
        ({"solver": "two_point"}, "needs the tilt"),
    ],
)
def test_wrong_arguments_are_refused(wrong: dict[str, object], says: str) -> None:
    with pytest.raises(ArgumentError, match=says):
        estimate_radial_homography(MATCHES.points1, MATCHES.points2, LENS.image_size, **wrong)  # type: ignore[arg-type]


def test_a_pair_is_checked_where_it_is_made() -> None:
    points, lens = MATCHES.points1, LENS.with_guessed_focal()
    for wrong, says in (
        ((points, points * np.nan, lens, lens), "not finite"),
        (([["a", "b"]], points, lens, lens), "points1 must be an array of numbers"),
        ((points, points, lens, lens, np.ones(3)), "quality must have shape"),
        ((points, points, lens, lens, None, np.zeros(2)), "tilt must be"),
    ):
        with pytest.raises(ArgumentError, match=says):
            PairMatches(*wrong)


@pytest.mark.parametrize("solver", [name for name in SOLVERS if name != "two_point"])
def test_each_solver_finds_the_motion(solver: SolverName) -> None:
    found = estimate_radial_homography(
        MATCHES.points1, MATCHES.points2, LENS.image_size, focal=LENS.focal, solver=solver
    )
    assert found.ok
    assert found.distortion == pytest.approx(LENS.distortion, abs=0.03)
    assert solver in ("auto", found.solver)
    assert found.solver != "four_point" or solver == "four_point"
    _check_covariance(found)


@pytest.mark.parametrize("solver", ["auto", "two_point", "three_point"])
@pytest.mark.parametrize("both", [False, True])
def test_a_known_tilt_is_used(solver: SolverName, both: bool) -> None:
    tilt = np.array([TRUE.tilt, TRUE.tilt]) if both else TRUE.tilt
    found = estimate_radial_homography(
        MATCHES.points1, MATCHES.points2, LENS.image_size, focal=LENS.focal, tilt=tilt, solver=solver
    )
    assert found.model == "rigid"
    np.testing.assert_allclose(found.motion.tilt, TRUE.tilt, atol=1e-12)
    assert found.motion.yaw == pytest.approx(TRUE.yaw, abs=0.01)
    assert solver in ("auto", found.solver)
    _check_covariance(found)


@pytest.mark.parametrize("known", [{"distortion": LENS.distortion}, {"image_size2": np.array(LENS.image_size)}])
def test_a_covariance_has_the_parameters_that_are_named(known: dict[str, Any]) -> None:
    size: Any = np.array(LENS.image_size)
    found = estimate_radial_homography(MATCHES.points1, MATCHES.points2, size, **known)
    assert found.covariance.shape == (len(found.parameters),) * 2
    assert ("distortion" in found.parameters) is ("distortion" not in known)


def _check_covariance(found: RadialHomography) -> None:
    assert found.covariance.shape == (len(found.parameters),) * 2
    assert found.parameters[0] == "distortion"
    assert found.covariance[0, 0] == pytest.approx(found.distortion_std**2)


def test_a_known_lens_is_kept() -> None:
    found = estimate_radial_homography(MATCHES.points1, MATCHES.points2, LENS.image_size, distortion=LENS.distortion)
    assert (found.distortion, found.distortion_std) == (LENS.distortion, 0.0)
    assert found.solver in ("two_point_similarity", "four_point_dlt")


def test_each_image_keeps_its_distortion_centre() -> None:
    camera = Camera((640, 480), center=(400.0, 239.5), focal=500.0)
    points = np.random.default_rng(3).uniform((40.0, 40.0), (600.0, 440.0), (200, 2))
    turned = np.stack([479.0 - points[:, 1], points[:, 0]], axis=-1)
    (found,) = estimate_radial_homographies(
        [PairMatches(points, turned, camera, camera.turned(6))], EstimationOptions()
    )
    np.testing.assert_allclose(found.transfer(points), turned, atol=1e-3)


def test_what_the_lens_of_the_cameras_was_is_not_used() -> None:
    folded = LENS.with_coefficients(-0.1, -0.05, 0.01)
    plain, bent = estimate_radial_homographies(
        [PairMatches(MATCHES.points1, MATCHES.points2, camera, camera) for camera in (LENS, folded)],
        EstimationOptions(),
    )
    assert bent.camera == plain.camera
    np.testing.assert_array_equal(bent.transfer(MATCHES.points1), plain.transfer(MATCHES.points1))


@pytest.mark.parametrize("focals", [(600.0, 1200.0), (1200.0, 600.0)])
def test_focal_lengths_that_differ_count_as_uncertain_in_either_order(focals: tuple[float, float]) -> None:
    first, second = (Camera((640, 480)).with_focal(focal, "exif") for focal in focals)
    pair = PairMatches(MATCHES.points1, MATCHES.points2, first, second)
    assert pair.camera1.focal == pair.camera2.focal == pytest.approx(600.0 * np.sqrt(2.0))
    assert all(prior_costs((pair.focal_prior,), np.log([focal / first.scale]))[0] < 1.0 for focal in focals)


def test_a_focal_length_that_one_image_states_is_that_of_both() -> None:
    stated, unknown = Camera((640, 480)).with_focal(600.0, "exif"), Camera((320, 240))
    for first, second in ((stated, unknown), (unknown, stated)):
        pair = PairMatches(MATCHES.points1, MATCHES.points2, first, second)
        assert pair.camera1.focal == pytest.approx(600.0 * first.image_size[0] / 640)
        assert pair.camera1.focal_log_std == pytest.approx(0.05)


def test_too_few_matches_are_no_result_but_a_reason() -> None:
    found = estimate_radial_homography(MATCHES.points1[:5], MATCHES.points2[:5], LENS.image_size)
    assert not found
    assert "only 5 matches" in found.reason
    for count in (8, 30, 400):
        first, second = np.random.default_rng(0).uniform((0, 0), (999, 799), (2, count, 2))
        none = estimate_radial_homography(first, second, LENS.image_size)
        assert (bool(none), bool(none.reason)) == (False, True)


def test_the_best_matches_are_sampled_first() -> None:
    pair = PairMatches(MATCHES.points1, MATCHES.points2, LENS, LENS, np.linspace(0.0, 1.0, 150))
    assert pair.order.tolist() == list(range(150))[::-1]
    assert PairMatches(MATCHES.points1, MATCHES.points2, LENS, LENS).order.tolist() == list(range(150))
    # Errors come back in the order of the matches, not of their quality.
    found = estimate_radial_homographies([pair], EstimationOptions())[0]
    agree = found.inliers == MATCHES.truth.inliers
    assert agree.mean() > 0.95


def test_pairs_with_many_inliers_need_no_other_model() -> None:
    pair = PairMatches(MATCHES.points1, MATCHES.points2, LENS, LENS)
    inliers = int(MATCHES.truth.inliers.sum())
    models = [
        estimate_radial_homographies([pair], EstimationOptions(select_below=limit))[0].model
        for limit in (None, inliers + 20, inliers - 20)
    ]
    assert models == ["rigid", "rigid", "homography"]


@pytest.mark.parametrize("limit", [1, 10, 100, 700])
def test_no_more_samples_are_drawn_than_were_allowed(limit: int) -> None:
    rng = np.random.default_rng(0)
    points1, points2 = rng.uniform((0, 0), (639, 479), (2, 300, 2))
    points2[:40] = points1[:40] + np.array([40.0, 10.0])
    assert estimate_radial_homography(points1, points2, (640, 480), max_iterations=limit).iterations == limit


def test_a_given_wide_lens_is_kept_while_the_motion_is_refined() -> None:
    lens = Camera((640, 480), -0.985)
    rng = np.random.default_rng(1)
    points1 = rng.uniform((160, 120), (480, 360), (300, 2))
    shift = lens.undistort(points1) + np.array([60.0, 20.0])
    points2 = lens.distort(shift) + rng.normal(0.0, 0.1, (300, 2))
    given = points1 + rng.normal(0.0, 0.1, (300, 2))
    found = estimate_radial_homography(given, points2, (640, 480), distortion=-0.985)
    assert found.ok
    assert np.median(np.linalg.norm(found.transfer(points1) - lens.distort(shift), axis=1)) < 0.05


@pytest.mark.parametrize("known", [False, True])
def test_two_points_find_turns_that_a_thirteenth_of_the_matches_shows(known: bool) -> None:
    """Without the solvers for turns a quarter of them; whatever the focal length is guessed as."""
    found = 0
    for seed in range(8):
        rng = np.random.default_rng(seed)
        camera = Camera((1000, 800), -0.1, focal=float(rng.uniform(600.0, 1200.0)), focal_source="option")
        rotation = panorama_rotations(2, 0.25, jitter=0.03, seed=seed)
        relative = rotation[1] @ rotation[0].T
        first = rng.uniform((0.0, 0.0), (999.0, 799.0), (400, 2))
        rays = np.column_stack([(camera.undistort(first) - camera.center) / camera.focal, np.ones(400)]) @ relative.T
        second = camera.distort(rays[:, :2] / rays[:, 2:] * camera.focal + camera.center)
        inside = np.flatnonzero(((second >= 0.0) & (second <= [999.0, 799.0])).all(axis=1))[:200]
        first, second = first[inside], second[inside] + rng.normal(0.0, 0.7, (len(inside), 2))
        right = len(inside) // 13
        second[right:] = rng.uniform((0.0, 0.0), (999.0, 799.0), (len(inside) - right, 2))
        order = rng.permutation(len(inside))
        lens = -0.1 if known else None
        result = estimate_radial_homography(first[order], second[order], (1000, 800), distortion=lens)
        found += bool(result.inliers[order < right].mean() > 0.6)
    assert found >= 5


@pytest.mark.parametrize(
    ("model", "seed", "distortion", "noise", "step"),
    [
        ("rigid", 3, 0.0, 2.0, 0.3),
        ("similarity", 9, 0.0, 1.0, 0.05),
        ("similarity", 9, -0.05, 1.0, 0.05),
        ("similarity", 9, -0.05, 2.0, 0.3),
    ],
)
def test_a_model_that_needs_an_unusual_lens_is_not_taken(
    model: str, seed: int, distortion: float, noise: float, step: float
) -> None:
    """Of few matches that hardly show λ, another model explains a little more, with λ off by .05 to .2."""
    change = 0.2 if model == "similarity" else 0.0
    lens = Camera((640, 480), distortion)
    given = grid_scene(
        2, 1, (step, step), 0.1, wind=(change, 0.0), seed=seed, lens=lens, noise=noise, focal=480.0, per_link=40,
        outliers=0.1,
    )  # fmt: skip
    (link,) = given.links
    found = estimate_radial_homography(link.points1, link.points2, lens.image_size, focal=480.0, focal_source="guess")
    assert found.model == model
