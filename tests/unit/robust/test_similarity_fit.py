"""A similarity through points of which some are wrong, however far."""

import numpy as np
import pytest

from rdstitch.robust.similarity_fit import fit_similarity

SCALE, ORIGIN = 0.03 * np.exp(0.8j), 4e5 + 5e6j


@pytest.mark.parametrize("count", [4, 5, 8, 200])
@pytest.mark.parametrize("far", [300.0, 5e6])
def test_what_is_wrong_does_not_count_and_is_named(count: int, far: float) -> None:
    rng = np.random.default_rng(count)
    source = np.asarray(4000.0 * (rng.random(count) + 1j * rng.random(count)), dtype=np.complex128)
    target = SCALE * source + ORIGIN + 0.5 * (rng.normal(size=count) + 1j * rng.normal(size=count))
    wrong = rng.permutation(count)[: (count - 2) // 2]
    target[wrong] += far * np.exp(1j * rng.uniform(0, 2 * np.pi, len(wrong)))
    fit = fit_similarity(source, target, 3.0)
    assert np.flatnonzero(~fit.inliers).tolist() == sorted(wrong)
    middle = 2000.0 + 2000.0j
    assert abs(fit.scale * middle + fit.origin - SCALE * middle - ORIGIN) < 3.0
    assert abs(fit.scale / SCALE - 1) < 0.05


def test_points_that_are_all_the_same_place_targets_in_their_middle() -> None:
    fit = fit_similarity(np.ones(4, np.complex128), np.arange(4, dtype=np.complex128), 1.0)
    assert fit.scale + fit.origin == pytest.approx(1.5, abs=1e-3)
