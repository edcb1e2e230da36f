"""The last stage of every picture: from registered pictures to pixels, in memory or in a file."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

from rdstitch.compositing import (
    Canvas,
    Composite,
    CompositeOptions,
    CompositePlan,
    FileComposite,
    compose,
    compose_to_file,
    plan_composite,
)
from rdstitch.compositing.near_part import NearPart
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
from rdstitch.pipeline.placed_images import PlacedImages, plan
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
    placed: PlacedImages,
    output: str | Path | None,
    options: CompositeOptions,
    threads: int,
    progress: Progress,
    *,
    overwrite: bool,
    outputs: Outputs,
    dry_run: bool = False,
) -> Composed:
    """Plan the canvas, see whether a file can hold it, and put the pictures on it.

    Parameters
    ----------
    placed : PlacedImages
    output : path or None
        File that the picture is written to, a strip at a time, with colour profile and EXIF of the first picture, and
        with its place on the Earth where three pictures have a GPS position; without it the picture is made in memory.
    options : CompositeOptions
    threads : int
    progress : callable
    overwrite : bool
        Replace an existing world file.
    outputs : Outputs
        Where the files are staged.
    dry_run : bool
        Only plan.

    Raises
    ------
    OutputError
        When a file beside the output exists already.
    """
    release_free_heap()
    world_files = _files_beside(output, placed, overwrite)
    canvas = plan(placed, options)
    # A crop may yet make it fit.
    if output is not None and options.crop == "none":
        check_size(output, canvas.size)
        check_memory(output, canvas.size, options.max_memory)
    options = replace(options, workers=threads)
    read = [
        reader if part is None else partial(_read_near, reader, part)
        for reader, part in zip(readers(placed.sources), canvas.near or [None] * len(placed.sources), strict=True)
    ]
    if dry_run:
        pixels = read[0](_SMALLEST).pixels
        channels = 1 if pixels.ndim == 2 else pixels.shape[2]
        return Composed(canvas, plan=plan_composite(placed.cameras, canvas, options, channels, pixels.dtype.itemsize))

    def report(share: float) -> None:
        progress("compositing", round(100 * share), 100)

    if output is None:
        composite = compose(
            read,
            placed.cameras,
            placed.homographies,
            canvas,
            options,
            report,
            read,
            placed.exposures,
            placed.displacements,
        )
        return Composed(composite.canvas, composite, notes=composite.notes)
    return _into_file(placed, read, canvas, output, options, report, outputs, world_files)


def _files_beside(output: str | Path | None, placed: PlacedImages, overwrite: bool) -> tuple[Path, ...]:
    """The world files that will be written; they and the viewer's page must not exist, or be replaceable."""
    if output is None:
        return ()
    world_files = tuple(map(Path, world_file_paths(output))) if has_place(placed.positions) else ()
    page = viewer_path(output)
    for file in (*world_files, *([] if page is None else [page])):
        check_output(file, overwrite, suffixes=())
    return world_files


def _into_file(
    placed: PlacedImages,
    read: Sequence[Callable[..., Picture]],
    canvas: Canvas,
    output: str | Path,
    options: CompositeOptions,
    report: Callable[[float], None],
    outputs: Outputs,
    world_files: Sequence[Path],
) -> Composed:
    """The picture in its file, with its place on the Earth where that is known."""
    located: list[tuple[Georeference | None, str]] = []

    def tags(final: Canvas) -> list[ExtraTag]:
        located.append(georeference(placed.positions, placed.cameras, final.matrix @ placed.homographies))
        return located[0][0].tiff_tags() if located[0][0] is not None else []

    written = compose_to_file(
        output,
        read,
        placed.cameras,
        placed.homographies,
        canvas,
        options,
        placed.sources[0].metadata,
        report,
        tags,
        read,
        placed.exposures,
        placed.displacements,
        outputs=outputs,
    )
    place, note = located[0]
    if place is not None and world_files:
        for file, text in zip(world_files, place.world_file_texts(), strict=True):
            outputs.write(file, text_bytes(text))
    notes = (*written.notes, *([note] if note else []), *_profile_notes(placed.sources[0], Path(output)))
    return Composed(written.canvas, notes=notes, fingerprint=written.fingerprint, written=written)


def _profile_notes(source: Source, output: Path) -> list[str]:
    """Why the output lacks the colour profile of the picture whose metadata it has."""
    lost, size = source.metadata.profile_lost, len(source.metadata.icc_profile)
    if output.suffix.lower() == ".dzi" and size > LARGEST_TILE_PROFILE:
        lost = f"its colour profile of {size / 1e3:.0f} kB is too large to be in every tile"
    return [f"{source.name}: {lost}; colours are as if it had none"] if lost else []


def _read_near(read: Callable[..., Picture], part: NearPart, reduction: int = 1) -> Picture:
    """A picture, whole or reduced, of which only its near part is drawn."""
    return part.masked(read(reduction))
