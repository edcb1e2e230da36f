"""The array types that travel through the library."""

from dataclasses import fields
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

BoolArray = NDArray[np.bool_]
FloatArray = NDArray[np.float64]
IntArray = NDArray[np.intp]


class Rows:
    """Base of dataclasses of arrays that have the first axis in common."""

    def take(self, rows: NDArray[Any]) -> Self:
        """The rows of some indices, in their order, or of a mask; copies."""
        return type(self)(*(getattr(self, each.name)[rows] for each in fields(self)))  # type: ignore[arg-type]

    def put(self, rows: NDArray[Any], others: Self) -> None:
        """Replace some rows."""
        for each in fields(self):  # type: ignore[arg-type]
            getattr(self, each.name)[rows] = getattr(others, each.name)
