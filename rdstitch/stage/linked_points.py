"""What pairs of tiles show: matches of the blocks of their overlaps."""

from collections.abc import Mapping

import numpy as np

from rdstitch.arrays import BoolArray, FloatArray, IntArray
from rdstitch.stage.refinement import BlockMatches
from rdstitch.system.dataclasses import dataclass


@dataclass(frozen=True, eq=False)
class LinkedPoints:
    """Matches of all pairs, block by block."""

    pair: IntArray  # (M,), int: pair of each block
    tiles: IntArray  # (P, 2), int: tiles of each pair
    points1: FloatArray  # points1, points2: (M, 2): measured pixels of the two tiles
    points2: FloatArray
    information: FloatArray  # (M, 2, 2)

    @classmethod
    def of(cls, pairs: IntArray, matches: Mapping[int, BlockMatches]) -> "LinkedPoints":
        """The matches of those of the pairs (Q, 2) that have any, by the number of the pair."""
        blocks = [BlockMatches.none(), *matches.values()]
        return cls(
            np.repeat(np.arange(-1, len(matches)), [len(match) for match in blocks]),
            pairs[list(matches)],
            np.concatenate([match.points1 for match in blocks]),
            np.concatenate([match.points2 for match in blocks]),
            np.concatenate([match.information for match in blocks]),
        )

    def of_pairs(self, wanted: BoolArray) -> "LinkedPoints":
        """The matches of some of the pairs (P,)."""
        kept = wanted[self.pair]
        number = np.cumsum(wanted) - 1
        parts = (values[kept] for values in (self.points1, self.points2, self.information))
        return LinkedPoints(number[self.pair[kept]], self.tiles[wanted], *parts)

    def medians(self, values: FloatArray) -> FloatArray:
        """Medians (P,) over the blocks of each pair: of a wrong one all are off, of a right one a few may be."""
        order = np.lexsort([values, self.pair])
        number = np.bincount(self.pair, minlength=len(self.tiles))
        middle = np.cumsum(number) - number + (number - 1) // 2
        return np.asarray(values[order][middle] if len(values) else np.zeros(0))
