"""Bands of an output as tasks: workers elsewhere compute them, and they are put together here, strip by strip.

A block is composed as a whole output is, of the images that reach it, which the worker reads. Its strips go to a
store that both see, so that neither they nor the images travel with tasks and results. Blocks are bands across the
output that are no narrower than an image, so that no image is read for more than two of them.
"""

from collections.abc import Callable, Generator, Iterable, Iterator
from contextlib import closing
from dataclasses import dataclass

import numpy as np

from rdstitch.cache import Cache, Stored
from rdstitch.compositing.tiles import OutputStrip, TiledOutput
from rdstitch.opencv_state import one_opencv_thread
from rdstitch.progress import ShareProgress, unheard


@dataclass(frozen=True, eq=False)
class Block:
    """A part of an output as a task."""

    tiles: TiledOutput  # with the images that reach it alone
    images: tuple[int, ...]  # which of the composite's images these are

    def compute(self, store: Cache) -> list[Stored[OutputStrip]]:
        """Its strips from top to bottom, in the store, which must be this run's own."""
        with one_opencv_thread():
            return [self._kept(store, number, strip) for number, strip in enumerate(self.tiles.strips())]

    def _kept(self, store: Cache, number: int, strip: OutputStrip) -> Stored[OutputStrip]:
        return store.stored("blocks", (self.tiles.box, number), lambda: strip)


BlockRunner = Callable[[Iterable[Block]], Generator[list[Stored[OutputStrip]]]]
"""Computes blocks elsewhere: their strips, in the order of the blocks, which are taken as they are needed."""


def strips_of_blocks(whole: TiledOutput, run: BlockRunner, progress: ShareProgress = unheard) -> Generator[OutputStrip]:
    """The strips of an output (h, W, ...) that is computed in blocks; the same, bit for bit, as here."""
    (x0, y0, x1, y1), (width, height) = whole.box, _block_size(whole)
    lefts = range(x0, x1, width)

    def blocks() -> Iterator[Block]:
        for top in range(y0, y1, height):
            for left in lefts:
                yield Block(*whole.part((left, top, min(left + width, x1), min(top + height, y1))))

    with closing(run(blocks())) as done:
        for top in range(y0, y1, height):
            row = []
            for left in lefts:
                row.append(next(done))
                below = (min(top + height, y1) - top) * (min(left + width, x1) - x0)
                progress(((top - y0) * (x1 - x0) + below) / ((x1 - x0) * (y1 - y0)))
            for parts in zip(*row, strict=True):
                strips = [part.load() for part in parts]
                for part in parts:
                    part.remove()
                yield (
                    np.concatenate([samples for samples, _ in strips], axis=1),
                    np.concatenate([alpha for _, alpha in strips], axis=1),
                )


def _block_size(whole: TiledOutput) -> tuple[int, int]:
    """Width and height of a block, canvas pixels.

    Bands from left to right, each of them written when it is there; where these are too few for the workers, from top
    to bottom. Where both are, the more numerous are made narrower, at the price of more reading.
    """
    boxes = [whole.renderer.support(warp.box) for warp in whole.renderer.warps]
    fitting = []
    for axis, length in enumerate(whole.size):
        widest = max(box[axis + 2] - box[axis] for box in boxes)
        fitting.append(max(length // (-(-widest // whole.tile_size) * whole.tile_size), 1))
    axis = 1 if fitting[1] >= min(whole.workers, fitting[0]) else 0
    count = max(fitting[axis], whole.workers)
    size = list(whole.size)
    size[axis] = -(-size[axis] // (count * whole.tile_size)) * whole.tile_size
    return size[0], size[1]
