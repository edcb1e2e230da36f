"""The last stage of every picture: from registered pictures to pixels, in memory or in a file."""

from dataclasses import dataclass, replace
from pathlib import Path

from rdstitch.compositing import (
    Canvas,
    Composite,
    CompositeOptions,
    CompositePlan,
    FileComposite,
    OutputFile,
    compose,
    compose_to_file,
    plan_composite,
)
from rdstitch.compositing.blocks import BlockRunner
from rdstitch.export.georeference import Georeference, georeference, has_place, world_file_paths
from rdstitch.inputs.source import Source
from rdstitch.io.atomic import check_output, text_bytes
from rdstitch.io.deepzoom import MAX_TILE_PROFILE
from rdstitch.io.fingerprint import Fingerprint
from rdstitch.io.outputs import Outputs
from rdstitch.io.tiff import ExtraTag
from rdstitch.io.write import check_memory, check_size
from rdstitch.messages import Message
from rdstitch.pipeline.placed_images import PlacedImages, plan
from rdstitch.process_memory import release_free_heap
from rdstitch.progress import Progress
from rdstitch.viewer import viewer_path

# Reduction of a picture of which only the kind of its samples is wanted.
_PROBE_REDUCTION = 8


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
    messages : tuple of Message
        What the user should know, such as why nothing was cropped.
    fingerprint : Fingerprint or None
        Size and digest of the file.
    written : FileComposite or None
        The picture in its file.
    """

    canvas: Canvas
    composite: Composite | None = None
    plan: CompositePlan | None = None
    messages: tuple[Message, ...] = ()
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
    elsewhere: BlockRunner | None = None,
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
    elsewhere : callable, optional
        See :func:`rdstitch.compositing.compose`.
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
    pictures = placed.pictures(canvas.near)
    if dry_run:
        preview = pictures[0].preview
        assert preview is not None
        pixels = preview(_PROBE_REDUCTION).pixels
        channels = 1 if pixels.ndim == 2 else pixels.shape[2]
        return Composed(canvas, plan=plan_composite(placed.cameras, canvas, options, channels, pixels.dtype.itemsize))

    def report(share: float) -> None:
        progress("compositing", round(100 * share), 100)

    if output is None:
        composite = compose(pictures, canvas, options, report, elsewhere)
        return Composed(composite.canvas, composite, messages=(*_masked(placed), *composite.messages))
    located: list[tuple[Georeference | None, str]] = []

    def tags(final: Canvas) -> list[ExtraTag]:
        located.append(georeference(placed.positions, placed.cameras, final.matrix @ placed.homographies))
        return located[0][0].tiff_tags() if located[0][0] is not None else []

    file = OutputFile(output, placed.sources[0].metadata, tags, outputs)
    written = compose_to_file(file, pictures, canvas, options, report, elsewhere)
    place, note = located[0]
    if place is not None and world_files:
        for path, text in zip(world_files, place.world_file_texts(), strict=True):
            outputs.write(path, text_bytes(text))
    messages = (
        *_masked(placed),
        *written.messages,
        *([Message(note)] if note else []),
        *_profile_lost(placed.sources[0], Path(output)),
    )
    return Composed(written.canvas, messages=messages, fingerprint=written.fingerprint, written=written)


def _masked(placed: PlacedImages) -> list[Message]:
    """What was left out of every picture."""
    if placed.static is None:
        return []
    share = float(placed.static.mean())
    return [Message(f"{share:.0%} of every picture is black, or stays where it is, in all of them, and was masked")]


def _files_beside(output: str | Path | None, placed: PlacedImages, overwrite: bool) -> tuple[Path, ...]:
    """The world files that will be written; they and the viewer's page must not exist, or be replaceable."""
    if output is None:
        return ()
    world_files = tuple(map(Path, world_file_paths(output))) if has_place(placed.positions) else ()
    page = viewer_path(output)
    for file in (*world_files, *([] if page is None else [page])):
        check_output(file, overwrite, suffixes=())
    return world_files


def _profile_lost(source: Source, output: Path) -> list[Message]:
    """Why the output lacks the colour profile of the picture whose metadata it has."""
    lost, size = source.metadata.profile_lost, len(source.metadata.icc_profile)
    if output.suffix.lower() == ".dzi" and size > MAX_TILE_PROFILE:
        lost = f"its colour profile of {size / 1e3:.0f} kB is too large to be in every tile"
    return [Message(f"{lost}; colours are as if it had none", (str(source.path),))] if lost else []
