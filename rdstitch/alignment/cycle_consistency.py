"""Wrong pairs: links that fit well on their own but contradict the others (repeated structure).

Before the adjustment, links are judged in triangles: the composition of three transfers must
be the identity, within what the links' covariances allow. After it, by the errors that the adjustment leaves them.
"""

import numpy as np
from numpy.typing import NDArray

from rdstitch.alignment.bundle_adjustment import BundleAdjustmentResult
from rdstitch.alignment.link_equations import split_lens
from rdstitch.alignment.observations import Observations
from rdstitch.arrays import BoolArray, FloatArray, IntArray
from rdstitch.geometry.radial_homography import are_homographies, inverses, transfer_jacobian
from rdstitch.matching.links import spread_choice
from rdstitch.system.late_imports import sparse

_PROBES = 6
"""Points of a link that are transferred round each triangle."""

_MAX_TRIANGLES = 20_000

_MIN_ERROR = 0.02
"""Half diagonals: a link that is off by less is no wrong pair."""


def triangles(count: int, image1: IntArray, image2: IntArray) -> IntArray:
    """Links (T, 3) of all triangles i < j < k of the graph, in the order ij, jk, ik.

    Of very many, an evenly spaced part, and one of each link that has any.
    """
    low, high = np.minimum(image1, image2), np.maximum(image1, image2)
    number = sparse.coo_array((np.arange(1, len(low) + 1), (low, high)), shape=(count, count)).tocsr()
    number.sort_indices()
    triples = []
    for link in range(len(low)):
        i, j = int(low[link]), int(high[link])
        partners = number.indices[number.indptr[i] : number.indptr[i + 1]]
        other = number.indices[number.indptr[j] : number.indptr[j + 1]]
        third = np.intersect1d(partners, other)
        if len(third):
            jk = number.data[number.indptr[j] : number.indptr[j + 1]][np.searchsorted(other, third)] - 1
            ik = number.data[number.indptr[i] : number.indptr[i + 1]][np.searchsorted(partners, third)] - 1
            triples.append(np.column_stack([np.full(len(third), link), jk, ik]))
    result = np.concatenate(triples).astype(np.intp) if triples else np.empty((0, 3), dtype=np.intp)
    kept = np.zeros(len(result), dtype=np.bool_)
    kept[:: max(-(-len(result) // _MAX_TRIANGLES), 1)] = True
    links, first = np.unique(result, return_index=True)
    kept[first[~np.isin(links, result[kept])] // 3] = True
    return result[kept]


def cycle_consistency(
    apart: BundleAdjustmentResult, observations: Observations, count: int
) -> tuple[BoolArray, NDArray[np.intp]]:
    """Which links most of their triangles contradict.

    What ran away and is no homography is suspect. One after the other, the link with the most contradictions is taken
    out together with its triangles, until every link left is confirmed at least as often as it is contradicted.
    Takes every link on its own, with a homography, and the number of images; also gives how many of the triangles left
    with each link close, (L,).
    """
    suspect = ~are_homographies(apart.homographies)
    corners = triangles(count, observations.image1, observations.image2)
    if not len(corners):
        return suspect, np.zeros(len(observations), dtype=np.intp)
    bad = _open_triangles(apart, observations, corners)
    alive = np.isfinite(bad) & ~suspect[corners].any(axis=1)
    while True:
        weight = np.where(alive, np.where(bad > 0, 1.0, -1.0), 0.0)
        balance = np.bincount(corners.ravel(), np.repeat(weight, 3), len(observations))
        worst = int(np.lexsort((observations.matches, -balance))[0])
        if balance[worst] <= 0:
            closed = corners[alive & (bad == 0)]
            return suspect, np.bincount(closed.ravel(), minlength=len(observations)).astype(np.intp)
        suspect[worst] = True
        alive &= ~(corners == worst).any(axis=1)


def _open_triangles(apart: BundleAdjustmentResult, observations: Observations, corners: IntArray) -> FloatArray:
    """1 for triangles that do not close, 0 for those that do, NaN where the points leave the images; shape (T,)."""
    backward = observations.image1 > observations.image2
    homographies, covariance = _oriented(apart, backward)
    distortion, higher, center = split_lens(apart.parameters.lens)
    probes = [
        _probes(observations, link, bool(backward[link])) for link in range(len(observations))
    ]  # in the image of lower index
    points = np.stack([probes[link] for link in corners[:, 0]]).reshape(-1, 2) - center
    ij, jk, ik = (np.repeat(corner, _PROBES) for corner in corners.T)
    first = transfer_jacobian(homographies[ij], distortion, points, higher)
    second = transfer_jacobian(homographies[jk], distortion, first.points, higher)
    direct = transfer_jacobian(homographies[ik], distortion, points, higher)
    error = second.points - direct.points

    def spread(by: FloatArray, links: IntArray) -> FloatArray:
        return by @ covariance[links] @ np.swapaxes(by, -1, -2)

    total = (
        second.by_point @ spread(first.by_homography, ij) @ np.swapaxes(second.by_point, -1, -2)
        + spread(second.by_homography, jk)
        + spread(direct.by_homography, ik)
    )
    size = np.linalg.norm(error, axis=1).reshape(-1, _PROBES)
    deviation = np.sqrt(np.einsum("...ii->...", total) / 2.0).reshape(-1, _PROBES) + 1e-9
    visible = np.isfinite(size) & (np.abs(second.points).max(axis=1).reshape(-1, _PROBES) < 1.5)
    normalized = np.where(visible, size / deviation, np.nan)
    seen = visible.sum(axis=1) >= 2
    result = np.full(len(corners), np.nan)
    if not seen.any():
        return result
    middle = np.nanmedian(normalized[seen], axis=1)
    absolute = np.nanmedian(np.where(visible, size, np.nan)[seen], axis=1)
    usual = max(1.0, _usual_misclosure(middle, corners[seen], observations))
    result[seen] = (middle > 8.0 * usual) & (absolute > _MIN_ERROR)
    return result


def _usual_misclosure(misclosure: FloatArray, corners: IntArray, observations: Observations) -> float:
    """The lower quartile of the triangles (T,) with a link, as half of the matches have it.

    Not that of all triangles: each wrong link between images far apart opens many.
    """
    links = corners.ravel()
    counts = np.bincount(links, minlength=len(observations))
    values = np.repeat(misclosure, 3)
    ordered = np.append(values[np.lexsort((values, links))], np.inf)
    quartile = ordered[np.cumsum(counts) - counts + np.maximum(counts - 1, 0) // 4]
    return _weighted_median(quartile, np.where(counts > 0, observations.matches, 0))


def _probes(observations: Observations, link: int, backward: bool) -> FloatArray:
    """Points of a link in its image of lower index, shape (:data:`_PROBES`, 2), repeated where there are few."""
    rows = slice(observations.start[link], observations.start[link + 1])
    points = (observations.points2 if backward else observations.points1)[rows]
    return np.resize(points[spread_choice(points, _PROBES)], (_PROBES, 2))


def _oriented(apart: BundleAdjustmentResult, backward: BoolArray) -> tuple[FloatArray, FloatArray]:
    """Homographies (L, 3, 3) from the image of lower index to the other, and their covariances (L, 9, 9)."""
    # What is no homography gets any value: its triangles do not count.
    sound = are_homographies(apart.homographies)[:, None, None]
    homographies = np.where(sound, apart.homographies, np.eye(3))
    values, vectors = np.linalg.eigh(np.where(sound, apart.equations.gram[:, :9, :9] / apart.sigma**2, np.eye(9)))
    floor = np.maximum(values[:, -1:] * 1e-12, 1e-300)
    inverse = 1.0 / np.maximum(values, floor)
    inverse[:, 0] = 0.0  # the scale of H, of which nothing depends
    covariance = (vectors * inverse[:, None, :]) @ np.swapaxes(vectors, 1, 2)
    inverted = inverses(homographies)
    # d(H⁻¹) = -H⁻¹ dH H⁻¹, row by row
    change = np.einsum("lia,lbj->lijab", inverted, inverted).reshape(-1, 9, 9)
    turned = change @ covariance @ np.swapaxes(change, 1, 2)
    side = backward[:, None, None]
    return np.where(side, inverted, homographies), np.where(side, turned, covariance)


def misfitting_links(squared: FloatArray, observations: Observations) -> BoolArray:
    """Links whose errors after the adjustment are far beyond those of the others, shape (L,).

    A model that is too rigid leaves larger errors in all links; a wrong pair stands out. What is usual is what half of
    the matches have, not half of the links: many pairs far apart may show a vehicle only, with few matches each.
    """
    typical = link_medians(squared, observations)
    usual = _weighted_median(typical, np.where(np.isfinite(typical), observations.matches, 0))
    least = _MIN_ERROR * np.sqrt(observations.scale1 * observations.scale2)
    outlying: BoolArray = ~(typical <= np.maximum(8.0 * usual, least))
    return outlying


def link_medians(squared: FloatArray, observations: Observations) -> FloatArray:
    """Median length of the errors of each link, pixels, shape (L,)."""
    return observations.medians(np.sqrt(squared))


def _weighted_median(values: FloatArray, weights: IntArray) -> float:
    """The smallest of the values (L,) up to which half of the weights lie; 0 where all weights are."""
    order = np.argsort(values)
    total = np.cumsum(weights[order])
    return float(values[order[np.searchsorted(total, total[-1] / 2.0)]]) if total[-1] > 0 else 0.0
