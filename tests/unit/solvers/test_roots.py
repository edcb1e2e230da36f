"""All real roots in an interval, of polynomials with known roots."""

from dataclasses import dataclass
from typing import Self

import numpy as np
import pytest

from rdstitch.arrays import FloatArray
from rdstitch.solvers.batch import IndexArray
from rdstitch.solvers.polynomials import bernstein_from_values, chebyshev_nodes
from rdstitch.solvers.roots import real_roots


@dataclass(frozen=True)
class Product:
    """``scale Π (λ - root)`` times ``Π ((λ - centre)² + height²)``, whose roots are not real."""

    roots: FloatArray
    scale: FloatArray
    centres: FloatArray
    heights: FloatArray

    def polynomial(self, distortion: FloatArray) -> FloatArray:
        value = np.broadcast_to(self.scale, distortion.shape).copy()
        for root in self.roots:
            value = value * (distortion - root)
        for centre, height in zip(self.centres, self.heights, strict=True):
            value = value * ((distortion - centre) ** 2 + height**2)
        return value

    def take(self, samples: IndexArray) -> Self:
        return type(self)(*(a[..., samples] for a in (self.roots, self.scale, self.centres, self.heights)))


def product(roots: FloatArray, pairs: int = 0, seed: int = 0) -> Product:
    """Polynomials with given real roots (count, B), and random complex ones."""
    rng = np.random.default_rng(seed)
    batch = roots.shape[1]
    return Product(
        roots,
        rng.choice([-1.0, 1.0], batch) * 10.0 ** rng.uniform(-12, 12, batch),
        rng.uniform(-1.5, 0.5, (pairs, batch)),
        rng.uniform(0.05, 1.0, (pairs, batch)),
    )


def interval(batch: int, low: float = -1.5, high: float = 0.5) -> tuple[FloatArray, FloatArray]:
    return np.full(batch, low), np.full(batch, high)


@pytest.mark.parametrize(("real", "pairs"), [(1, 0), (2, 1), (3, 2), (4, 7), (6, 0), (8, 5)])
def test_finds_every_root_inside_and_none_else(real: int, pairs: int) -> None:
    rng = np.random.default_rng(real + 100 * pairs)
    batch = 3000
    roots = rng.uniform(-2.0, 1.0, (real, batch))
    close = (np.abs(np.diff(np.sort(roots, axis=0), axis=0)) < 1e-2).any(axis=0) if real > 1 else np.zeros(batch, bool)
    roots = roots[:, ~close]
    low, high = interval(roots.shape[1])
    sample, found = real_roots(product(roots, pairs), real + 2 * pairs, low, high)
    inside = (roots > -1.5) & (roots < 0.5)
    assert np.array_equal(np.bincount(sample, minlength=roots.shape[1]), inside.sum(axis=0))
    assert (np.diff(sample) >= 0).all()
    expected = np.sort(np.where(inside, roots, np.inf), axis=0)
    order = np.lexsort((found, sample))
    sample, found = sample[order], found[order]
    rank = np.arange(len(sample)) - np.searchsorted(sample, sample)
    error = np.abs(found - expected[rank, sample])
    # At degree 18 values next to a root can be 1e-15 of those at the ends.
    assert np.quantile(error, 0.999) < 1e-12
    assert error.max() < 1e-4


@pytest.mark.parametrize("gap", [1e-2, 1e-3, 1e-4, 1e-5, 1e-6, 0.0])
def test_two_close_roots_are_both_found(gap: float) -> None:
    batch = 500
    first = np.random.default_rng(1).uniform(-1.4, 0.4, batch)
    roots = np.stack([first, first + gap])
    sample, found = real_roots(product(roots, pairs=2), 6, *interval(batch))
    assert np.array_equal(np.unique(sample), np.arange(batch))
    nearest = [np.abs(found[sample == i, None] - roots[:, i]).min(axis=0).max() for i in range(batch)]
    # Nearer than about 1e-6 they are one double root to rounding error.
    assert max(nearest) < max(1e-3 * gap, 1e-6)


def test_a_near_miss_is_no_root() -> None:
    batch = 500
    rng = np.random.default_rng(3)
    equation = Product(
        np.empty((0, batch)), np.ones(batch), rng.uniform(-1.4, 0.4, (1, batch)), np.full((1, batch), 1e-4)
    )
    sample, _ = real_roots(equation, 2, *interval(batch))
    assert len(sample) == 0


def test_every_sample_has_its_own_interval() -> None:
    roots = np.full((1, 3), -0.2)
    low, high = np.array([-0.3, -0.1, 0.2]), np.array([0.0, 0.3, -0.4])
    sample, found = real_roots(product(roots), 1, low, high)
    assert sample.tolist() == [0]
    assert found[0] == pytest.approx(-0.2, abs=1e-15)


@pytest.mark.parametrize("value", [np.nan, np.inf, 0.0])
def test_a_polynomial_without_meaning_has_no_roots(value: float) -> None:
    equation = product(np.full((1, 2), -0.3))
    equation.scale[1] = value
    with np.errstate(invalid="ignore"):
        sample, _ = real_roots(equation, 1, *interval(2))
    assert sample.tolist() == [0]


def test_what_is_kept_for_all_cannot_be_changed_by_one() -> None:
    for kept in (chebyshev_nodes(4), bernstein_from_values(4, 2)):
        with pytest.raises(ValueError, match="read-only"):
            kept[0] = 0.0
