"""What the agreement of neighbouring residuals says of the scene, and how many of them are independent."""

from dataclasses import replace

import numpy as np
import pytest

from rdstitch.alignment.least_squares.observations import Observations
from rdstitch.alignment.motion_models import MODELS
from rdstitch.alignment.noise import Coherence, coherence, evidence_of, shared_variance, shows_relief
from rdstitch.alignment.noise import independent_errors as independent
from rdstitch.alignment.sentences import relief_explained
from rdstitch.arrays import FloatArray
from rdstitch.choices import ModelName
from rdstitch.robust.posterior import MODEL_ERROR
from tests.alignment_stubs import SHIFT, independent_errors, observations


@pytest.mark.parametrize(
    ("correlation", "relative_size", "model", "links", "found", "says"),
    [
        (0.9, 0.001, "rigid", 9, True, "not one plane"),
        (0.51, 0.0008, "rigid", 9, True, "not one plane"),
        (0.9, 0.0005, "rigid", 9, False, "flat"),
        (0.4, 0.01, "rigid", 9, False, "flat"),
        # Of a turn what neighbours share is parallax.
        (0.9, 0.001, "rotation", 9, True, "parallax"),
        (0.9, 0.0005, "rotation", 9, False, "hardly moved"),
        (0.6, 0.0001, "pose", 9, False, "nearly flat"),
        (0.4, 0.0001, "pose", 9, False, "the scene is flat"),
        (0.4, 0.0001, "pose", 1, False, "no relief shows, but hills"),
    ],
)
def test_relief_needs_agreement_and_size(
    correlation: float, relative_size: float, model: ModelName, links: int, found: bool, says: str
) -> None:
    for diagonal in (500.0, 2000.0):
        left = Coherence(correlation, relative_size * diagonal, relative_size)
        assert shows_relief(left) == found
        assert says in relief_explained(left, MODELS[model], links)


def _residuals(common: float, own: float, *, links: int = 8, seed: int = 0) -> tuple[Observations, FloatArray]:
    """Errors of ten by ten points a link: each has its own, and a smooth part in common with its neighbours."""
    rng = np.random.default_rng(seed)
    side = np.linspace(-0.5, 0.5, 10)
    points = np.stack(np.meshgrid(side, side), axis=-1).reshape(-1, 2)
    points = np.concatenate([points + rng.uniform(-0.01, 0.01, points.shape) for _ in range(links)])
    wave = np.stack([np.sin(3.0 * points[:, 0] + 1.0), np.cos(3.0 * points[:, 1])], axis=1)
    wave /= np.sqrt(np.mean(np.sum(wave**2, axis=1)))
    errors = common * wave + own / np.sqrt(2.0) * rng.normal(size=points.shape)
    first = np.arange(links)
    start = np.arange(0, 100 * links + 1, 100)
    size = np.full(links, 500.0)
    return Observations(first, first + 1, start, points, points, size, size, np.full(links, 100)), errors


ALL = np.ones(800, dtype=np.bool_)


@pytest.mark.parametrize(("common", "own"), [(1.0, 0.5), (0.5, 1.0), (2.0, 0.01)])
def test_what_neighbours_have_in_common_is_measured(common: float, own: float) -> None:
    seen, errors = _residuals(common, own)
    found = coherence(seen, errors, ALL)
    assert found.size == pytest.approx(common, rel=0.15)
    assert found.relative_size == pytest.approx(found.size / 1000.0)
    assert found.correlation == pytest.approx(common**2 / (common**2 + own**2), abs=0.1)
    assert shared_variance(seen, errors, ALL) > 3.0


def test_independent_errors_have_nothing_in_common() -> None:
    seen, errors = _residuals(0.0, 1.0)
    assert abs(coherence(seen, errors, ALL).correlation) < 0.1
    assert shared_variance(seen, errors, ALL) < 1.5
    # With one point a cell nothing is overdispersed.
    inliers = np.isin(np.arange(100), np.array([0, 9, 90, 99]))
    assert shared_variance(*_residuals(1.0, 0.1, links=1), inliers) == 1.0


def test_the_overdispersion_is_that_of_sums_over_cells() -> None:
    """Errors that are one number a link add up to K times as much variance as independent ones: K points a cell."""
    seen, _ = _residuals(1.0, 1.0)
    alike = np.repeat(np.random.default_rng(1).normal(size=(8, 2)), 100, axis=0)
    assert shared_variance(seen, alike, ALL) == pytest.approx(25.0, rel=0.02)
    # Every link counts the points of its images again: 8 links of 5 images.
    again = replace(seen, image1=np.array([0, 1, 2, 3, 0, 1, 2, 0]), image2=np.array([1, 2, 3, 4, 2, 3, 4, 3]))
    assert shared_variance(again, alike, ALL) == pytest.approx(25.0 * 8 / 4, rel=0.02)


def test_only_inliers_count_and_few_say_nothing() -> None:
    seen, errors = _residuals(1.0, 0.1)
    errors[::10] = 1e6
    inliers = np.arange(800) % 10 > 0
    assert coherence(seen, errors, inliers).size == pytest.approx(1.0, rel=0.15)
    for few in (np.zeros(800, dtype=np.bool_), np.arange(800) == 3):
        assert coherence(seen, errors, few) == Coherence(0.0, 0.0, 0.0)


def test_a_feature_found_twice_is_no_neighbour() -> None:
    """Pairs of points a few thousandths apart, with the same error; what is farther off is independent."""
    seen, errors = _residuals(0.0, 1.0)
    twice, both = np.repeat(seen.points1[::2], 2, axis=0), np.repeat(errors[::2], 2, axis=0)
    near, apart = (
        coherence(replace(seen, points1=twice + np.tile([[0.0, 0.0], [off, 0.0]], (400, 1))), both, ALL).correlation
        for off in (0.003, 0.007)
    )
    assert abs(near) < 0.2
    assert apart > 0.8
    # Nor is what is far away.
    seen, errors = _residuals(2.0, 0.01)
    for factor, agrees in ((2.0, True), (3.0, False)):
        wide = replace(seen, points1=factor * seen.points1)
        assert (coherence(wide, errors, ALL).correlation > 0.5) is agrees


def _found(errors: np.ndarray, images: int = 6) -> tuple[float, float]:
    seen = observations(errors, images)
    return independent(seen, np.tile(SHIFT, (len(seen), 1, 1)), np.zeros(5))


def test_links_measure_points_again_and_only_inliers_of_links_that_fit_count() -> None:
    errors = independent_errors(sigma=0.5)
    shared, count = _found(errors)
    # Nine links of six images measure each point about twice; the errors themselves are independent.
    assert shared == pytest.approx(9 / 5, rel=0.35)
    assert count == pytest.approx(2.0 * 540 / shared, rel=0.02)
    errors[4] += 40.0
    errors[0, ::10] = [9.0, 6.0]
    shared, count = _found(errors)
    assert count == pytest.approx(2.0 * (480 - 6) / shared, rel=0.02)


def test_there_are_two_observations_at_least() -> None:
    assert _found(np.full((1, 1, 2), 0.3), 2)[1] == 2.0


@pytest.mark.parametrize(("sigma", "noise"), [(0.5, 0.5), (0.01, MODEL_ERROR)])
def test_the_noise_is_the_scatter_or_what_no_model_is_exact_to(sigma: float, noise: float) -> None:
    errors = independent_errors(sigma=sigma)
    assert evidence_of(observations(errors), errors.reshape(-1, 2)).noise[0] == pytest.approx(noise, rel=0.05)
