"""The standard deviation of λ is what λ scatters by, also where errors are no independent noise."""

from dataclasses import replace

import numpy as np
import pytest

from examples.worlds.alignment_scenes import aligned, fitted, grid, grid_scene, scene
from examples.worlds.lens_scenes import SIZE, lens_scene
from rdstitch.alignment.least_squares.bundle_adjustment import BundleAdjuster, FreeParameters, Parameters
from rdstitch.alignment.least_squares.linear_response import LinearResponse
from rdstitch.alignment.least_squares.observations import Observations
from rdstitch.alignment.least_squares.priors import Priors
from rdstitch.alignment.motion_models import SIMILARITY
from rdstitch.alignment.noise import shared_variance
from rdstitch.alignment.relief_field import ReliefField
from rdstitch.alignment.uncertainty import sandwich_covariances
from rdstitch.arrays import BoolArray, FloatArray
from rdstitch.geometry.camera import LENS_PARAMETERS, Camera
from rdstitch.geometry.radial_homography import project
from rdstitch.robust.priors import Prior

LENS, NOISE = Camera((640, 480), distortion=-0.2), 0.4
KNOWN = (Prior(), Prior(), Prior(((1.0, float(np.log(1.3)), 0.01),)))
"""The inverse variance of the focal length's logarithm: images from straight above do not show it."""

PAIRS = [(i, j) for i in range(6) for j in range(i + 1, 6)]


def _keypoints(matrices: FloatArray, ground: FloatArray, rng: np.random.Generator) -> tuple[FloatArray, BoolArray]:
    """Measured points (N, P, 2), half diagonals, and which of them (N, P) an image sees."""
    seen = np.stack([project(np.column_stack([ground, np.ones(len(ground))]) @ matrix.T) for matrix in matrices])
    pixels = LENS.distort(LENS.denormalize(seen.reshape(-1, 2))).reshape(seen.shape)
    inside = ((pixels >= 0.0) & (pixels <= np.array(LENS.image_size) - 1.0)).all(axis=2)
    measured = (pixels + rng.normal(0.0, NOISE, pixels.shape)).reshape(-1, 2)
    return LENS.normalize(measured).reshape(seen.shape), np.asarray(inside)


def _miss(seed: int, shared_keypoints: bool) -> float:
    """λ's error in standard deviations."""
    rng = np.random.default_rng(seed)
    poses = grid(3, 2, (0.3, 0.25), 0.2, np.random.default_rng(0))
    shared = SIMILARITY.shared_from_physical(np.array([0.0, 0.0, np.log(1.3)]))
    poses[:, 1:3] *= 1.3
    matrices = SIMILARITY.matrices(poses, shared).matrices
    ground = rng.uniform(-1.2, 2.2, (1200, 2))
    points, inside = _keypoints(matrices, ground, rng)
    rows = []
    for i, j in PAIRS:
        if not shared_keypoints:
            points, inside = _keypoints(matrices, rng.uniform(-1.2, 2.2, ground.shape), rng)
        both = np.flatnonzero(inside[i] & inside[j])[:60]
        rows.append((points[i][both], points[j][both]))
    count = np.array([len(first) for first, _ in rows])
    image1, image2 = np.array(PAIRS).T
    size = np.full(len(PAIRS), LENS.scale)
    start = np.concatenate([[0], np.cumsum(count)]).astype(np.intp)
    first, second = (np.concatenate([row[side] for row in rows]) for side in (0, 1))
    observations = Observations(image1, image2, start, first, second, size, size, count)
    adjuster = BundleAdjuster(
        SIMILARITY,
        observations,
        FreeParameters.fixing(SIMILARITY, 6, [0], np.arange(len(LENS_PARAMETERS)) == 0),
        replace(Priors.none(SIMILARITY, 6), shared=KNOWN),
        shared_variance(observations, np.zeros((int(start[-1]), 2)), np.ones(int(start[-1]), dtype=np.bool_)),
    )
    found = adjuster.run(Parameters(poses, shared, np.array([-0.2, 0.0, 0.0, 0.0, 0.0])))
    (covariance,) = sandwich_covariances(adjuster, found, [np.arange(4)])
    return (float(found.parameters.lens[0]) + 0.2) / float(np.sqrt(covariance[-1, -1]))


@pytest.mark.parametrize("shared_keypoints", [False, True])
def test_the_deviation_is_the_scatter(shared_keypoints: bool) -> None:
    """15 pairs of 6 images, whose keypoints are all shared, or none of which is."""
    misses = np.array([_miss(seed, shared_keypoints) for seed in range(40)])
    assert 0.68 < np.sqrt(np.mean(misses**2)) < 1.2


@pytest.mark.slow
@pytest.mark.parametrize("relief", [0.03, 0.0])
def test_the_stated_deviation_covers_relief(relief: float) -> None:
    misses = []
    for seed in range(16):
        given = grid_scene(3, 2, seed=seed, relief=relief)
        found = aligned(given, model="similarity")
        misses.append(abs(found.distortion - given.distortion) / found.distortion_std)
    assert max(misses) < 3.0
    assert np.median(misses) > 0.33


@pytest.mark.slow
def test_the_stated_deviation_covers_what_two_images_do_not_show() -> None:
    """Two hardly show an axis off the middle: a tilt and a change of height stand for it, and λ is off."""
    lens = Camera(SIZE, -0.25, center=(333.0, 233.0))
    found = [aligned(lens_scene(lens, seed, columns=2, rows=1)) for seed in range(10)]
    misses = np.array([abs(own.distortion - lens.distortion) / own.distortion_std for own in found])
    assert {own.lens for own in found} == {"division"}
    assert misses.max() < 3.0
    assert np.median(misses) > 0.33


def _variance_by_relief(columns: int, rows: int, lens: Camera | None, matches: int, seed: int) -> float:
    """Of λ, over its variance by independent errors, with all of the lens free over a plane fitted with λ alone."""
    given = grid_scene(columns, rows, (0.5, 0.3), 0.2, seed=seed, per_link=matches, lens=lens)
    problem, fit = fitted(given)
    adjuster = replace(problem, free_lens=np.ones_like(problem.free_lens)).adjuster_of(fit)
    steps, of_lens = ReliefField(LinearResponse.of(adjuster, fit.result)).steps()[1], len(fit.model.shared_names)
    return float((steps[of_lens] ** 2).sum() / adjuster.covariance(fit.result)[of_lens, of_lens])


@pytest.mark.parametrize(
    ("columns", "rows", "lens", "matches", "most"),
    [
        (3, 2, Camera((640, 480), -0.25, distortion2=0.08), 200, 0.2),
        (3, 2, Camera((640, 480), -0.25, center=(333.0, 233.0)), 200, 0.2),
        (2, 1, None, 40, 0.04),
    ],
)
def test_a_plane_has_no_hills(columns: int, rows: int, lens: Camera | None, matches: int, most: float) -> None:
    """Neither where a lens is not quite what was fitted, nor by the chance agreement of the few errors of one pair."""
    assert np.mean([_variance_by_relief(columns, rows, lens, matches, seed) for seed in range(6)]) < most


def test_a_focal_length_that_no_lens_has_makes_the_lens_less_certain() -> None:
    """Something else bends the images; what λ would be with a usual focal length is counted."""
    poses = grid(3, 2, (0.06, 0.045), 0.2, np.random.default_rng(0))
    std = {}
    for source in ("option", "guess"):
        given = scene(
            poses,
            focal=3600.0,
            tilt=(0.5, 0.4),
            guess=3600.0 if source == "option" else 520.0,
            focal_source=source,
            rng=np.random.default_rng(1),
        )
        found = aligned(given, model="similarity")
        assert found.focal > 6.0
        std[source] = found.distortion_std
    assert std["guess"] > 2.0 * std["option"]
