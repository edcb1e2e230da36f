"""Which part of each image the tiles of an output request, so that no more of it need be held, nor for longer."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray

from rdstitch.compositing.boxes import Box
from rdstitch.compositing.source_images import NOTHING


@dataclass(frozen=True)
class RequestedParts:
    """What is requested of the images, by rows of tiles.

    Attributes
    ----------
    count : int
        Images.
    rows : ndarray of shape (K,), int
        Number of a row of tiles, ...
    images : ndarray of shape (K,), int
        ... an image that it shows, ...
    parts : ndarray of shape (K, 4), int
        ... and what of it one of the row's tiles takes, pixels of the image: x0, y0, x1, y1, end exclusive.
    """

    count: int
    rows: NDArray[np.intp]
    images: NDArray[np.intp]
    parts: NDArray[np.intp]

    @classmethod
    def of(cls, count: int, rows: Iterable[Sequence[tuple[int, Box]]]) -> Self:
        """From the images and parts that each row of tiles takes."""
        found = [(row, index, *part) for row, taken in enumerate(rows) for index, part in taken]
        table = np.array(found, dtype=np.intp).reshape(-1, 6)
        return cls(count, table[:, 0], table[:, 1], table[:, 2:])

    def on_row(self, row: int) -> set[int]:
        """Images that a row of tiles shows."""
        return set(self.images[self.rows == row].tolist())

    def from_row(self, row: int) -> list[Box]:
        """What is needed of each image for a row of tiles and those below."""
        due = self.rows >= row
        low, high = np.full((self.count, 2), np.iinfo(np.intp).max), np.zeros((self.count, 2), dtype=np.intp)
        np.minimum.at(low, self.images[due], self.parts[due, :2])
        np.maximum.at(high, self.images[due], self.parts[due, 2:])
        return [(*a, *b) if b[0] else NOTHING for a, b in zip(low.tolist(), high.tolist(), strict=True)]
