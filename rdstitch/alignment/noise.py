"""Noise, and what neighbours share: the correlation of residuals of neighbouring points decides.

Noise differs from point to point; a hill moves all its points together. So residuals that agree between neighbours
come from something that the model does not describe: relief, a lens of another kind, a moving object. The same
correlation gives the number of independent observations, which is smaller than that of correspondences.
"""

import math
from dataclasses import dataclass

import numpy as np

from rdstitch.alignment.cycle_consistency import misfitting_links
from rdstitch.alignment.least_squares.link_equations import squared_lengths, whitened_errors
from rdstitch.alignment.least_squares.observations import Observations
from rdstitch.arrays import BoolArray, FloatArray, IntArray
from rdstitch.numerics.nearest_points import SAME_FEATURE, separate_neighbours
from rdstitch.robust.posterior import Evidence, overlap_cells

_CELLS = (2, 3, 4)  # cells per side of a link's overlap within which errors are added up; the worst counts

COHERENT_CORRELATION = 0.5
"""Correlation of neighbours from which on a scene does not count as flat, if what they have in common is large."""

LARGE_RELIEF = 0.00075
"""Of an image's diagonal: lenses that one λ describes roughly leave less, flights over trees and houses more."""

_MAX_SAMPLES = 200_000  # correspondences of which the agreement is measured

_MAX_DISTANCE = 0.25  # half diagonals between neighbours


@dataclass(frozen=True)
class Coherence:
    """How much the residuals of neighbours agree."""

    correlation: float  # mean correlation of the residuals of nearest neighbours within a link
    size: float  # root mean square of the common part, pixels
    relative_size: float  # the same in diagonals of an image


def coherence(observations: Observations, errors: FloatArray, inliers: BoolArray) -> Coherence:
    """Agreement of the residuals (M, 2) of neighbouring inliers of the same link; of very many links, every n-th."""
    chosen = _sample(observations, inliers)
    residual = errors[chosen]
    if len(residual) < 2:
        return Coherence(0.0, 0.0, 0.0)
    first, second = neighbours(observations, inliers)
    products = np.einsum("mi,mi->m", errors[first], errors[second])
    power = float(np.einsum("mi,mi->", residual, residual) / len(residual))
    common = float(products.mean()) if len(products) else 0.0
    size = float(np.sqrt(max(common, 0.0)))
    correlation = common / power if power > 0.0 else 0.0
    return Coherence(correlation, size, size / (2.0 * float(np.median(observations.scale2))))


def shared_variance(observations: Observations, errors: FloatArray, inliers: BoolArray) -> float:
    """The overdispersion of residuals (M, 2): how many times fewer independent ones there are than correspondences.

    At least 1. The product of two things: the variance of the sum of the residuals in a part of an overlap, in units of
    that of independent ones; and the number of links per image, since every link counts the same measured points again.
    """
    chosen, links = _sample(observations, inliers), len(observations)
    if len(chosen) < 2:
        return 1.0
    link, points, residual = observations.link[chosen], observations.points1[chosen], errors[chosen]
    worst = max(_overdispersion(link, points, residual, links, cells) for cells in _CELLS)
    return worst * max(1.0, links / max(observations.image_count - 1, 1))


def neighbours(observations: Observations, inliers: BoolArray) -> tuple[IntArray, IntArray]:
    """Inliers, of very many links every n-th, and the nearest neighbour in the same link of each that has one."""
    chosen = _sample(observations, inliers)
    spaced = np.column_stack([observations.points1[chosen], observations.link[chosen] * 10.0])
    if len(spaced) < 2:
        return chosen[:0], chosen[:0]
    distance, nearest = separate_neighbours(spaced)
    has_neighbour = (distance > SAME_FEATURE) & (distance < _MAX_DISTANCE)
    return chosen[has_neighbour], chosen[nearest[has_neighbour]]


def _sample(observations: Observations, inliers: BoolArray) -> IntArray:
    """Indices of the inliers; of very many links, of every n-th."""
    every = max(1, -(-len(inliers) // _MAX_SAMPLES))
    return np.flatnonzero(inliers & (observations.link % every == 0))


def _overdispersion(link: IntArray, points: FloatArray, residual: FloatArray, count: int, cells: int) -> float:
    """Mean over the cells of all links of ``|Σ r|² / Σ |r|²``."""
    x, y = overlap_cells(link, points, count, cells)
    number = (link * cells + x) * cells + y
    size = count * cells**2
    sums = np.stack([np.bincount(number, residual[:, axis], size) for axis in range(2)], axis=1)
    power = np.bincount(number, np.einsum("mi,mi->m", residual, residual), size)
    several = np.bincount(number, minlength=size) > 1
    if not several.any() or power[several].sum() == 0.0:
        return 1.0
    return max(1.0, float((sums[several] ** 2).sum() / power[several].sum()))


def shows_relief(left: Coherence) -> bool:
    """Whether neighbours agree as they do over a scene with depth, in the errors that a model leaves.

    What is as wide as the overlap of one pair alone, its homography and λ absorb.
    """
    return left.correlation > COHERENT_CORRELATION and left.relative_size > LARGE_RELIEF


def evidence_of(observations: Observations, errors: FloatArray) -> Evidence:
    """What hypotheses on all links are compared by; the errors (M, 2), pixels, are those of links on their own."""
    squared = squared_lengths(errors)
    inliers = observations.inliers(squared)
    shared = min(max(coherence(observations, errors, inliers).correlation, 0.0), 0.9)
    power = float(squared[inliers].mean()) / 2.0 if inliers.any() else 0.0
    images, links = observations.image_count, max(len(observations), 1)
    return Evidence.of(
        observations.link,
        observations.points1,
        np.zeros(len(observations), dtype=np.intp),
        np.array([math.sqrt(power * (1.0 - shared))]),
        np.array([float(np.median(observations.scale2))]),
        np.array([min(1.0, (images - 1) / links)]),
    )


def independent_errors(observations: Observations, homographies: FloatArray, lens: FloatArray) -> tuple[float, float]:
    """The overdispersion of the errors that every link leaves with its homography (L, 3, 3), and how many coordinates
    of the inliers of links that fit are independent.
    """
    errors = whitened_errors(observations, homographies, lens)
    squared = squared_lengths(errors)
    inliers = observations.inliers(squared)
    overdispersion = shared_variance(observations, errors, inliers)
    counted = inliers & ~misfitting_links(squared, observations)[observations.link]
    return overdispersion, max(2.0 * float(counted.sum()) / overdispersion, 2.0)
