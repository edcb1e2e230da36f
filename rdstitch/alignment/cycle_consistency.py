"""Wrong pairs: links that fit well on their own but contradict the others (repeated structure).

Before the adjustment, links are judged in triangles: the composition of three transfers must
be the identity, within what the links' covariances allow. After it, by the errors that the adjustment leaves them.
"""

import numpy as np
from numpy.typing import NDArray

from rdstitch.alignment.least_squares.bundle_adjustment import BundleAdjustmentResult
from rdstitch.alignment.least_squares.link_equations import split_lens
from rdstitch.alignment.least_squares.observations import Observations
from rdstitch.arrays import BoolArray, FloatArray, IntArray
from rdstitch.geometry.radial_homography import are_homographies, inverses, transfer_jacobian
from rdstitch.matching.links import grid_subsample

_PROBES = 6  # points of a link that are transferred round each triangle

_MAX_TRIANGLES = 20_000  # triangles of all links that are looked at, or more where there are many links
_TRIANGLES_PER_LINK = 2  # triangles a link then; each has three links, so that six are looked at of each
_TRIANGLES_AT_ONCE = 4096

_OUTLYING = 8.0  # times what is usual from which on a triangle does not close, and a link does not fit

_VISIBLE = 1.5  # half diagonals from the middle up to which a transferred probe counts
_MIN_VISIBLE = 2  # such probes of a triangle at least
_MIN_ERROR = 0.02  # half diagonals: a link that is off by less is no wrong pair


def triangles(count: int, image1: IntArray, image2: IntArray) -> IntArray:
    """Links (T, 3) of all triangles i < j < k of the graph, in the order ij, jk, ik.

    Of very many, a random part, and one of each link that has any.
    """
    low, high = np.minimum(image1, image2), np.maximum(image1, image2)
    key = low * count + high
    order = np.argsort(key)
    # Each link to j with the links to k that follow it among those from the same image i.
    last = np.searchsorted(low[order], np.arange(count), side="right")[low[order]]
    following = last - np.arange(len(order)) - 1
    ij = np.repeat(np.arange(len(order)), following)
    ik = np.arange(len(ij)) - np.repeat(np.cumsum(following) - following, following) + ij + 1
    wanted = high[order[ij]] * count + high[order[ik]]
    jk = np.searchsorted(key, wanted, sorter=order).clip(max=max(len(order) - 1, 0))
    closed = key[order[jk]] == wanted
    result = np.stack([order[place[closed]] for place in (ij, jk, ik)], axis=1)
    limit = max(_MAX_TRIANGLES, _TRIANGLES_PER_LINK * len(low))
    if len(result) <= limit:
        return result
    kept = np.zeros(len(result), dtype=np.bool_)
    kept[np.random.default_rng(0).choice(len(result), limit, replace=False)] = True
    links, first = np.unique(result, return_index=True)
    kept[first[~np.isin(links, result[kept])] // 3] = True
    return result[kept]


def cycle_consistency(
    pairwise: BundleAdjustmentResult, observations: Observations, count: int
) -> tuple[BoolArray, NDArray[np.intp]]:
    """Which links most of their triangles contradict.

    What ran away and is no homography is suspect. One after the other, the link with the most contradictions is taken
    out together with its triangles, until every link left is confirmed at least as often as it is contradicted.
    Takes every link on its own, with a homography, and the number of images; also gives how many of the triangles left
    with each link close, (L,).
    """
    suspect = ~are_homographies(pairwise.homographies)
    corners = triangles(count, observations.image1, observations.image2)
    if not len(corners):
        return suspect, np.zeros(len(observations), dtype=np.intp)
    is_open = _open_triangles(pairwise, observations, corners)
    alive = np.isfinite(is_open) & ~suspect[corners].any(axis=1)
    while True:
        weight = np.where(alive, np.where(is_open > 0, 1.0, -1.0), 0.0)
        balance = np.bincount(corners.ravel(), np.repeat(weight, 3), len(observations))
        worst = int(np.lexsort((observations.matches, -balance))[0])
        if balance[worst] <= 0:
            closed = corners[alive & (is_open == 0)]
            return suspect, np.bincount(closed.ravel(), minlength=len(observations)).astype(np.intp)
        suspect[worst] = True
        alive &= ~(corners == worst).any(axis=1)


def _open_triangles(pairwise: BundleAdjustmentResult, observations: Observations, corners: IntArray) -> FloatArray:
    """1 for triangles that do not close, 0 for those that do, NaN where the points leave the images; shape (T,)."""
    backward = observations.image1 > observations.image2
    homographies, covariance = _oriented(pairwise, backward)
    distortion, higher, center = split_lens(pairwise.parameters.lens)
    # In the image of lower index.
    probes = np.stack([_probes(observations, link, bool(backward[link])) for link in range(len(observations))])

    def spread(by: FloatArray, links: IntArray) -> FloatArray:
        return by @ covariance[links] @ np.swapaxes(by, -1, -2)

    def misclosures(corners: IntArray) -> tuple[FloatArray, FloatArray]:
        """How far each probe of some triangles is off, in standard deviations and half diagonals; NaN outside."""
        points = probes[corners[:, 0]].reshape(-1, 2) - center
        ij, jk, ik = (np.repeat(corner, _PROBES) for corner in corners.T)
        first = transfer_jacobian(homographies[ij], distortion, points, higher)
        second = transfer_jacobian(homographies[jk], distortion, first.points, higher)
        direct = transfer_jacobian(homographies[ik], distortion, points, higher)
        total = (
            second.by_point @ spread(first.by_homography, ij) @ np.swapaxes(second.by_point, -1, -2)
            + spread(second.by_homography, jk)
            + spread(direct.by_homography, ik)
        )
        size = np.linalg.norm(second.points - direct.points, axis=1)
        deviation = np.sqrt(np.einsum("...ii->...", total) / 2.0) + 1e-9
        visible = np.isfinite(size) & (np.abs(second.points).max(axis=1) < _VISIBLE)
        normalized, absolute = (np.where(visible, each, np.nan) for each in (size / deviation, size))
        return normalized.reshape(-1, _PROBES), absolute.reshape(-1, _PROBES)

    parts = np.split(corners, np.arange(_TRIANGLES_AT_ONCE, len(corners), _TRIANGLES_AT_ONCE))
    normalized, absolute = (np.concatenate(each) for each in zip(*map(misclosures, parts), strict=True))
    visible_triangles = np.isfinite(normalized).sum(axis=1) >= _MIN_VISIBLE
    result = np.full(len(corners), np.nan)
    if not visible_triangles.any():
        return result
    middle = np.nanmedian(normalized[visible_triangles], axis=1)
    usual = max(1.0, _usual_misclosure(middle, corners[visible_triangles], observations))
    result[visible_triangles] = (middle > _OUTLYING * usual) & (
        np.nanmedian(absolute[visible_triangles], axis=1) > _MIN_ERROR
    )
    return result


def _usual_misclosure(misclosure: FloatArray, corners: IntArray, observations: Observations) -> float:
    """The lower quartile of the triangles (T,) with a link, as half of the matches have it: wrong links open many."""
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
    return np.resize(points[grid_subsample(points, _PROBES)], (_PROBES, 2))


def _oriented(pairwise: BundleAdjustmentResult, backward: BoolArray) -> tuple[FloatArray, FloatArray]:
    """Homographies (L, 3, 3) from the image of lower index to the other, and their covariances (L, 9, 9)."""
    # What is no homography gets any value: its triangles do not count.
    sound = are_homographies(pairwise.homographies)[:, None, None]
    homographies = np.where(sound, pairwise.homographies, np.eye(3))
    values, vectors = np.linalg.eigh(np.where(sound, pairwise.equations.gram[:, :9, :9] / pairwise.sigma**2, np.eye(9)))
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
    typical = observations.medians(np.sqrt(squared))
    usual = _weighted_median(typical, np.where(np.isfinite(typical), observations.matches, 0))
    tolerance = _MIN_ERROR * np.sqrt(observations.scale1 * observations.scale2)
    return ~(typical <= np.maximum(_OUTLYING * usual, tolerance))


def _weighted_median(values: FloatArray, weights: IntArray) -> float:
    """The smallest of the values (L,) up to which half of the weights lie; 0 where all weights are."""
    return float(np.quantile(values, 0.5, weights=weights, method="inverted_cdf")) if weights.any() else 0.0
