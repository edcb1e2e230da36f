"""A part of a canvas, computed tile by tile, as strips from top to bottom; here, or in blocks by workers elsewhere.

A block is composed as a whole output is, of the images that reach it, which the worker reads. Its strips go to a
store that both see, so that neither they nor the images travel with tasks and results. Blocks are bands across the
output that are no narrower than an image, so that no image is read for more than two of them.
"""

from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from dataclasses import dataclass
from functools import cached_property
from itertools import islice
from typing import Any

import numpy as np

from rdstitch.arrays import AnyArray, UInt8Array
from rdstitch.compositing.boxes import Box
from rdstitch.compositing.render import Renderer
from rdstitch.io.strips import STRIP_ROWS
from rdstitch.system.cache import Cache, Stored
from rdstitch.system.progress import FractionProgress, silent

OutputStrip = tuple[AnyArray, UInt8Array]
"""Samples (h, W, C) and alpha (h, W)."""


@dataclass(frozen=True)
class TiledOutput:
    """A part of a canvas that is not yet computed."""

    renderer: Renderer
    box: Box  # the part: x0, y0, x1, y1 on the canvas of the renderer, pixels, end exclusive
    tile_size: int  # side of the square tiles, pixels
    workers: int  # tiles at one time

    @property
    def size(self) -> tuple[int, int]:
        """Width and height, pixels."""
        return self.box[2] - self.box[0], self.box[3] - self.box[1]

    @cached_property
    def _shown(self) -> list[set[int]]:
        """Which images each row of tiles shows."""
        tops = range(0, self.size[1], self.tile_size)
        return [set().union(*map(self.renderer.shown, self._boxes(top))) for top in tops]

    def _boxes(self, top: int) -> list[Box]:
        """The tiles of a row that begins so many pixels below the top."""
        (width, height), (x, y), side = self.size, self.box[:2], self.tile_size
        bottom = min(top + side, height)
        return [(x + k, y + top, x + min(k + side, width), y + bottom) for k in range(0, width, side)]

    def part(self, box: Box) -> tuple["TiledOutput", tuple[int, ...]]:
        """A smaller part, one tile at a time, with nothing but the images that reach it; and which these are.

        As many are computed at one time as there are workers, and share the memory.
        """
        renderer, images = self.renderer.part(box, self.workers)
        return TiledOutput(renderer, box, self.tile_size, 1), images

    def strips(self, progress: FractionProgress = silent) -> Generator[OutputStrip]:
        """The output from top to bottom: samples (h, W, C) and alpha (h, W), at most 256 rows at a time."""
        if self.workers == 1:
            yield from self._strips(map, progress)
            return
        with ThreadPoolExecutor(self.workers) as pool:
            yield from self._strips(pool.map, progress)

    def _strips(self, run: Callable[..., Iterator[Any]], progress: FractionProgress) -> Iterator[OutputStrip]:
        """The same, with tiles computed by ``run``, which works like ``map`` and may work ahead."""
        (width, height), side = self.size, self.tile_size
        tops = iter(range(0, height, side))
        # Two rows at a time, so that no worker waits for the last tile of a row.
        under_way = deque(self._start(top, run) for top in islice(tops, 2))
        done = 0
        while under_way:
            (samples, alpha), tiles = under_way.popleft()
            for box in tiles:
                done += (box[2] - box[0]) * (box[3] - box[1])
                progress(done / (width * height))
            # Computed while this strip is written.
            under_way.extend(self._start(top, run) for top in islice(tops, 1))
            for start in range(0, len(samples), STRIP_ROWS):
                yield samples[start : start + STRIP_ROWS], alpha[start : start + STRIP_ROWS]

    def _start(self, top: int, run: Callable[..., Iterator[Any]]) -> tuple[OutputStrip, Iterator[Box]]:
        """Begin with a row of tiles, when all but one above are done: the strip they fill, and each once it is done."""
        row, x, boxes = top // self.tile_size, self.box[0], self._boxes(top)
        # In alternating directions, so that the images used last are the ones needed next.
        backwards = row % 2 == 1
        images, warps = self.renderer.images, self.renderer.warps
        # The row above is not done yet.
        images.expect(set().union(*self._shown[max(row - 1, 0) :]))
        images.prefetch(sorted(self._shown[row], key=lambda k: warps[k].box, reverse=backwards))
        shape = boxes[0][3] - boxes[0][1], self.size[0]
        samples = np.zeros((*shape, self.renderer.channels), dtype=self.renderer.dtype)
        alpha = np.zeros(shape, dtype=np.uint8)

        def fill(box: Box) -> Box:
            columns = slice(box[0] - x, box[2] - x)
            samples[:, columns], covered = self.renderer.tile(box)
            alpha[:, columns][covered] = 255
            return box

        return (samples, alpha), run(fill, boxes[::-1] if backwards else boxes)


@dataclass(frozen=True, eq=False)
class Block:
    """A part of an output as a task."""

    tiles: TiledOutput  # with the images that reach it alone
    images: tuple[int, ...]  # which of the composite's images these are

    def compute(self, store: Cache) -> list[Stored[OutputStrip]]:
        """Its strips from top to bottom, in the store, which must be this run's own."""
        return [self._kept(store, number, strip) for number, strip in enumerate(self.tiles.strips())]

    def _kept(self, store: Cache, number: int, strip: OutputStrip) -> Stored[OutputStrip]:
        return store.stored("blocks", (self.tiles.box, number), lambda: strip)


BlockRunner = Callable[[Iterable[Block]], Generator[list[Stored[OutputStrip]]]]
"""Computes blocks elsewhere: their strips, in the order of the blocks, which are taken as they are needed."""


def strips_of(whole: TiledOutput, elsewhere: BlockRunner | None, progress: FractionProgress) -> Generator[OutputStrip]:
    """The strips of an output, which is computed here or in blocks elsewhere; the same, bit for bit."""
    return whole.strips(progress) if elsewhere is None else _strips_of_blocks(whole, elsewhere, progress)


def _strips_of_blocks(whole: TiledOutput, run: BlockRunner, progress: FractionProgress) -> Generator[OutputStrip]:
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
