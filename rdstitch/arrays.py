"""The array types that travel through the library."""

from collections.abc import Sequence
from typing import Any, ClassVar, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rdstitch.errors import ArgumentError

AnyArray = NDArray[Any]
BoolArray = NDArray[np.bool_]
ComplexArray = NDArray[np.complex128]
Float32Array = NDArray[np.float32]
FloatArray = NDArray[np.float64]
Int32Array = NDArray[np.int32]
IntArray = NDArray[np.intp]
UInt8Array = NDArray[np.uint8]


def as_numbers(name: str, values: ArrayLike) -> FloatArray:
    """An argument as an array of float64; ArgumentError where it is none."""
    try:
        return np.asarray(values, dtype=np.float64)
    except (TypeError, ValueError):
        raise ArgumentError(f"{name} must be an array of numbers") from None


def read_only(array: FloatArray) -> FloatArray:
    """The array itself, which from now on cannot be written to: one that a cache gives to everybody."""
    array.setflags(write=False)
    return array


def evenly_spaced(count: int, most: int) -> IntArray:
    """So many of ``count`` indices at most, evenly from the first to the last."""
    return np.unique(np.linspace(0, max(count - 1, 0), min(count, most)).astype(np.intp))


class Rows:
    """Base of dataclasses of arrays, or of other such dataclasses, that have the first axis in common."""

    __dataclass_fields__: ClassVar[dict[str, Any]]

    def take(self, rows: AnyArray) -> Self:
        """The rows of some indices, in their order, or of a mask; copies."""
        columns = (getattr(self, name) for name in self.__dataclass_fields__)
        return type(self)(*(None if column is None else column[rows] for column in columns))

    @classmethod
    def concatenate(cls, parts: Sequence[Self]) -> Self:
        """The rows of at least one part, one after the other; a field is None in all of them, or in none."""
        columns = ([getattr(part, name) for part in parts] for name in cls.__dataclass_fields__)
        return cls(*(None if all(v is None for v in column) else np.concatenate(column) for column in columns))

    def put(self, rows: AnyArray, others: Self) -> None:
        """Replace some rows."""
        for name in self.__dataclass_fields__:
            getattr(self, name)[rows] = getattr(others, name)

    def __len__(self) -> int:
        """Number of rows."""
        return len(getattr(self, next(iter(self.__dataclass_fields__))))

    __getitem__, __setitem__ = take, put
