"""Whether images are aligned locally, and how: decided by matches that are held out of the fit."""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from rdstitch.arrays import FloatArray
from rdstitch.geometry.camera import Camera
from rdstitch.local_alignment.field import DisplacementField
from rdstitch.local_alignment.fit import PlacedFields, Stiffness, fit_fields
from rdstitch.local_alignment.matches import ImagesOnSurface, Match, PlacedMatches, place_matches

LocalAlignmentMode = Literal["auto", "off"] | int

MAX_CELLS = 100
_CELLS = 12
# Of the grids of all images together: of more than some 800 images the cells are larger, to bound memory.
_MAX_NODES = 120_000
# The stiffest fields first: they are taken unless freer ones are better by a share that matters.
_SLOPES = (0.02, 0.06, 0.2)
_HELD_OUT = 5  # every fifth match
# Share by which held-out residuals must get smaller for local alignment to be worth while, and for freer fields.
_WORTHWHILE, _BETTER = 0.15, 0.03
_MIN_MATCHES = 60  # of 60 planes with so many matches and noise, none was bent; with 40, five were
# Of thousands of images, fields are fitted to a part: each match takes about 600 bytes meanwhile.
_MAX_MATCHES = 250_000
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
        """From residuals (M, D)."""
        length = np.linalg.norm(residual, axis=1)
        return cls(float(np.median(length)), float(np.percentile(length, 95)))


@dataclass(frozen=True)
class LocalAlignment:
    """What local alignment found."""

    fields: tuple[DisplacementField, ...]  # one an image; empty where images are not aligned locally
    reason: str  # why they are, or are not
    cells: int = 0  # of the grid along the longer side of an image; 0 without fields
    # before, after: residuals of held-out matches without and with fields; None where nothing was tried
    before: HeldOut | None = None
    after: HeldOut | None = None


def no_local_alignment(reason: str) -> LocalAlignment:
    """Images stay where the alignment puts them."""
    return LocalAlignment((), reason)


def align_locally(
    matches: Sequence[Match],
    cameras: Sequence[Camera],
    homographies: FloatArray,
    choice: LocalAlignmentMode = "auto",
    *,
    on_sphere: bool = False,
) -> LocalAlignment:
    """Smooth displacement fields that bring matches of overlapping images together.

    Parameters
    ----------
    matches : sequence of Match
        Putative matches of all pairs, right and wrong; ``image1`` and ``image2`` count the cameras.
    homographies : ndarray of shape (N, 3, 3)
        Undistorted coordinates, in half diagonals, to the plane, or to directions.
    choice : "auto", "off" or int
        "auto": only where matches that are held out of the fit come nearer by 15 % or more. A number: always, with so
        many cells along the longer side of an image.
    on_sphere : bool
        Whether the camera turned on the spot, so that ``homographies`` lead to directions.
    """
    if choice == "off":
        return no_local_alignment("switched off")
    images = ImagesOnSurface.of(cameras, homographies, on_sphere=on_sphere)
    # Pair by pair, again and again: together, the matches of thousands of images are what takes memory.
    lengths = [np.linalg.norm(pair.residual, axis=1) for pair in place_matches(matches, images)]
    count = sum(map(len, lengths))
    if count < _MIN_MATCHES:
        return no_local_alignment("there are too few matches")
    if choice == "auto":
        most = _OUTLYING * float(np.median(np.concatenate(lengths)))
        if (agreement := _agreement_of_neighbours(place_matches(matches, images), most)) < _MIN_AGREEMENT:
            return no_local_alignment(
                f"not worth while; residuals of neighbouring matches agree by {agreement:.0%} only"
            )
    share = min(1.0, _MAX_MATCHES / count)
    placed = PlacedMatches.join(pair.thinned(share) for pair in place_matches(matches, images))
    cells = max(2, min(_CELLS, math.isqrt(_MAX_NODES // len(cameras)))) if choice == "auto" else choice
    held_out = np.arange(len(placed)) % _HELD_OUT == 0
    start, before, after = _choose(placed.take(~held_out), placed.take(held_out), images, cells)
    text = f"matches held out of the fit: {before.median:.2f} pixels apart without, {after.median:.2f} pixels with it"
    if choice == "auto" and after.median > (1.0 - _WORTHWHILE) * before.median:
        return LocalAlignment((), f"not worth while; {text}", 0, before, after)
    fields = fit_fields(placed, images, start.stiffness, start).of_images()
    return LocalAlignment(fields, text, cells, before, after)


def _agreement_of_neighbours(pairs: Iterable[PlacedMatches], most: float) -> float:
    """Correlation of the residuals of each match and the nearest one of the same pair of images, in [-1, 1].

    Residuals that are longer than ``most`` count as if they were so long.
    """
    common = total = 0.0
    for pair in pairs:
        length = np.linalg.norm(pair.residual, axis=1)
        residual = pair.residual * np.minimum(1.0, most / np.maximum(length, 1e-12))[:, None]
        common += float((residual * residual[pair.neighbours]).sum())
        total += float((residual**2).sum())
    return common / max(total, 1e-300)


def _choose(
    fitted: PlacedMatches, held_out: PlacedMatches, images: ImagesOnSurface, cells: int
) -> tuple[PlacedFields, HeldOut, HeldOut]:
    """The fields that held-out matches like best, and the residuals of these without and with them."""
    tried: list[PlacedFields] = []
    for slope in reversed(_SLOPES):
        # What is far from the plane is found by the freest; the stiffer ones start from there.
        tried.append(fit_fields(fitted, images, Stiffness(cells, slope), tried[-1] if tried else None))
    stiffest, *freer = [(fields, HeldOut.of(fields.explain(held_out)[0])) for fields in reversed(tried)]
    best, after = stiffest
    for fields, residuals in freer:
        if residuals.median < (1.0 - _BETTER) * after.median:
            best, after = fields, residuals
    return best, HeldOut.of(held_out.residual), after
