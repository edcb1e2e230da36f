"""The last stage of every picture: from registered pictures to pixels, in memory or in a file."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from rdstitch.arrays import FloatArray
from rdstitch.camera import Camera
from rdstitch.compositing import (
    Canvas,
    Composite,
    CompositeOptions,
    CompositePlan,
    FileComposite,
    compose,
    compose_to_file,
    plan_canvas,
    plan_composite,
    plan_panorama,
)
from rdstitch.compositing.near_part import NearPart
from rdstitch.compositing.warp import Displacement
from rdstitch.errors import ArgumentError
from rdstitch.export.georeference import Georeference, georeference, has_place, world_file_paths
from rdstitch.inputs.source import Source, readers
from rdstitch.io.atomic import check_output, text_bytes
from rdstitch.io.deepzoom import LARGEST_TILE_PROFILE
from rdstitch.io.fingerprint import Fingerprint
from rdstitch.io.outputs import Outputs
from rdstitch.io.read import Picture
from rdstitch.io.tiff import ExtraTag
from rdstitch.io.write import check_memory, check_size
from rdstitch.pipeline.memory import release_free_heap
from rdstitch.progress import Progress
from rdstitch.viewer import viewer_path

# Reduction of a picture of which only the kind of its samples is wanted.
_SMALLEST = 8


@dataclass(frozen=True)
class Composed:
    """Pictures put together, or the plan of doing so.

    Attributes
    ----------
    canvas : Canvas
        Where the pictures lie in the output.
    composite : Composite or None
        The picture; None where it went to a file, or was only planned.
    plan : CompositePlan or None
        Of a dry run.
    notes : tuple of str
        What the user should know, such as why nothing was cropped.
    fingerprint : Fingerprint or None
        Size and digest of the file.
    written : FileComposite or None
        The picture in its file.
    """

    canvas: Canvas
    composite: Composite | None = None
    plan: CompositePlan | None = None
    notes: tuple[str, ...] = ()
    fingerprint: Fingerprint | None = None
    written: FileComposite | None = None


def compose_pictures(
    sources: Sequence[Source],
    cameras: Sequence[Camera],
    homographies: ArrayLike,
    reference: int | None,
    output: str | Path | None,
    options: CompositeOptions,
    threads: int,
    progress: Progress,
    *,
    displacements: Sequence[Displacement | None] | None = None,
    overwrite: bool,
    outputs: Outputs,
    dry_run: bool = False,
    turned: bool = False,
) -> Composed:
    """Plan the canvas, see whether a file can hold it, and put the pictures on it.

    Parameters
    ----------
    sources, cameras : sequence
        Of the pictures that are used.
    homographies : array_like of shape (N, 3, 3)
        Normalized undistorted coordinates of each picture to the plane.
    reference : int or None
        Picture whose resolution the output has; None for the median one's.
    output : path or None
        File that the picture is written to, a strip at a time, with colour profile and EXIF of the first picture, and
        with its place on the Earth where three pictures have a GPS position; without it the picture is made in memory.
    options : CompositeOptions
    threads : int
    progress : callable
    displacements : sequence of callables or None, optional
        What local alignment adds to the measured pixels of each picture.
    overwrite : bool
        Replace an existing world file.
    outputs : Outputs
        Where the files are staged.
    dry_run : bool
        Only plan.
    turned : bool
        Whether the camera turned on the spot, so that the homographies lead to directions, not to a plane.

    Raises
    ------
    OutputError
        When a file beside the output exists already.
    """
    release_free_heap()
    # A camera that turned on the spot was at one place, and its pictures show no plane.
    positions = [None if turned else source.metadata.gps for source in sources]
    beside = world_file_paths(output) if output is not None and has_place(positions) else ()
    page = None if output is None else viewer_path(output)
    for file in (*beside, *([] if page is None else [page])):
        check_output(file, overwrite, suffixes=())
    matrices = np.asarray(homographies, dtype=np.float64)
    plan = partial(_plan, cameras, matrices, reference, [s.name for s in sources], options, turned)
    canvas = plan(scale=options.scale)
    if options.max_size is not None and max(canvas.size) > options.max_size:
        # The canvas has whole pixels around the pictures, and a full turn a multiple of some, so that these may be too
        # many.
        spare = 1 if canvas.period is None else max(32, options.max_size // 128)
        canvas = plan(scale=options.scale * (options.max_size - spare) / max(canvas.size))
    # A crop may yet make it fit.
    if output is not None and options.crop == "none":
        check_size(output, canvas.size)
        check_memory(output, canvas.size, options.max_memory)
    options = replace(options, workers=threads)
    read = [
        reader if part is None else partial(_read_near, reader, part)
        for reader, part in zip(readers(sources), canvas.near or [None] * len(sources), strict=True)
    ]
    if dry_run:
        pixels = read[0](_SMALLEST).pixels
        channels = 1 if pixels.ndim == 2 else pixels.shape[2]
        return Composed(canvas, plan=plan_composite(cameras, canvas, options, channels, pixels.dtype.itemsize))

    exposures = [source.metadata.exposure for source in sources]

    def told(share: float) -> None:
        progress("compositing", round(100 * share), 100)

    if output is None:
        composite = compose(read, cameras, homographies, canvas, options, told, read, exposures, displacements)
        return Composed(composite.canvas, composite, notes=composite.notes)
    placed: list[tuple[Georeference | None, str]] = []

    def tags(final: Canvas) -> list[ExtraTag]:
        placed.append(georeference(positions, cameras, final.matrix @ matrices))
        return placed[0][0].tiff_tags() if placed[0][0] is not None else []

    written = compose_to_file(
        output,
        read,
        cameras,
        matrices,
        canvas,
        options,
        sources[0].metadata,
        told,
        tags,
        read,
        exposures,
        displacements,
        outputs=outputs,
    )
    place, note = placed[0]
    if place is not None and beside:
        for file, text in zip(beside, place.world_file_texts(), strict=True):
            outputs.write(file, text_bytes(text))
    notes = (*written.notes, *([note] if note else []), *_profile_notes(sources[0], Path(output)))
    return Composed(written.canvas, notes=notes, fingerprint=written.fingerprint, written=written)


def _plan(
    cameras: Sequence[Camera],
    homographies: FloatArray,
    reference: int | None,
    names: Sequence[str],
    options: CompositeOptions,
    turned: bool,
    *,
    scale: float,
) -> Canvas:
    """The canvas on a plane, or, of pictures taken by turning on the spot, in a projection."""
    if turned:
        return plan_panorama(
            cameras,
            homographies,
            projection=options.projection,
            scale=scale,
            rotate=options.rotate,
            reference=reference,
            names=names,
        )
    if options.projection not in ("auto", "plane"):
        raise ArgumentError(
            f"the {options.projection} projection is for pictures taken by turning on the spot; these were not, "
            "leave out --projection"
        )
    return plan_canvas(
        cameras,
        homographies,
        scale=scale,
        rotate=options.rotate,
        reference=reference,
        names=names,
        max_stretch=options.max_stretch,
    )


def _profile_notes(source: Source, output: Path) -> list[str]:
    """Why the output lacks the colour profile of the picture whose metadata it has."""
    lost, size = source.metadata.profile_lost, len(source.metadata.icc_profile)
    if output.suffix.lower() == ".dzi" and size > LARGEST_TILE_PROFILE:
        lost = f"its colour profile of {size / 1e3:.0f} kB is too large to be in every tile"
    return [f"{source.name}: {lost}; colours are as if it had none"] if lost else []


def _read_near(read: Callable[..., Picture], part: NearPart, reduction: int = 1) -> Picture:
    """A picture, whole or reduced, of which only its near part is drawn."""
    return part.masked(read(reduction))
