"""The last stage of every recipe: registered images become pixels, in memory or in a file."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Self

import numpy as np

from rdstitch.compositing import (
    Canvas,
    CompositeOptions,
    Decisions,
    PlacedImage,
    compose_decided,
    compose_to_file,
    decide,
    planned,
)
from rdstitch.compositing.boxes import Box
from rdstitch.compositing.tiles import BlockRunner
from rdstitch.georeferencing.georeference import Georeference, world_file_paths
from rdstitch.georeferencing.place_on_map import MapPlacement
from rdstitch.io.formats import check_memory, check_size
from rdstitch.io.metadata import Metadata
from rdstitch.io.tiff import ExtraTag
from rdstitch.options.upright_options import Corners
from rdstitch.pipeline.composition.map_canvas import canvas_on_map, place_on_canvas
from rdstitch.pipeline.composition.output_messages import (
    cut_away_messages,
    differing_profile_messages,
    lost_profile_messages,
    masked_messages,
    place_messages,
    seam_messages,
)
from rdstitch.pipeline.run import Run
from rdstitch.results.messages import Message
from rdstitch.results.placed_images import PlacedImages
from rdstitch.results.stitch_result import OutputImage
from rdstitch.system.outputs import Outputs, text_bytes
from rdstitch.system.process_memory import return_freed_memory


@dataclass(frozen=True)
class CanvasLayout:
    """Images on the canvas of the output."""

    placed: PlacedImages
    canvas: Canvas
    images: Sequence[PlacedImage]
    placement: MapPlacement
    options: CompositeOptions

    @classmethod
    def of(cls, placed: PlacedImages, options: CompositeOptions) -> Self:
        """Lay the images out."""
        canvas, placement = canvas_on_map(placed, options)
        if options.rectangle is not None:
            canvas = replace(canvas, cropped_to=_box_of_rectangle(placed, options.rectangle, canvas))
        return cls(placed, canvas, placed.images(canvas), placement, options)

    def decide(self) -> Decisions:
        """Decide on exposure, seams and crop of the images, on small versions of them."""
        return decide(self.images, self.canvas, self.options)

    def decided(self) -> "DecidedLayout":
        """The same with what was decided, which is not decided again."""
        return DecidedLayout(self.placed, self.canvas, self.images, self.placement, self.options, self.decide())

    def place_of(self, final: Canvas) -> Georeference | None:
        """The place of the final canvas on the Earth."""
        place, grid = self.placement.place, self.placed.grid
        # Without rounding, where the pixels are those of an earlier output.
        return grid.place if place is not None and grid is not None else place_on_canvas(place, self.canvas, final)


@dataclass(frozen=True)
class DecidedLayout(CanvasLayout):
    """Images on the canvas of the output, for which exposure, seams and crop were decided."""

    decisions: Decisions

    def decide(self) -> Decisions:
        """What was decided."""
        return self.decisions


def compose_images(
    layout: CanvasLayout, run: Run, run_blocks: BlockRunner | None = None
) -> tuple[OutputImage, list[Message]]:
    """Compose images on their canvas, in memory or into a file, or plan that in a dry run; with messages.

    A file has EXIF of the first image, the colour profile of the first in colours, and its place on the Earth.
    ``run_blocks``: see :func:`rdstitch.compositing.compose_decided`.
    """
    return_freed_memory()
    options, output = layout.options, run.output
    placed, canvas, placement = layout.placed, layout.canvas, layout.placement
    messages = masked_messages(placed) + place_messages(placement, placed) + cut_away_messages(placed, canvas, options)
    # A crop may yet make it fit.
    if output is not None and options.crop == "none":
        check_size(output, canvas.size)
        check_memory(output, canvas.size, options.max_memory)
    laid_out = OutputImage(
        placed=placed,
        canvas=canvas,
        options=run.options,
        output=output,
        georeference=placement.place,
        not_georeferenced=placement.reason,
    )
    if run.options.dry_run:
        return replace(laid_out, plan=planned(layout.images, canvas, options)), messages
    decisions = layout.decide()
    if not placed.tiles:  # seams are judged as seen in a photograph
        messages += seam_messages(decisions.quality, [str(source.path) for source in placed.sources])
    composed, of_output = _drawn(replace(laid_out, seams=decisions.quality), layout, decisions, run, run_blocks)
    return composed, [*messages, *of_output]


def _drawn(
    laid_out: OutputImage, layout: CanvasLayout, decisions: Decisions, run: Run, run_blocks: BlockRunner | None
) -> tuple[OutputImage, list[Message]]:
    """Draw the image, in memory or into a file with its world files."""
    outputs, output, placed = run.outputs, run.output, layout.placed

    def report(fraction: float) -> None:
        run.progress("compositing", round(100 * fraction), 100)

    def tags(final: Canvas) -> list[ExtraTag]:
        place = layout.place_of(final)
        return [] if place is None else place.tiff_tags()

    if output is None:
        image = compose_decided(decisions, report, run_blocks)
        place = layout.place_of(image.canvas)
        return replace(laid_out, composite=image, canvas=image.canvas, georeference=place), [*image.messages]
    metadata = _metadata(placed, layout.options)
    written = compose_to_file(
        output, decisions, report, run_blocks, metadata=metadata, extra_tags=tags, outputs=outputs
    )
    place = layout.place_of(written.canvas)
    lost = lost_profile_messages(placed.profile_source, output)
    messages = [*written.messages, *lost, *differing_profile_messages(placed)]
    if place is not None and (files := world_file_paths(output)):
        messages += outputs.attempt(files[0], partial(_write_world_files, outputs, files, place))
    return replace(laid_out, written=written, canvas=written.canvas, georeference=place), messages


def _metadata(placed: PlacedImages, options: CompositeOptions) -> Metadata:
    """Metadata of the output: that of the first image, with pixel size and resolution as scaled."""
    metadata = placed.sources[0].metadata.of_composite()
    metadata = replace(metadata, icc_profile=placed.profile_source.metadata.icc_profile)
    sized = (options.max_size, options.gsd, options.like) != (None, None, None)
    return metadata.scaled(None if sized else options.scale)


def _box_of_rectangle(placed: PlacedImages, corners: Corners, canvas: Canvas) -> Box | None:
    """Box of the user's rectangle on the canvas; None if its corners lie outside."""
    index = placed.reference
    if index is None:
        return None
    places = canvas.place(placed.cameras[index], placed.homographies[index], np.reshape(corners, (4, 2)))
    if not np.isfinite(places).all():
        return None
    low = np.clip(np.rint(places.min(axis=0)), 0, canvas.size).astype(int)
    high = np.clip(np.rint(places.max(axis=0)) + 1, 0, canvas.size).astype(int)
    return (*low.tolist(), *high.tolist()) if (high > low).all() else None


def _write_world_files(outputs: Outputs, paths: Sequence[Path], place: Georeference) -> None:
    for path, text in zip(paths, place.world_file_texts(), strict=True):
        outputs.write(path, text_bytes(text))
