"""Which part of each picture the tiles of an output request, so that no more of it need be held, nor for longer."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray

from rdstitch.compositing.boxes import Box
from rdstitch.compositing.source_images import NOTHING


@dataclass(frozen=True)
class RequestedParts:
    """What is requested of the pictures, by rows of tiles.

    Attributes
    ----------
    count : int
        Pictures.
    rows : ndarray of shape (K,), int
        Number of a row of tiles, ...
    pictures : ndarray of shape (K,), int
        ... a picture that it shows, ...
    parts : ndarray of shape (K, 4), int
        ... and what of it one of the row's tiles takes, pixels of the picture: x0, y0, x1, y1, end exclusive.
    """

    count: int
    rows: NDArray[np.intp]
    pictures: NDArray[np.intp]
    parts: NDArray[np.intp]

    @classmethod
    def of(cls, count: int, rows: Iterable[Sequence[tuple[int, Box]]]) -> Self:
        """From the pictures and parts that each row of tiles takes."""
        found = [(row, index, *part) for row, taken in enumerate(rows) for index, part in taken]
        table = np.array(found, dtype=np.intp).reshape(-1, 6)
        return cls(count, table[:, 0], table[:, 1], table[:, 2:])

    def on_row(self, row: int) -> set[int]:
        """Pictures that a row of tiles shows."""
        return set(self.pictures[self.rows == row].tolist())

    def from_row(self, row: int) -> list[Box]:
        """What is needed of each picture for a row of tiles and those below."""
        due = self.rows >= row
        low, high = np.full((self.count, 2), np.iinfo(np.intp).max), np.zeros((self.count, 2), dtype=np.intp)
        np.minimum.at(low, self.pictures[due], self.parts[due, :2])
        np.maximum.at(high, self.pictures[due], self.parts[due, 2:])
        return [(*a, *b) if b[0] else NOTHING for a, b in zip(low.tolist(), high.tolist(), strict=True)]
