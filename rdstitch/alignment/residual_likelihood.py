"""How likely the errors of a hypothesis are: noise of the keypoints, and parts that neighbours share.

Depth, relief, or a lens of another kind move all points of a part of an overlap together. The errors ``e`` of a link
are therefore taken as ``noise + field``, the field being piecewise constant on two grids over the overlap: blocks of a
quarter of it, and cells of a sixteenth. The noise belongs to the keypoints; how large the two parts of the field are
belongs to the hypothesis, and is what makes its errors most likely. Where the field is larger than the noise, a cell is
one observation, however many matches it has: a freer model does not win by fitting relief a little better.

Up to constants, with ``m_c`` the mean error of a cell of ``n_c`` matches, ``v_c = τ₂² + σ²/n_c``, and ``M_b`` and
``1/W_b`` the mean and variance of a block by its cells,

``-2 log L = Σ_c 2 log v_c + |m_c|²/v_c + Σ_b 2 log(1 + W_b τ₁²) - τ₁² W_b² |M_b|² / (1 + W_b τ₁²)``.
"""

from dataclasses import dataclass
from typing import Self

import numpy as np

from rdstitch.alignment.bundle_adjustment import sigma_of
from rdstitch.alignment.link_equations import squared_lengths
from rdstitch.alignment.noise import EXACTNESS, coherence
from rdstitch.alignment.observations import Observations
from rdstitch.arrays import FloatArray, IntArray
from rdstitch.robust.loss import ALIGNMENT_WIDTH

_SIDE = 4
"""Cells along each side of an overlap; blocks have half as many."""

_FARTHEST = 0.02
"""Half diagonals: errors beyond count as this; a link that is off by less is no wrong pair."""

_SIZES = 14
"""Sizes of each part of the field that are tried, from :data:`EXACTNESS` to :data:`_FARTHEST`."""


@dataclass(frozen=True)
class Evidence:
    """Cells of the overlaps of all links, by which hypotheses on the same observations are compared."""

    cell: IntArray  # cell, block: (M,) and (C,): the cell of each correspondence, and the block of each cell
    block: IntArray
    counts: FloatArray  # (C,): correspondences in each cell
    noise: float  # standard deviation of a coordinate of a keypoint's error, pixels
    farthest: float  # pixels that an error counts as at most
    weight: float  # independent links over links: every link measures the same keypoints again

    @classmethod
    def of(cls, observations: Observations, errors: FloatArray) -> Self:
        """Divide the overlaps, and find the noise from the errors (M, 2) of links fitted on their own, pixels."""
        link, points = observations.link, observations.points1
        low, high = np.full((len(observations), 2), np.inf), np.full((len(observations), 2), -np.inf)
        np.minimum.at(low, link, points)
        np.maximum.at(high, link, points)
        place = (points - low[link]) / np.maximum(high - low, 1e-12)[link]
        x, y = np.minimum((place * _SIDE).astype(np.intp), _SIDE - 1).T
        numbers, cell = np.unique((link * _SIDE + x) * _SIDE + y, return_inverse=True)
        in_link, x, y = numbers // _SIDE**2, numbers // _SIDE % _SIDE // 2, numbers % _SIDE // 2
        _, block = np.unique((in_link * 2 + x) * 2 + y, return_inverse=True)
        squared = squared_lengths(errors)
        inliers = squared <= (ALIGNMENT_WIDTH * sigma_of(squared[observations.scale_inliers_mask])) ** 2
        shared = min(max(coherence(observations, errors, inliers).correlation, 0.0), 0.9)
        power = float(squared[inliers].mean()) / 2.0 if inliers.any() else 0.0
        images = len(np.unique([observations.image1, observations.image2]))
        return cls(
            cell,
            block,
            np.bincount(cell).astype(np.float64),
            max(np.sqrt(power * (1.0 - shared)), EXACTNESS),
            _FARTHEST * float(np.median(observations.scale2)),
            min(1.0, (images - 1) / max(len(observations), 1)),
        )

    def cost(self, errors: FloatArray) -> "ErrorCost":
        """Return how likely errors (M, 2), pixels, are with the fields that make them most likely."""
        length = np.linalg.norm(errors, axis=1)
        with np.errstate(invalid="ignore", divide="ignore"):
            kept = np.where(length > self.farthest, self.farthest / length, 1.0)[:, None] * errors
        kept = np.where(np.isfinite(kept), kept, self.farthest / np.sqrt(2.0))
        sums = np.stack([np.bincount(self.cell, axis, len(self.counts)) for axis in kept.T], axis=1)
        mean = sums / self.counts[:, None]
        squared = np.einsum("ck,ck->c", mean, mean)
        sizes = np.geomspace(EXACTNESS, max(self.farthest, 2.0 * EXACTNESS), _SIZES)
        coarse = np.concatenate([[0.0], sizes])[:, None]
        best = ErrorCost(np.inf, 0.0, 2.0)
        for fine in sizes:
            variance = fine**2 + self.noise**2 / self.counts
            information = np.bincount(self.block, 1.0 / variance)
            weighted = np.stack([np.bincount(self.block, axis / variance) for axis in mean.T], axis=1)
            power = np.einsum("bk,bk->b", weighted, weighted)
            grown = 1.0 + information * coarse**2
            costs = (2.0 * np.log(grown) - coarse**2 * power / grown).sum(axis=1)
            index = int(np.argmin(costs))
            cost = self.weight * float((2.0 * np.log(variance) + squared / variance).sum() + costs[index])
            if cost < best.cost:
                field = float(np.hypot(fine, coarse[index, 0]))
                count = 2.0 * self.weight * (field**2 + self.noise**2) * float((information / grown[index]).sum())
                best = ErrorCost(cost, field, max(count, 2.0))
        return best


@dataclass(frozen=True)
class ErrorCost:
    """What errors say of a hypothesis."""

    cost: float  # -2 log of their likelihood, up to a constant
    field: float  # size of what neighbours share, pixels of a coordinate
    # independent coordinates: all where there is noise only, a pair of them a cell or block where the field is large
    count: float
