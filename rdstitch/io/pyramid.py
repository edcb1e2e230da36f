"""An image in strips, and again half as large, and again, in the memory of one strip."""

import tempfile
from collections.abc import Iterable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import IO

import numpy as np

from rdstitch.arrays import AnyArray
from rdstitch.io.reduction import halved, reduced_size
from rdstitch.io.strips import STRIP_ROWS

_HALVED_ROWS = 32  # that are reduced at a time, even


def pyramid_sizes(size: tuple[int, int], smallest: int) -> list[tuple[int, int]]:
    """Width and height of an image and of its reductions, each half of the one before, down to a longer side."""
    sizes = [size]
    while max(sizes[-1]) > smallest:
        sizes.append(reduced_size(sizes[-1], 2))
    return sizes


def pyramid(
    sizes: list[tuple[int, int]], strips: Iterable[AnyArray], folder: Path, *, transparent: bool
) -> Iterator[tuple[tuple[int, int], Iterator[AnyArray]]]:
    """Each size of an image with strips (h, w, C) of it, which are taken one size after the other, to their ends.

    The smaller image is made while strips pass, and waits in a temporary file in a folder until its turn; memory is
    that of one strip. Where the image is transparent, the last channel is alpha.
    """
    with ExitStack() as stack:
        for size, smaller in zip(sizes, [*sizes[1:], None], strict=True):
            spill = None if smaller is None else stack.enter_context(tempfile.TemporaryFile(dir=folder))
            kind: list[AnyArray] = []
            yield size, _spilling(strips, spill, kind, transparent)
            if spill is not None and smaller is not None:
                strips = _reread(spill, smaller, kind[0])


def _spilling(
    strips: Iterable[AnyArray], spill: IO[bytes] | None, kind: list[AnyArray], transparent: bool
) -> Iterator[AnyArray]:
    """The strips; what passes is also written, half as large, to a file, and a pixel of it kept in ``kind``."""
    for strip in strips:
        # Before it is passed on: a writer does not come back after the last tile.
        if spill is not None:
            kind[:] = [strip[0, 0]]
            for top in range(0, len(strip), _HALVED_ROWS):
                spill.write(halved(strip[top : top + _HALVED_ROWS], transparent).data)
        yield strip


def _reread(spill: IO[bytes], size: tuple[int, int], kind: AnyArray) -> Iterator[AnyArray]:
    """Strips from a file of plain samples, which is closed afterwards."""
    width, height = size
    spill.seek(0)
    for top in range(0, height, STRIP_ROWS):
        rows = min(STRIP_ROWS, height - top)
        samples = np.frombuffer(spill.read(rows * width * kind.nbytes), dtype=kind.dtype)
        yield samples.reshape(rows, width, len(kind))
    spill.close()
