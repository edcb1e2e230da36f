"""What two tiles should have in common, cut into blocks."""

from dataclasses import dataclass

import numpy as np

from rdstitch.arrays import FloatArray, IntArray

_BLOCKS = 8  # blocks along a side of a tile: a lens that bends the overlap hardly bends one of them
_MIN_BLOCK_SIDE = 40  # pixels, from which on a block has enough independent ones for its displacement to be sure


def _count(length: int, side: int) -> int:
    """Blocks along a length on a tile of a side."""
    return max(1, min(round(length / side * _BLOCKS), length // _MIN_BLOCK_SIDE))


@dataclass(frozen=True, eq=False)
class Overlap:
    """Two tiles and what they should have in common."""

    offset: IntArray  # (2,), int: expected place of the second in the first, pixels
    blocks: IntArray  # (K, 4), int: boxes x0, y0, x1, y1 in the first tile, end exclusive

    @classmethod
    def expected(cls, offset: FloatArray, sizes: IntArray, least: int) -> "Overlap":
        """The overlap of two tiles, the second at an offset in the first.

        ``sizes`` (2, 2) are their widths and heights; it is ``least`` pixels wide.
        """
        side = sizes[0]
        whole = np.rint(offset).astype(np.intp)
        low, high = np.maximum(0, whole), np.minimum(side, sizes[1] + whole)
        lacking = np.maximum(0, least - (high - low))
        # Of the second tile so much is expected beyond the border of the first.
        low, high = low - np.where(whole > 0, lacking, 0), high + np.where(whole > 0, 0, lacking)
        along = int(np.argmax(high - low))
        count = _count(int((high - low)[along]), int(side[along]))
        edges = np.rint(np.linspace(low[along], high[along], count + 1)).astype(np.intp)
        blocks = np.empty((count, 4), dtype=np.intp)
        blocks[:, :2], blocks[:, 2:] = low, high
        blocks[:, along], blocks[:, 2 + along] = edges[:-1], edges[1:]
        return cls(whole, blocks)

    @property
    def whole(self) -> IntArray:
        """All blocks as one, (1, 4)."""
        return np.concatenate([self.blocks[:, :2].min(axis=0), self.blocks[:, 2:].max(axis=0)])[None]

    @property
    def centers(self) -> FloatArray:
        """Middle of each block in the first tile, pixels (K, 2)."""
        return np.asarray((self.blocks[:, :2] + self.blocks[:, 2:] - 1) / 2.0)

    def cells(self, size: tuple[int, int]) -> IntArray:
        """The blocks cut across too where the overlap is wide, (L, 4), and every other one then, as on a chessboard."""
        parts = []
        for row, (x0, y0, x1, y1) in enumerate(self.blocks.tolist()):
            across, down = (_count(b - a, n) for a, b, n in ((x0, x1, size[0]), (y0, y1, size[1])))
            x, y = np.rint(np.linspace(x0, x1, across + 1)), np.rint(np.linspace(y0, y1, down + 1))
            cut = [(i, k) for k in range(down) for i in range(across) if across * down == 1 or (i + k + row) % 2]
            parts += [(x[i], y[k], x[i + 1], y[k + 1]) for i, k in cut]
        return np.array(parts, dtype=np.intp)
