"""Whether images are aligned locally, and how: decided by matches that are held out of the fit."""

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Literal

import numpy as np

from rdstitch.arrays import FloatArray, evenly_spaced
from rdstitch.errors import ArgumentError
from rdstitch.geometry.camera import Camera
from rdstitch.local_alignment.field import DisplacementField
from rdstitch.local_alignment.fit import PlacedFields, Stiffness, fit_fields
from rdstitch.local_alignment.ground import fit_ground
from rdstitch.local_alignment.matches import ImagesOnSurface, PlacedMatches, PutativeMatches, place_matches

_COARSE = 12, 120_000  # cells of a grid that finds what is far from the plane; nodes of all images at most
_FINE = 24, 40_000  # the same of the grid that is used: it is coarser for more than some 70 images
_SLOPES = (0.2, 0.06, 0.02)  # see Stiffness
_SLOPES_OF_GROUND = (0.5, 0.2, 0.06)  # one surface for all images, which many matches determine, may be freer
_HELD_OUT = 5  # every fifth track: a keypoint brings its error to all its matches, fitted or not
_WORTHWHILE = 0.15  # fraction by which what a person sees must get less for local alignment to be worth while
_SEAMS = 75.0  # percentile of the held-out residuals: as far as that a person sees edges that do not go on across seams
_BENDS = 98.0  # percentile of the bends of straight edges, of which a person sees a single one
_EDGE = 0.1  # diagonals: length from which on an edge is seen to be straight
_MAX_IMAGES = 24  # whose edges are looked at
_MIN_MATCHES = 60  # of 60 planes with so many matches and noise, none was bent; with 40, five were
_MAX_MATCHES = 250_000  # that fields are fitted to, 600 bytes each: of thousands of images a part
# Correlation of the residuals of neighbouring matches below which no smooth field is worth while: one that brings the
# median down by 15 % takes away a quarter of the variance, and that quarter neighbours would have in common.
_MIN_AGREEMENT = 0.1
_OUTLYING = 3.0  # medians beyond which a residual counts no more than there


@dataclass(frozen=True)
class HeldOut:
    """Residuals of matches that took no part in a fit, pixels of the median image: median and 95 %."""

    median: float
    percentile95: float

    @classmethod
    def of(cls, residual: FloatArray) -> "HeldOut":
        """Percentiles of residuals (M, D)."""
        length = np.linalg.norm(residual, axis=1)
        return cls(float(np.median(length)), float(np.percentile(length, 95)))


@dataclass(frozen=True)
class LocalAlignment:
    """What local alignment found."""

    fields: tuple[DisplacementField, ...]  # one an image; empty where images are not aligned locally
    reason: str  # why they are, or are not
    cells: int = 0  # of the grid along the longer side of an image; 0 without fields
    by_heights: bool = False  # whether it is the ground that is rough, seen from where the cameras are
    before: HeldOut | None = None  # residuals of held-out matches without fields; None where nothing was tried
    after: HeldOut | None = None  # the same with fields


def no_local_alignment(reason: str) -> LocalAlignment:
    """Images stay where the alignment puts them."""
    return LocalAlignment((), reason)


def align_locally(
    matches: Iterable[PutativeMatches],
    cameras: Sequence[Camera],
    homographies: FloatArray,
    choice: Literal["auto"] | int = "auto",
    *,
    pairs: int | None = None,
    on_sphere: bool = False,
    centers: FloatArray | None = None,
    edges: Callable[[list[int]], Iterable[FloatArray]] = lambda images: [np.empty((0, 2, 2)) for _ in images],
) -> LocalAlignment:
    """Smooth displacement fields that bring putative matches of all overlapping images together.

    By ``choice`` "auto" only where matches that are held out of the fit come nearer by more than fields bend what is
    straight, and by 15 % of their distance or more; a number: always, with so many cells along the longer side of an
    image, or fewer where all have too many nodes together.

    ``homographies`` (N, 3, 3) are of undistorted coordinates, in half diagonals, to the plane, or to directions;
    ``pairs``: how many ``matches`` there are, where these come one by one; ``edges`` gives the ends (K, 2, 2) of
    straight edges in each of some images, measured pixels. ``centers`` (N, 3) are where cameras are known to be: below
    each on the plane, and how high above it, in its unit. What heights of the ground explain is not left to fields of
    single images then.
    """
    if choice != "auto" and (type(choice) is not int or choice < 1):
        raise ArgumentError(f"local alignment takes 'auto' or a whole number of cells, at least one, not {choice!r}")
    images = ImagesOnSurface.of(cameras, homographies, on_sphere=on_sphere)
    if pairs is None:
        matches = list(matches)
        pairs = len(matches)
    # As many of each pair as all together may have: the matches of thousands of images are what takes memory.
    placed = PlacedMatches.join(pair.thinned(_MAX_MATCHES // max(pairs, 1)) for pair in place_matches(matches, images))
    if len(placed) < _MIN_MATCHES:
        return no_local_alignment("there are too few matches")
    if choice == "auto" and (agreement := _agreement_of_neighbours(placed)) < _MIN_AGREEMENT:
        return no_local_alignment(f"not worth while; residuals of neighbouring matches agree by {agreement:.0%} only")
    coarse, fine = (max(2, min(cells, math.isqrt(nodes // len(cameras)))) for cells, nodes in (_COARSE, _FINE))
    finest = max(coarse, math.isqrt(_COARSE[1] // len(cameras)))
    cells = max(coarse, fine) if choice == "auto" else min(choice, finest)
    held_out = placed.tracks % _HELD_OUT == _HELD_OUT - 1
    if not held_out.any():
        return no_local_alignment("there are too few tracks of matches")
    fitted, tested = placed.take(~held_out), placed.take(held_out)
    worthwhile = (1.0 - _WORTHWHILE) * _seam_residual(tested.residual)
    limit = worthwhile if choice == "auto" else math.inf
    straight = cache(lambda: _long_edges(edges, cameras))
    base = ground = None
    if centers is not None:
        base, ground = _rough_ground(placed, fitted, tested, images, centers, cells, straight, worthwhile)
    if ground is not None:
        limit = math.inf
    candidates = list(_candidates(fitted, tested, images, min(coarse, cells), cells, base))
    costs = [_seam_residual(left) for _, left in candidates]
    if min(costs) <= limit:
        costs = [cost + _bend(fit.delivered, straight()) for cost, (fit, _) in zip(costs, candidates, strict=True)]
    best, left = candidates[int(np.argmin(costs))]
    before, after = HeldOut.of(tested.residual), HeldOut.of(left)
    text = (
        f"matches that decided, held out of the fit: {before.median:.2f} pixels apart without, {after.median:.2f} with"
    )
    if min(costs) > limit:
        return LocalAlignment((), f"not worth while; {text}", before=before, after=after)
    if ground is not None:
        text += ", mostly by the height of the ground"
    if choice not in ("auto", cells):
        text += f"; a grid of {cells} instead of {choice} cells, the finest that so many images may have"
    final = fit_fields(placed, images, best.stiffness, best, ground)
    return LocalAlignment(final.delivered, text, cells, ground is not None, before, after)


def _rough_ground(
    placed: PlacedMatches,
    fitted: PlacedMatches,
    tested: PlacedMatches,
    images: ImagesOnSurface,
    centers: FloatArray,
    cells: int,
    straight: Callable[[], dict[int, FloatArray]],
    worthwhile: float,
) -> tuple[PlacedFields, PlacedFields] | tuple[None, None]:
    """The freest worthwhile heights of the ground, by matches not held out and by all; None where none are."""
    for slope in _SLOPES_OF_GROUND:
        part = _ground(fitted, images, centers, Stiffness(cells, slope))
        cost = _seam_residual(tested.residual_with(part.delivered, images))
        if cost <= worthwhile:
            # Of all matches, as it is delivered: bends without a fifth of them depend on which fifth it is.
            whole = _ground(placed, images, centers, part.stiffness)
            if cost + _bend(whole.delivered, straight()) <= worthwhile:
                return part, whole
    return None, None


def _ground(matches: PlacedMatches, images: ImagesOnSurface, centers: FloatArray, stiffness: Stiffness) -> PlacedFields:
    """What heights of the ground displace."""
    return fit_ground(matches, images, images.scale * centers, stiffness).fields(images, stiffness)


def _candidates(
    fitted: PlacedMatches,
    tested: PlacedMatches,
    images: ImagesOnSurface,
    coarse: int,
    cells: int,
    base: PlacedFields | None = None,
) -> Iterator[tuple[PlacedFields, FloatArray]]:
    """Fields of each slope on top of others; without, the freest on a coarse grid finds what is far off the plane.

    Each with what it leaves of held-out matches as it would be delivered, (M, D), pixels of the median image.
    """
    fit = base or fit_fields(fitted, images, Stiffness(coarse, _SLOPES[0]))
    for slope in _SLOPES:
        if base or fit.stiffness != Stiffness(cells, slope):
            fit = fit_fields(fitted, images, Stiffness(cells, slope), fit, base)
        yield fit, tested.residual_with(fit.delivered, images)


def _agreement_of_neighbours(matches: PlacedMatches) -> float:
    """Correlation, in [-1, 1], of residuals of each match and the nearest one of its pair, outlying ones shortened."""
    length = np.linalg.norm(matches.residual, axis=1)
    most = _OUTLYING * float(np.median(length))
    residual = matches.residual * np.minimum(1.0, most / np.maximum(length, 1e-12))[:, None]
    return float((residual * residual[matches.neighbours]).sum()) / max(float((residual**2).sum()), 1e-300)


def _seam_residual(residual: FloatArray) -> float:
    """How far edges across seams do not go on, as a percentile of the lengths of residuals (M, D)."""
    return float(np.percentile(np.linalg.norm(residual, axis=1), _SEAMS))


def _long_edges(edges: Callable[[list[int]], Iterable[FloatArray]], cameras: Sequence[Camera]) -> dict[int, FloatArray]:
    """Edges of some images that are long enough to be seen to be straight."""
    chosen = evenly_spaced(len(cameras), _MAX_IMAGES).tolist()
    return {
        k: ends[np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1) > _EDGE * 2.0 * cameras[k].scale]
        for k, ends in zip(chosen, edges(chosen), strict=True)
    }


def _bend(fields: Sequence[DisplacementField], edges: dict[int, FloatArray]) -> float:
    """How far fields bend the edges of some images, as a high percentile; 0 where there are none."""
    bent = np.concatenate([fields[k].bends(ends) for k, ends in edges.items()])
    return float(np.percentile(bent, _BENDS)) if len(bent) else 0.0
