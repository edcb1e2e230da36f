"""From what is decided on small images, exposure, seams and crop, to strips of the output at full size."""

from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Self

from rdstitch.compositing.blender import margin
from rdstitch.compositing.boxes import Box
from rdstitch.compositing.canvas import Canvas
from rdstitch.compositing.cropping import covered_pixels, crop_box, crop_rows
from rdstitch.compositing.gain_compensation import estimate_exposure
from rdstitch.compositing.image_cache import ImageCache
from rdstitch.compositing.lattice import LATTICE_STEPS
from rdstitch.compositing.photometric import Exposure, no_exposure
from rdstitch.compositing.plan import CompositePlan, plan_composite
from rdstitch.compositing.radiometry import are_measurements, exposure_by_metadata
from rdstitch.compositing.render import Renderer
from rdstitch.compositing.seam_finder import SeamMap, find_seams
from rdstitch.compositing.seam_quality import SeamQuality
from rdstitch.compositing.source_images import ImageReader, PlacedImage
from rdstitch.compositing.survey import Survey, survey_factor, survey_images
from rdstitch.compositing.tiles import TiledOutput
from rdstitch.compositing.warp import plan_warps
from rdstitch.errors import ArgumentError
from rdstitch.options.composite_options import CompositeOptions
from rdstitch.results.messages import Message
from rdstitch.system.process_memory import return_freed_memory

# Images that the survey reads at one time: what the tiles need is not there yet.
_READERS = 2


@dataclass(frozen=True)
class _Task:
    """Images and where they lie, before anything is decided."""

    images: Sequence[PlacedImage]
    canvas: Canvas  # widened where it goes all the way round
    options: CompositeOptions
    reader: ImageReader
    plan: CompositePlan
    turn: Box | None  # the middle of a canvas that was widened

    @classmethod
    def of(cls, images: Sequence[PlacedImage], canvas: Canvas, options: CompositeOptions) -> Self:
        if len(images) != len(canvas.footprints):
            raise ArgumentError(f"the canvas is for {len(canvas.footprints)} images, not for {len(images)}")
        reader = ImageReader(images)
        channels, dtype = reader.samples
        cameras = [image.camera for image in images]
        masked = reader.masked(0) or any(image.transparent for image in images)
        plan = plan_composite(cameras, canvas, options, channels, dtype.itemsize, masked=masked)
        if canvas.period is None:
            return cls(images, canvas, options, reader, plan, None)
        (width, height), around = canvas.size, round(canvas.period)
        needed = _wrap_margin(canvas, plan.bands)
        left = needed + (width - around) // 2
        wider = canvas.cropped((-needed, 0, width + needed, height))
        return cls(images, wider, options, reader, plan, (left, 0, left + around, height))


@dataclass(frozen=True)
class Decisions:
    """Images on a canvas with what is decided on small versions of them, and what their seams are like."""

    task: _Task
    exposure: Exposure
    seams: SeamMap | None  # None without
    box: Box  # of the output on the canvas, which is widened where it goes all the way round
    messages: tuple[Message, ...] = ()
    quality: SeamQuality = field(default_factory=SeamQuality)  # of the seams, in pixels of the output

    @property
    def canvas(self) -> Canvas:
        """Where every image lies in the output."""
        canvas = self.task.canvas
        return canvas if self.box == (0, 0, *canvas.size) else canvas.cropped(self.box)


def decide(images: Sequence[PlacedImage], canvas: Canvas, options: CompositeOptions) -> Decisions:
    """Decide on exposure, seams and cropping, from a small version of each image; the canvas was planned for them."""
    task = _Task.of(images, canvas, options)
    whole = task.turn or (0, 0, *task.canvas.size)
    joined = len(task.images) > 1 and (options.exposure != "none" or options.seam != "none")
    exposure, seams = no_exposure(len(task.images), task.reader.samples[0]), None
    if not joined and options.crop != "auto":
        return Decisions(task, exposure, None, whole)
    survey = survey_images(task.reader, task.images, task.canvas, min(task.plan.workers, _READERS))
    messages, quality, cropped = list[Message](), SeamQuality(), task.canvas.cropped_to
    if joined and options.exposure != "none":
        exposure, messages = _decide_exposure(task, survey)
    if joined and options.seam != "none":
        seams, quality = _decide_seams(task, survey, exposure)
    if options.crop == "auto" and cropped is None:
        find = crop_box if task.turn is None else partial(crop_rows, whole=task.turn)
        cropped, kept = find(covered_pixels(survey), survey.factor, task.canvas.size)
        if cropped is None:
            what = "largest rectangle" if task.turn is None else "rows"
            text = f"not cropped: the {what} without holes would keep {100 * kept:.0f} % of the image"
            messages = [*messages, Message(text)]
    box = cropped if cropped is not None and options.crop == "auto" else whole
    return Decisions(task, exposure, seams, box, tuple(messages), quality.cropped(box))


def planned(images: Sequence[PlacedImage], canvas: Canvas, options: CompositeOptions) -> CompositePlan:
    """What compositing would take; a small version of the first image is read."""
    return _Task.of(images, canvas, options).plan


@contextmanager
def prepare_composite(decisions: Decisions, *, here: bool = True) -> Iterator[TiledOutput]:
    """The output that is to be computed; see :func:`rdstitch.compositing.compositor.compose_decided`.

    Images are read ahead as long as it lasts, if its pixels are computed ``here``.
    """
    task, plan = decisions.task, decisions.task.plan
    warps, (channels, dtype) = plan_warps(task.images, task.canvas), task.reader.samples
    cache = ImageCache(task.reader, [w.shrink for w in warps], plan.cache_bytes, ahead=plan.workers > 1 and here)
    with closing(cache):
        return_freed_memory()
        # The first tiles need most of them, however the seams run.
        topmost = [index for index, warp in enumerate(warps) if warp.box[1] < plan.tile_size]
        cache.prefetch(sorted(topmost, key=lambda index: warps[index].box))
        renderer = Renderer(
            warps, cache, decisions.exposure, decisions.seams, task.options, plan.bands, channels, dtype
        )
        yield TiledOutput(renderer, decisions.box, plan.tile_size, plan.workers)


def _decide_exposure(task: _Task, survey: Survey) -> tuple[Exposure, list[Message]]:
    method = task.options.exposure
    if method == "auto":
        method = "exif" if are_measurements(task.images, *task.reader.samples) else "balanced"
    if method == "exif":
        exposure, message = exposure_by_metadata(task.images, task.reader.samples[0])
        return exposure, [message]
    return estimate_exposure(survey, task.images, method, task.plan.workers), []


def _decide_seams(task: _Task, survey: Survey, exposure: Exposure) -> tuple[SeamMap, SeamQuality]:
    seams = find_seams(survey, exposure, task.options.seam == "graphcut", task.plan.workers)
    quality = survey.seam_quality(seams.labels)
    if task.canvas.period is not None:
        seams = seams.repeated(round(task.canvas.period))
    if task.options.blend == "feather":
        seams = replace(seams, softness=max(1, (1 << task.plan.bands) // (2 * seams.factor)))
    return seams, quality


def _wrap_margin(canvas: Canvas, bands: int) -> int:
    """What a canvas that goes all the way round needs of its other end on each side, pixels, for blending to join them.

    A multiple of the spacings of lattices, bands and reduced pixels, so that both ends are computed alike.
    """
    needed, unit = margin(bands) + (2 << bands), max(LATTICE_STEPS[0], 2 << bands, survey_factor(canvas))
    return min(-(-needed // unit) * unit, canvas.size[0] // unit * unit)
