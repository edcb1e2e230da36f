"""Heights of the ground explain errors along the parallax, and nothing else moves with them; how wide hills are."""

from dataclasses import replace

import numpy as np
import pytest

from examples.worlds.alignment_scenes import Scene, aligned, fitted, grid_scene
from rdstitch.alignment.motion_models import SIMILARITY
from rdstitch.alignment.recipe import from_another_start
from rdstitch.alignment.relief_weights import choose_over_relief, weighted_by_relief
from rdstitch.alignment.select import ModelChoice, best_of
from rdstitch.choices import Purpose
from rdstitch.geometry.radial_homography import measurement_whitening


def _scene(relief: float, seed: int = 0) -> Scene:
    return grid_scene(3, 2, seed=seed, relief=relief)


@pytest.mark.slow
@pytest.mark.parametrize("relief", [0.08, 0.03])
def test_hills_hardly_move_the_lens(relief: float) -> None:
    """By errors that all count alike λ is off by 0.005 and 0.012 in the root mean square."""
    errors, misses = [], []
    for seed in range(6):
        given = _scene(relief, seed)
        found = aligned(given, model="similarity")
        errors.append(found.distortion - given.distortion)
        misses.append(abs(errors[-1]) / found.distortion_std)
        assert found.relief.found
    assert np.sqrt(np.mean(np.square(errors))) < 0.001
    assert max(misses) < 3.0


def test_over_a_plane_and_of_two_images_nothing_changes() -> None:
    """Of two images tilts do what heights do."""
    problem, fit = fitted(_scene(0.0))
    choice = ModelChoice(fit, "")
    assert weighted_by_relief(problem, fit) is None
    assert choose_over_relief(problem, choice, ["similarity", "tilting"], Purpose.MOSAIC) is choice
    given = _scene(0.08)
    pair = replace(given, cameras=given.cameras[:2], links=[k for k in given.links if max(k.image1, k.image2) == 1])
    problem, fit = fitted(pair)
    assert weighted_by_relief(problem, fit) is None


def test_heights_are_found_as_they_scatter() -> None:
    """Of ``sin sin`` hills they scatter by half of the amplitude, which moves points by that share of the parallax."""
    problem, fit = fitted(_scene(0.08))
    choice = choose_over_relief(problem, ModelChoice(fit, ""), ["similarity"], Purpose.MOSAIC)
    weighted = weighted_by_relief(problem, choice.fit)
    relief = weighted.observations.relief
    noise = choice.fit.result.sigma
    o = problem.observations
    moved = np.linalg.norm(relief, axis=1) * noise
    baseline = np.linalg.norm((o.points2 - o.points1) * o.scale1[o.link, None], axis=1)
    # Of images that hardly turn, a place as high as the amplitude moves by that share of how far it moves anyway.
    assert 0.02 < np.median(moved / baseline) < 0.08
    assert 0.25 < noise < 0.6
    # The displacements go with their observations.
    every = weighted.observations
    for own in (every.subset(np.array([2, 0])), every.thinned(20)):
        rows = [int(np.flatnonzero((every.points1 == point).all(axis=1))[0]) for point in own.points1]
        np.testing.assert_array_equal(own.relief, every.relief[rows])


def test_a_common_displacement_adds_its_square_to_the_covariance() -> None:
    rng = np.random.default_rng(0)
    by_point, common = rng.normal(size=(5, 2, 2)), rng.normal(size=(5, 2))
    whitening = measurement_whitening(by_point, common)
    covariance = (np.eye(2) + by_point @ np.swapaxes(by_point, 1, 2)) / 2.0 + common[:, :, None] * common[:, None, :]
    np.testing.assert_allclose(np.linalg.inv(np.swapaxes(whitening, 1, 2) @ whitening), covariance, rtol=1e-9)


def test_nothing_is_the_best_of_layouts_that_nobody_would_keep() -> None:
    problem, fit = fitted(_scene(0.0))
    steep = replace(fit.result.parameters, shared=SIMILARITY.shared_from_physical(np.array([1.2, 0.0, 0.3])))
    leaning = replace(fit, result=replace(fit.result, parameters=steep))
    for fits, purpose, found in (
        ([leaning], Purpose.MOSAIC, False),
        ([leaning], Purpose.TRAJECTORY, True),
        ([leaning, fit], Purpose.MOSAIC, True),
    ):
        best = best_of(problem, fits, purpose, requested=False)
        assert (best is not None) is found
    assert best is not None
    assert best.fit is fit


def test_the_error_of_the_reason_is_that_of_the_fit() -> None:
    _, fit = fitted(_scene(0.0))
    choice = ModelChoice(fit, "; as requested")
    later = replace(choice, fit=replace(fit, result=replace(fit.result, sigma=7.25)))
    assert "7.25 pixels; as requested" in later.reason


def test_what_did_not_converge_is_tried_from_another_start() -> None:
    problem, fit = fitted(_scene(0.0))
    astray = replace(fit.result.parameters, shared=SIMILARITY.shared_from_physical(np.array([-1.4, 0.5, 3.0])))
    lost = replace(fit, result=replace(fit.result, parameters=astray, sigma=25.0, converged=False))
    found = from_another_start(problem, lost)
    assert found.result.converged
    assert found.result.sigma == pytest.approx(fit.result.sigma, rel=0.01)
    assert from_another_start(problem, fit) is fit
