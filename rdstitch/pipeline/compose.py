"""The last stage of every image: from registered images to pixels, in memory or in a file with a page beside it."""

from collections.abc import Callable, Generator, Iterable, Sequence
from concurrent.futures import Executor, ThreadPoolExecutor
from contextlib import closing
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Self

import numpy as np

from rdstitch.alignment.result import links_by_image
from rdstitch.compositing import (
    Canvas,
    Composite,
    CompositeOptions,
    Decisions,
    FileComposite,
    PlacedImage,
    SeamQuality,
    compose_decided,
    compose_to_file,
    decide,
    planned,
)
from rdstitch.compositing.boxes import Box
from rdstitch.compositing.projection import PLANE
from rdstitch.compositing.tiles import Block, BlockRunner, OutputStrip
from rdstitch.executors import in_order
from rdstitch.export.georeference import Georeference, world_file_paths
from rdstitch.export.place_on_map import has_place
from rdstitch.inputs.input_guard import GuardState
from rdstitch.inputs.source import Source
from rdstitch.io.colour import colour_space
from rdstitch.io.deepzoom import MAX_TILE_PROFILE
from rdstitch.io.formats import check_memory, check_size
from rdstitch.io.metadata import Metadata
from rdstitch.io.tiff import ExtraTag
from rdstitch.options.upright_options import Corners
from rdstitch.pipeline.map_canvas import moved, place_messages, plan_on_map
from rdstitch.pipeline.placed_images import PlacedImages
from rdstitch.pipeline.run import Run
from rdstitch.results.messages import MAX_NAMED, Message, names_of, shortened
from rdstitch.results.stitch_result import OutputImage, StitchResult
from rdstitch.system.cache import Cache, Stored
from rdstitch.system.outputs import Outputs, check_outputs, text_bytes
from rdstitch.system.process_memory import return_freed_memory
from rdstitch.viewer.page import ViewedImage, viewer_page, viewer_path

_VISIBLE_CUT = 0.02  # share of the images that is cut away, from which on it is said


@dataclass(frozen=True)
class Layout:
    """Images on a canvas, and what was decided on small versions of them."""

    placed: PlacedImages
    canvas: Canvas
    images: Sequence[PlacedImage]
    georeference: Georeference | None
    not_georeferenced: str  # why
    decisions: Decisions | None = None
    photographs: bool = True  # whether seams are to be judged as a person sees them

    @classmethod
    def of(cls, placed: PlacedImages, options: CompositeOptions) -> Self:
        """Plan the canvas."""
        canvas, place, reason = plan_on_map(placed, options)
        if options.rectangle is not None:
            canvas = replace(canvas, cropped_to=_box_of_rectangle(placed, options.rectangle, canvas))
        return cls(placed, canvas, placed.images(canvas.near), place, reason)

    def decided(self, options: CompositeOptions, threads: int) -> Self:
        """With exposure and seams."""
        return replace(self, decisions=decide(self.images, self.canvas, replace(options, workers=threads)))

    @property
    def seams(self) -> SeamQuality:
        """What its seams are like."""
        return SeamQuality() if self.decisions is None else self.decisions.quality


def compose_images(
    layout: Layout, run: Run, outputs: Outputs, elsewhere: BlockRunner | None = None
) -> tuple[OutputImage, list[Message]]:
    """See whether a file can hold the canvas, and put the images on it; of a dry run the plan alone.

    Without an output the image is made in memory; a file has colour profile and EXIF of the first image, and its place
    on the Earth. ``elsewhere``: see :func:`rdstitch.compositing.compose_decided`. With it comes what the user should
    know, such as why nothing was cropped.
    """
    return_freed_memory()
    threads = run.options.threads
    options = replace(run.options.composite, workers=threads)
    placed, canvas, place, output = layout.placed, layout.canvas, layout.georeference, run.output
    messages = [
        *_masked(placed),
        *place_messages(place, layout.not_georeferenced, placed),
        *_cut_away(placed, canvas, options),
    ]
    # A crop may yet make it fit.
    if output is not None and options.crop == "none":
        check_size(output, canvas.size)
        check_memory(output, canvas.size, options.max_memory)
    composed = OutputImage(
        canvas=canvas,
        options=run.options,
        output=None if output is None else Path(output),
        georeference=place,
        not_georeferenced=layout.not_georeferenced,
    )
    if run.options.dry_run:
        return replace(composed, plan=planned(layout.images, canvas, options)), messages
    layout = layout if layout.decisions is not None else layout.decided(options, threads)
    assert layout.decisions is not None
    if layout.photographs:
        messages += seam_messages(layout.seams, [str(source.path) for source in placed.sources])

    def report(share: float) -> None:
        run.progress("compositing", round(100 * share), 100)

    def tags(final: Canvas) -> list[ExtraTag]:
        on_final = moved(place, canvas, final)
        return [] if on_final is None else on_final.tiff_tags()

    made: Composite | FileComposite
    if output is None:
        made = composite = compose_decided(layout.decisions, report, elsewhere)
        composed = replace(composed, composite=composite)
    else:
        metadata = _metadata(placed.sources[0], options)
        made = written = compose_to_file(
            output, layout.decisions, report, elsewhere, metadata=metadata, extra_tags=tags, outputs=outputs
        )
        composed = replace(composed, written=written)
    place = moved(place, canvas, made.canvas)
    messages += made.messages
    if output is not None:
        messages += [*_profile_lost(placed.sources[0], Path(output)), *_profiles_differ(placed.sources)]
        if place is not None and (files := world_file_paths(output) if placed.has_place else ()):
            messages += outputs.attempt(files[0], partial(_write_world_files, outputs, files, place))
    return replace(composed, canvas=made.canvas, georeference=place, seams=layout.seams), messages


def _metadata(source: Source, options: CompositeOptions) -> Metadata:
    """That of the output, as of its first image; its pixels have another size where they were scaled."""
    metadata = source.metadata.of_composite()
    if metadata.pixel_size is None:
        return metadata
    return replace(metadata, pixel_size=None if options.max_size is not None else metadata.pixel_size / options.scale)


def _cut_away(placed: PlacedImages, canvas: Canvas, options: CompositeOptions) -> list[Message]:
    """How much of the images has no place in the output."""
    if placed.grid is not None or options.like is not None or options.extent is not None:
        return []
    share = canvas.cut_away(placed.cameras, placed.homographies)
    text = f"{share:.0%} of what the images show is cut away: it would be stretched over {options.max_stretch:g} times"
    if placed.turned and canvas.projection == PLANE:
        text += "; --projection cylinder or sphere shows more"
    return [Message(text, severity="note")] if share > _VISIBLE_CUT else []


def seam_messages(seams: SeamQuality, paths: Sequence[str]) -> list[Message]:
    """Where seams are broken, a warning where a person sees it, else a detail; of overlaps that are unlike, one warning
    where no seams hold that say otherwise.
    """
    hold = len(seams.places) and not seams.seen
    if seams.contradicted and not hold and seams.least_alike is not None:
        images = tuple(paths[k] for k in seams.least_alike)
        text = (
            f"only {seams.alike:.0%} of what the images share looks alike, the least between "
            f"{' and '.join(names_of(images))}: something that fills a part of them (a vehicle, a mount) may have been "
            "registered instead of the scene; mask it"
        )
        return [Message(text, images, code="rival-motion")]
    if not seams.breaks:
        return []
    worst = list({one.images: one for one in reversed(seams.breaks)}.values())[::-1][:MAX_NAMED]
    told = []
    for one in worst:
        (x, y), (first, second) = one.position, names_of(paths[k] for k in one.images)
        told.append(f"a break of {one.length:.0f} pixels at ({x:.0f}, {y:.0f}), between {first} and {second}")
    more = f", and {rest} more" if (rest := len(seams.breaks) - len(worst)) else ""
    text = f"{'; '.join(told)}{more}: something moved, or is nearer than the rest; leave one of the two out, or mask it"
    images = tuple(dict.fromkeys(paths[k] for one in worst for k in one.images))
    return [Message(text, images, "warning" if seams.visible else "detail", code="seam-break")]


def _box_of_rectangle(placed: PlacedImages, corners: Corners, canvas: Canvas) -> Box | None:
    """Where the rectangle that the user has named lies on the canvas; None where its corners have no place there."""
    index = placed.reference
    if index is None:
        return None
    places = canvas.place(placed.cameras[index], placed.homographies[index], np.reshape(corners, (4, 2)))
    if not np.isfinite(places).all():
        return None
    low = np.clip(np.rint(places.min(axis=0)), 0, canvas.size).astype(int)
    high = np.clip(np.rint(places.max(axis=0)) + 1, 0, canvas.size).astype(int)
    return (*low.tolist(), *high.tolist()) if (high > low).all() else None


def _masked(placed: PlacedImages) -> list[Message]:
    """What was left out of every image."""
    if placed.static is None:
        return []
    share = float(placed.static.mean())
    text = f"{share:.0%} of every image is black, or stays where it is, in all of them, and was masked"
    return [Message(text, severity="detail")]


def image_files(output: str | Path) -> list[Path]:
    """An image and what always belongs to it: the sidecar, and the page of a Deep Zoom image."""
    page = viewer_path(output)
    return [Path(output), Path(f"{output}.json"), *([] if page is None else [page])]


def check_world_files(outputs: Iterable[str | Path], sources: Sequence[Source], overwrite: bool) -> None:
    """Find out before long work whether the files that place images on the Earth can be written, if there will be."""
    if has_place([source.metadata.gps for source in sources]) or any(source.control for source in sources):
        check_outputs([file for output in outputs for file in world_file_paths(output)], overwrite)


def _write_world_files(outputs: Outputs, paths: Sequence[Path], place: Georeference) -> None:
    for path, text in zip(paths, place.world_file_texts(), strict=True):
        outputs.write(path, text_bytes(text))


def _profile_lost(source: Source, output: Path) -> list[Message]:
    """Why the output lacks the colour profile of the image whose metadata it has."""
    lost, size = source.metadata.profile_lost, len(source.metadata.icc_profile)
    if output.suffix.lower() == ".dzi" and size > MAX_TILE_PROFILE:
        lost = f"its colour profile of {size / 1e3:.0f} kB is too large to be in every tile"
    return [Message(f"{lost}; colours are as if it had none", (str(source.path),))] if lost else []


def _profiles_differ(sources: Sequence[Source]) -> list[Message]:
    """Which images have other colours than those of the output, whose profile is the first image's."""
    spaces = [colour_space(source.metadata.icc_profile) for source in sources]
    others = [str(source.path) for source, space in zip(sources, spaces, strict=True) if space != spaces[0]]
    if not others:
        return []
    what = f"another colour profile than {sources[0].name}, whose the output has"
    who = "has" if len(others) == 1 else f"{len(others)} of the images ({shortened(names_of(others))}) have"
    text = f"{who} {what}: their colours are off; convert them to one colour space first"
    return [Message(text, tuple(others), code="colour-profiles")]


def blocks_on(executor: Executor, sources: Sequence[Source], folder: Path | None) -> BlockRunner | None:
    """What computes blocks of an output on the workers of an executor; None for threads, which need no blocks.

    ``folder`` is what all machines see by the same name, for the strips; None where there is one machine.
    """
    if isinstance(executor, ThreadPoolExecutor):
        return None

    def run(blocks: Iterable[Block]) -> Generator[list[Stored[OutputStrip]]]:
        store = Cache.for_this_run(folder)
        tasks = ((block, [sources[k] for k in block.images]) for block in blocks)
        with closing(in_order(executor, partial(compose_block, store=store), tasks)) as done:
            for strips, notes in done:
                sources[0].guard.merge(notes)
                yield strips

    return run


def compose_block(
    task: tuple[Block, Sequence[Source]], *, store: Cache
) -> tuple[list[Stored[OutputStrip]], GuardState]:
    """Compute a block of these images into a store; and what was noticed of their files."""
    block, sources = task
    strips = block.compute(store)
    # All have one guard, which travels with them.
    return strips, sources[0].guard.state_of([source.path for source in sources]) if sources else ({}, {})


def write_page(result: OutputImage, outputs: Outputs, images: Callable[[], Sequence[ViewedImage]]) -> list[Message]:
    """Write the page of a ``.dzi`` output; others have none. A warning, where it cannot be written."""
    output, written = result.output, result.written
    if output is None or written is None or (page := viewer_path(output)) is None:
        return []
    gsd = None if result.georeference is None else result.georeference.gsd

    def stage() -> None:
        text = viewer_page(output, result.canvas.size, images(), written.seams, written.origin, gsd)
        # Names of files need not be UTF-8.
        outputs.write(page, text.encode("utf-8", "backslashreplace"))

    return outputs.attempt(page, stage)


def plainly_viewed(canvas: Canvas, names: Sequence[str]) -> list[ViewedImage]:
    """The images on a canvas, of which nothing was estimated."""
    return [ViewedImage(name, outlines, ()) for name, outlines in zip(names, canvas.outlines, strict=True)]


def viewed_images(result: StitchResult) -> list[ViewedImage]:
    """The images of a result with what was found of each."""
    alignment, registration = result.registration.alignment, result.registration
    names = [source.name for source in registration.sources]
    links_of = links_by_image(fit for fit in alignment.links if fit.used)
    viewed = []
    for outlines, index in zip(result.canvas.outlines, np.flatnonzero(alignment.used).tolist(), strict=True):
        source = registration.sources[index]
        links = links_of.get(index, [])
        facts = [
            ("size", "{} x {} pixels".format(*source.camera.image_size)),
            ("features", str(registration.keypoints[index])),
            ("matches", str(sum(fit.inliers for fit in links))),
        ]
        partners = [f"{names[fit.image1 + fit.image2 - index]} ({fit.inliers}, {fit.rms:.2f} pixels)" for fit in links]
        facts.append(("pairs", ", ".join(partners)))
        if alignment.poses is not None:
            poses = alignment.poses
            facts += [
                ("position", "{:.3f}, {:.3f} heights".format(*poses.position[index])),
                ("height", f"{poses.height[index]:.3f}"),
                ("yaw", f"{np.degrees(poses.yaw[index]):.2f}°"),
                ("tilt", "{:.2f}°, {:.2f}°".format(*np.degrees(poses.tilt[index]))),
            ]
        if index == alignment.reference:
            facts.append(("reference", "yes"))
        viewed.append(ViewedImage(names[index], outlines, tuple(facts)))
    return viewed
