"""From what is decided on small pictures, exposure, seams and crop, to strips of the output at full size."""

from collections import deque
from collections.abc import Callable, Generator, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing, contextmanager
from dataclasses import dataclass, replace
from functools import partial
from itertools import islice
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rdstitch.compositing.blender import margin
from rdstitch.compositing.boxes import Box
from rdstitch.compositing.brightness import estimate_exposure
from rdstitch.compositing.canvas import Canvas
from rdstitch.compositing.crop import coverage_map, crop_box, crop_rows
from rdstitch.compositing.image_cache import PictureCache
from rdstitch.compositing.image_parts import ShownPart, shown_parts
from rdstitch.compositing.lattice import LATTICE_STEPS
from rdstitch.compositing.options import CompositeOptions
from rdstitch.compositing.photometric import no_exposure
from rdstitch.compositing.placed_picture import PlacedPicture
from rdstitch.compositing.plan import CompositePlan, plan_composite
from rdstitch.compositing.render import Renderer
from rdstitch.compositing.seam_finder import find_seams
from rdstitch.compositing.source_images import PictureReader
from rdstitch.compositing.survey import survey_factor, survey_pictures
from rdstitch.compositing.warp import plan_warps
from rdstitch.errors import ArgumentError
from rdstitch.io.layout import STRIP_ROWS
from rdstitch.messages import Message
from rdstitch.opencv_state import one_opencv_thread
from rdstitch.process_memory import release_free_heap

# Samples (h, W, C) and alpha (h, W).
OutputStrip = tuple[NDArray[Any], NDArray[np.uint8]]
# Called with the share of the work done, 0 to 1.
ShareProgress = Callable[[float], None]

_PREPARATION = 0.25
# Pictures that the survey reads at one time: what the tiles need is not there yet.
_READERS = 2


@dataclass(frozen=True)
class Prepared:
    """A composite that is decided on, and not yet computed.

    Attributes
    ----------
    renderer : Renderer
    canvas : Canvas
        After cropping.
    origin : (int, int)
        Its top-left pixel on the canvas of the renderer.
    plan : CompositePlan
    messages : tuple of Message
    shown : sequence of ShownPart
        Which part of each picture shows, where that is known before; else empty.
    around : int
        How far from there pictures are requested too, canvas pixels.
    """

    renderer: Renderer
    canvas: Canvas
    origin: tuple[int, int]
    plan: CompositePlan
    messages: tuple[Message, ...]
    shown: Sequence[ShownPart]
    around: int

    def strips(self, progress: ShareProgress | None = None) -> Generator[OutputStrip]:
        """The output from top to bottom: samples (h, W, C) and alpha (h, W), at most 256 rows at a time."""
        progress = _part_of(progress, _PREPARATION, 1.0)
        if self.plan.workers == 1:
            yield from self._strips(map, progress)
            return
        with one_opencv_thread(), ThreadPoolExecutor(self.plan.workers) as pool:
            yield from self._strips(pool.map, progress)

    def _strips(self, run: Callable[..., Iterator[Any]], progress: ShareProgress | None) -> Iterator[OutputStrip]:
        """The same, with tiles computed by ``run``, which works like ``map`` and may work ahead."""
        (width, height), side = self.canvas.size, self.plan.tile_size
        tops = iter(range(0, height, side))
        # Two rows at a time, so that no worker waits for the last tile of a row.
        under_way = deque(self._start(top, run) for top in islice(tops, 2))
        done = 0
        while under_way:
            (samples, alpha), tiles = under_way.popleft()
            for box in tiles:
                if progress is not None:
                    done += (box[2] - box[0]) * (box[3] - box[1])
                    progress(done / (width * height))
            # Computed while this strip is written.
            under_way.extend(self._start(top, run) for top in islice(tops, 1))
            for start in range(0, len(samples), STRIP_ROWS):
                yield samples[start : start + STRIP_ROWS], alpha[start : start + STRIP_ROWS]

    def _start(self, top: int, run: Callable[..., Iterator[Any]]) -> tuple[OutputStrip, Iterator[Box]]:
        """Begin with a row of tiles, when all but one above are done: the strip they fill, and each once it is done."""
        (width, height), (x, y), side = self.canvas.size, self.origin, self.plan.tile_size
        bottom = min(top + side, height)
        # In alternating directions, so that the pictures used last are the ones needed next.
        backwards = top // side % 2 == 1
        if self.shown:
            pictures, warps = self.renderer.pictures, self.renderer.warps
            pictures.expect([part.from_row(y + top - side - self.around) for part in self.shown])
            rows = y + top - self.around, y + bottom + self.around
            due = [index for index, part in enumerate(self.shown) if part.on_rows(*rows)]
            pictures.prefetch(sorted(due, key=lambda index: warps[index].box, reverse=backwards))
        boxes = [(x + k, y + top, x + min(k + side, width), y + bottom) for k in range(0, width, side)]
        samples = np.zeros((bottom - top, width, self.renderer.channels), dtype=self.renderer.dtype)
        alpha = np.zeros((bottom - top, width), dtype=np.uint8)

        def fill(box: Box) -> Box:
            columns = slice(box[0] - x, box[2] - x)
            samples[:, columns], covered = self.renderer.tile(box)
            alpha[:, columns][covered] = 255
            return box

        return (samples, alpha), run(fill, boxes[::-1] if backwards else boxes)


@contextmanager
def prepare_composite(
    pictures: Sequence[PlacedPicture],
    canvas: Canvas,
    options: CompositeOptions | None = None,
    progress: ShareProgress | None = None,
) -> Iterator[Prepared]:
    """Decide on exposure, seams and cropping, from a small version of each picture; see :func:`compose`.

    Pictures are read ahead as long as it lasts.
    """
    options = options or CompositeOptions()
    if len(pictures) != len(canvas.footprints):
        raise ArgumentError(f"the canvas is for {len(canvas.footprints)} pictures, not for {len(pictures)}")
    reader = PictureReader(pictures)
    channels, dtype = reader.samples
    plan = plan_composite([picture.camera for picture in pictures], canvas, options, channels, dtype.itemsize)
    if canvas.period is not None:
        canvas = canvas.widened(_wrap_margin(canvas, plan.bands))
    warps = plan_warps(pictures, canvas)
    cache = PictureCache(reader, [w.shrink for w in warps], plan.cache_bytes, ahead=plan.workers > 1)
    with closing(cache):
        same = no_exposure(len(pictures), channels)
        renderer = Renderer(warps, cache, same, None, options, plan.bands, channels, dtype)
        decided = _decided(renderer, reader, pictures, canvas, plan, _part_of(progress, 0.0, _PREPARATION))
        release_free_heap()
        yield decided


def _decided(
    renderer: Renderer,
    reader: PictureReader,
    pictures: Sequence[PlacedPicture],
    canvas: Canvas,
    plan: CompositePlan,
    progress: ShareProgress | None,
) -> Prepared:
    """Decide for a renderer that has neither exposure nor seams yet."""
    options, warps, exposure = renderer.options, renderer.warps, renderer.exposure
    seams = survey = None
    if len(pictures) > 1 and (options.exposure != "none" or options.seam != "none"):
        surveyed = _part_of(progress, 0.0, 0.7)
        survey = survey_pictures(reader, pictures, canvas, min(plan.workers, _READERS), surveyed)
        # The first tiles need most of them, however the seams run.
        topmost = [index for index, warp in enumerate(warps) if warp.box[1] < plan.tile_size]
        renderer.pictures.prefetch(sorted(topmost, key=lambda index: warps[index].box))
        if options.exposure != "none":
            exposure = estimate_exposure(survey, pictures, options.exposure)
        if options.seam != "none":
            seams = find_seams(survey, exposure, options.seam == "graphcut", _part_of(progress, 0.7, 1.0))
            if canvas.period is not None:
                seams = seams.repeated(round(canvas.period))
            if options.blend == "feather":
                seams = replace(seams, softness=max(1, (1 << plan.bands) // (2 * seams.factor)))
    box, note = _unwidened(canvas), ""
    if options.crop == "auto":
        covered, factor = coverage_map(pictures, canvas, survey)
        find = crop_box if box is None else partial(crop_rows, whole=box)
        found, note = find(covered, factor, canvas.size)
        box = found or box
    cropped = canvas if box is None else canvas.cropped(box)
    # The support of a tile's blending is aligned to the coarsest band.
    around = margin(plan.bands) + (2 << plan.bands)
    shown = [] if seams is None else shown_parts(warps, seams, around)
    origin, messages = (0, 0) if box is None else box[:2], (Message(note),) if note else ()
    renderer = replace(renderer, exposure=exposure, seams=seams)
    return Prepared(renderer, cropped, origin, plan, messages, shown, around)


def _wrap_margin(canvas: Canvas, bands: int) -> int:
    """What a canvas that goes all the way round needs of its other end on each side, pixels, for blending to join them.

    A multiple of the spacings of lattices, bands and reduced pixels, so that both ends are computed alike.
    """
    needed, unit = margin(bands) + (2 << bands), max(LATTICE_STEPS[0], 2 << bands, survey_factor(canvas))
    return min(-(-needed // unit) * unit, canvas.size[0] // unit * unit)


def _unwidened(canvas: Canvas) -> Box | None:
    """The middle of a canvas that was widened: one full turn; None for others."""
    if canvas.period is None:
        return None
    (width, height), turn = canvas.size, round(canvas.period)
    left = (width - turn) // 2
    return left, 0, left + turn, height


def _part_of(progress: ShareProgress | None, start: float, stop: float) -> ShareProgress | None:
    """A progress that fills a part of another."""
    if progress is None:
        return None
    return lambda share: progress(start + (stop - start) * share)
