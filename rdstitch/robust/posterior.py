"""One comparison of hypotheses: the model of a pair, the lens, the motion of all images, whole pixels.

``cost = -2 log L(errors) - 2 log p(camera) + cost of freedom``, the smaller the better: how likely the errors are, how
far the camera is off from what cameras are, and what the parameters cost: ``log n`` each by so many independent
observations (Schwarz's approximation).

Errors are noise of the keypoints, and parts that neighbours share: depth, relief, or a lens of another kind move all
points of a part of an overlap together. The errors ``e`` of a link are therefore taken as ``noise + field``, the field
being piecewise constant on two grids over the overlap: blocks of a quarter of it, and cells of a sixteenth. The noise
belongs to the keypoints; how large the two parts of the field are belongs to the hypothesis, and is what makes its
cost least, that of freedom included. Where the field is larger than the noise, a cell is one observation, however
many matches it has: a freer model does not win by fitting relief a little better.

Up to constants, with ``m_c`` the mean error of a cell of ``n_c`` matches, ``v_c = τ₂² + σ²/n_c``, and ``M_b`` and
``1/W_b`` the mean and variance of a block by its cells,

``-2 log L = Σ_c 2 log v_c + |m_c|²/v_c + Σ_b 2 log(1 + W_b τ₁²) - τ₁² W_b² |M_b|² / (1 + W_b τ₁²)``.

The priors are those of :mod:`rdstitch.robust.priors`.
"""

from dataclasses import dataclass
from typing import Self

import numpy as np

from rdstitch.arrays import FloatArray, IntArray

MODEL_ERROR = 0.1
"""Pixels: how exactly a lens and a plane can be described at all; smaller errors do not tell hypotheses apart."""

_SIDE = 4  # cells along each side of an overlap; blocks have half as many
_FARTHEST = 0.02  # half diagonals: errors beyond count as this; a link that is off by less is no wrong pair
_SIZES = 14  # sizes of each part of the field that are tried, from MODEL_ERROR to the farthest error


def overlap_cells(link: IntArray, points: FloatArray, count: int, side: int) -> tuple[IntArray, IntArray]:
    """Column and row (M,) of each point (M, 2) among ``side`` cells a side of the overlap of its link, of ``count``."""
    low, high = np.full((count, 2), np.inf), np.full((count, 2), -np.inf)
    np.minimum.at(low, link, points)
    np.maximum.at(high, link, points)
    place = (points - low[link]) / np.maximum(high - low, 1e-12)[link]
    x, y = np.minimum((place * side).astype(np.intp), side - 1).T
    return x, y


@dataclass(frozen=True, eq=False)
class Evidence:
    """Cells of the overlaps of links, by which hypotheses on the same matches are compared, for G problems at once."""

    cell: IntArray  # (M,): of each match
    block: IntArray  # (C,): of each cell
    group: IntArray  # (K,): problem of each block
    counts: FloatArray  # (C,): matches in each cell
    noise: FloatArray  # (G,): standard deviation of a coordinate of a keypoint's error, pixels
    farthest: FloatArray  # (G,): pixels that an error counts as at most
    weight: FloatArray  # (G,): independent links over links: every link measures the same keypoints again

    @classmethod
    def of(
        cls,
        link: IntArray,
        points: FloatArray,
        group: IntArray,
        noise: FloatArray,
        scale: FloatArray,
        weight: FloatArray | None = None,
    ) -> Self:
        """Divide the overlaps: by the link (M,) of each match and its point (M, 2), and the problem of each link (L,).

        ``noise``, half diagonals ``scale`` in pixels, and ``weight`` are those of each problem.
        """
        x, y = overlap_cells(link, points, len(group), _SIDE)
        numbers, cell = np.unique((link * _SIDE + x) * _SIDE + y, return_inverse=True)
        in_link, x, y = numbers // _SIDE**2, numbers // _SIDE % _SIDE // 2, numbers % _SIDE // 2
        blocks, block = np.unique((in_link * 2 + x) * 2 + y, return_inverse=True)
        return cls(
            cell,
            block,
            group[blocks // 4],
            np.bincount(cell).astype(np.float64),
            np.maximum(noise, MODEL_ERROR),
            farthest_error(scale),
            np.ones(len(noise)) if weight is None else weight,
        )

    def cost(self, errors: FloatArray, parameters: int, priors: FloatArray | float = 0.0) -> FloatArray:
        """-2 log of the posterior of a hypothesis on each problem (G,), up to a constant of the problem.

        By the errors (M, 2), pixels, that so many parameters leave, and what these cost by their priors (G,).
        """
        return self._with_likeliest_field(errors, parameters)[0] + priors

    def field(self, errors: FloatArray) -> FloatArray:
        """Size of what neighbours share of errors (M, 2), pixels of a coordinate, (G,), whatever freedom costs."""
        return self._with_likeliest_field(errors, 0)[1]

    def _with_likeliest_field(self, errors: FloatArray, parameters: int) -> tuple[FloatArray, FloatArray]:
        """What errors and parameters cost with the fields that make that least, and how large these are."""
        group, groups = self.group[self.block], len(self.noise)
        length, farthest = np.linalg.norm(errors, axis=1), self.farthest[group[self.cell]]
        with np.errstate(invalid="ignore", divide="ignore"):
            kept = np.where(length > farthest, farthest / length, 1.0)[:, None] * errors
        kept = np.where(np.isfinite(kept), kept, (farthest / np.sqrt(2.0))[:, None])
        sums = np.stack([np.bincount(self.cell, axis, len(self.counts)) for axis in kept.T], axis=1)
        mean = sums / self.counts[:, None]
        squared = np.einsum("ck,ck->c", mean, mean)
        sizes = np.geomspace(MODEL_ERROR, np.maximum(self.farthest, 2.0 * MODEL_ERROR), _SIZES)
        coarse = np.concatenate([np.zeros((1, groups)), sizes])
        tried = list[tuple[FloatArray, FloatArray]]()
        for fine in sizes:
            # A cell's mean error has the variance of its noise and of its own field; blocks of cells share another one.
            variance = (fine**2)[group] + (self.noise**2)[group] / self.counts
            information = np.bincount(self.block, 1.0 / variance)
            weighted = np.stack([np.bincount(self.block, axis / variance) for axis in mean.T], axis=1)
            power = np.einsum("bk,bk->b", weighted, weighted)
            shared = coarse[:, self.group] ** 2
            grown = 1.0 + information * shared
            of_blocks = 2.0 * np.log(grown) - shared * power / grown
            # Of normal variables: log det Σ + r' Σ⁻¹ r, by cells with the blocks' fields taken out (Woodbury).
            of_cells = np.bincount(group, 2.0 * np.log(variance) + squared / variance, groups)
            fields = np.hypot(fine, coarse)
            # Independent coordinates: the information that is left, in units of what one coordinate would have. All
            # where there is noise only, a pair of them a cell or block where the field is large.
            left = np.stack([np.bincount(self.group, each, groups) for each in information / grown])
            counts = np.maximum(2.0 * self.weight * (fields**2 + self.noise**2) * left, 2.0)
            costs = np.stack([np.bincount(self.group, each, groups) for each in of_blocks])
            costs = self.weight * (of_cells + costs) + parameters * np.log(counts)
            tried.append((costs, fields))
        costs, fields = map(np.concatenate, zip(*tried, strict=True))
        least = np.argmin(costs, axis=0), np.arange(groups)
        return costs[least], fields[least]


def farthest_error(scale: FloatArray) -> FloatArray:
    """Pixels that an error counts as at most, by half the diagonal of the images (G,), pixels."""
    return _FARTHEST * scale
