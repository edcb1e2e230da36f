"""Recomposing from a saved registration: other bands of the same flight, other sizes, other compositing options."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from rdstitch.compositing import CompositeOptions
from rdstitch.errors import InputError
from rdstitch.inputs.find import FoundImages
from rdstitch.inputs.frame import Frame, Images, as_inputs, files_of
from rdstitch.inputs.source import Source, read_sources
from rdstitch.matching.band_lens import BandLens, band_lens
from rdstitch.options.apply_options import ApplyOptions
from rdstitch.options.canvas_options import CanvasOptions
from rdstitch.options.option import declared, options_of, with_fields
from rdstitch.options.stitch_options import StitchOptions
from rdstitch.pipeline.composition.compose import CanvasLayout, compose_images
from rdstitch.pipeline.composition.straighten import reoriented
from rdstitch.pipeline.inputs.replacements import read_replacements
from rdstitch.pipeline.outputs.output_files import OutputFiles
from rdstitch.pipeline.outputs.viewer_pages import plainly_viewed, write_page
from rdstitch.pipeline.run import RecipeInput, Run
from rdstitch.results.messages import Message
from rdstitch.results.placed_images import PlacedImages, SavedGrid
from rdstitch.sidecar.read import SavedRegistration, mismatch_with_image, read_sidecar
from rdstitch.sidecar.recomposition import Recomposition
from rdstitch.sidecar.write import applied_sidecar
from rdstitch.stage.tile_inputs import with_position_folders
from rdstitch.system.native_threads import one_native_thread
from rdstitch.system.outputs import json_bytes
from rdstitch.system.progress import Progress, silent


@one_native_thread()
def apply(
    sidecar: str | Path | SavedRegistration,
    images: Images,
    output: str | Path | None = None,
    composite: CompositeOptions | None = None,
    *,
    options: ApplyOptions | None = None,
    progress: Progress = silent,
    **fields: Any,
) -> Recomposition:
    """Compose images by a registration that was found before; only the lens of another band is estimated.

    Parameters
    ----------
    sidecar : path or SavedRegistration
        What :func:`rdstitch.pano` or :func:`rdstitch.mosaic` wrote beside its image.
    images : path, ndarray, or iterable of them
        The same images, or others that were taken by the same lens from the same places: other bands, other sizes of
        the same shape, masks. Whatever :func:`rdstitch.mosaic` takes.
    output : path, optional
        Image to write, with a sidecar of its own beside it; without it the image is in the result.
    composite : CompositeOptions, optional
        All of them, instead of those of the sidecar.
    options : ApplyOptions, optional
    progress : callable
    **fields
        Fields of the options, instead of those in ``options``, in ``composite`` and in the sidecar:
        ``apply(sidecar, images, match="order", scale=0.5)``. ``workers`` are those of ``options``.

    Returns
    -------
    Recomposition
        The image, or what was written, with the images left out and what else the user should know.

    Raises
    ------
    InputError
        When the sidecar is none, or the images do not fit to it.
    RdstitchError
        See the tree in :mod:`rdstitch.errors`.
    """
    of_composite = declared(CompositeOptions).keys() - declared(ApplyOptions).keys()
    composing = {name: fields.pop(name) for name in of_composite & fields.keys()}
    options = with_fields(options_of(ApplyOptions, options), fields, of_composite)
    saved = sidecar if isinstance(sidecar, SavedRegistration) else read_sidecar(sidecar)
    mismatch = mismatch_with_image(saved)
    if options.strict and mismatch:
        raise InputError(mismatch)
    chosen = options_of(CompositeOptions, composite or saved.composite, "composite")
    chosen = chosen.overridden(**composing)
    named = as_inputs(images, options.channel_order)
    if saved.record.stage is not None:
        named = with_position_folders(named)
    settings = settings_of(saved, chosen, options)
    files = [saved.path, *options.files, *settings.files]
    given = RecipeInput(named, settings, every=options.every, files=files)
    run = Run.of(given, output, progress=progress)
    with given.find_images(run.output) as replacements, run.outputs:
        OutputFiles.of_images(run, replacements.files).check()
        result = apply_to_images(saved, replacements, run, options)
    return replace(result, messages=(*([Message(mismatch)] if mismatch else []), *result.messages))


def settings_of(saved: SavedRegistration, composite: CompositeOptions, options: ApplyOptions) -> StitchOptions:
    """The options of the stages after registration."""
    return StitchOptions(
        composite=composite,
        reference=saved.images[saved.reference].name,
        channel_order=options.channel_order,
        **options.of_run,
    )


def apply_to_images(saved: SavedRegistration, images: FoundImages, run: Run, options: ApplyOptions) -> Recomposition:
    """Compose the images found by a saved registration; with a file as output, stage it."""
    output = run.output
    given = read_replacements(saved, images.frames, options, run.guard, run.options.composite.max_memory)
    placed = saved.record.output.place is not None
    OutputFiles.of_images(run, ()).check_places(list(given.sources.values()), placed=placed)
    band = _compare_bands(saved, given.sources, run.progress)
    layout, of_turn = _laid_out(saved, given.sources, band.lens, run.options.compositing)
    composed, of_output = compose_images(layout, run)
    of_band = [] if band.note is None else [band.note]
    sources = dict(zip(given.sources, layout.placed.sources, strict=True))
    result = Recomposition(
        saved=saved,
        sources=tuple(map(sources.get, range(len(saved.images)))),
        matched=given.matched,
        left_out=given.left_out,
        messages=(*given.messages, *of_band, *of_turn, *images.messages, *run.guard.messages, *of_output),
        **composed.fields,
    )
    if options.dry_run or output is None:
        return result
    page = partial(plainly_viewed, result.canvas, [source.name for source in sources.values()])
    result = replace(result, messages=(*result.messages, *write_page(result, run.outputs, page)))
    run.outputs.write(f"{output}.json", json_bytes(applied_sidecar(result, same_lens=band.lens is None)))
    return result


def _laid_out(
    saved: SavedRegistration, sources: Mapping[int, Source], lens: BandLens | None, composite: CompositeOptions
) -> tuple[CanvasLayout, list[Message]]:
    """Lay the images out as the sidecar has them, corrected for the lens of their band."""
    if lens is not None:
        sources = {index: replace(source, camera=lens.camera(source.camera)) for index, source in sources.items()}
    placed, of_turn = reoriented(_placed(saved, sources, lens), composite, saved.composite)
    if (grid := _same_grid(saved, sources, composite)) is not None:
        placed = replace(placed, grid=grid)
    return CanvasLayout.of(placed, composite), of_turn


def _same_grid(saved: SavedRegistration, used: Mapping[int, Source], options: CompositeOptions) -> SavedGrid | None:
    """The pixel grid of the saved output, if images of the same sizes and options are to be on the same one."""
    matrix, size = saved.plane_to_output, saved.record.output.size
    same_sizes = all(saved.images[index].size == source.camera.image_size for index, source in used.items())
    alike = same_sizes and not saved.turned and options.agrees(saved.composite, CanvasOptions)
    place = saved.record.output.place
    return SavedGrid(matrix, size, place) if alike and matrix is not None and size is not None else None


@dataclass(frozen=True)
class _BandComparison:
    """What the lens of the given images is, against that of the registered ones."""

    lens: BandLens | None = None  # None: the same, as far as is known
    note: Message | None = None


def _compare_bands(saved: SavedRegistration, used: Mapping[int, Source], progress: Progress) -> _BandComparison:
    """Estimate the lens of the given images, if it is not the one that took the registered images."""
    if saved.record.stage is not None:
        return _BandComparison()  # channels of a microscope have their places in common, not their content
    frames = {index: source.frame or Frame(source.path) for index, source in used.items()}
    files = files_of(frame for frame in frames.values() if frame.number is None)
    originals = {k: file for k in frames if (file := saved.original(saved.images[k])) is not None}
    if files and not originals:
        name = saved.images[next(iter(frames))].path
        text = f"the registered images are not there any more ({name}, …): whether the same lens took the given ones, "
        return _not_compared(saved, f"{text}from the same places, was not compared")
    elsewhere = {k: file for k, file in originals.items() if file.resolve() != frames[k].path.resolve()}
    pairs: dict[int, tuple[Source, Source]] = {}
    for index, file in elsewhere.items():
        camera, size = saved.images[index].camera, used[index].camera.image_size
        if camera is not None and frames[index].number is None and camera.image_size == size:
            read, _ = read_sources([Frame(file)], skip_bad=True)
            if read and read[0].metadata.size == size:
                pairs[index] = replace(read[0], camera=camera), used[index]
    lens = band_lens(pairs, lambda done, total: progress("comparing bands", done, total))
    if lens is None and pairs:
        text = (
            "the given images show nothing that the registered ones do: whether the same lens took them, from the same "
        )
        return _not_compared(saved, f"{text}places (see --match), is not known")
    if lens is None or lens.is_same:
        return _BandComparison()
    text = f"{lens.shift:.1f} pixels (median) from the registered band, {lens.error:.1f} with its lens registered too"
    return _BandComparison(lens, Message(text, severity="note", code="band-lens"))


def _not_compared(saved: SavedRegistration, text: str) -> _BandComparison:
    return _BandComparison(note=Message(f"{saved.path}: {text}", severity="note"))


def _placed(saved: SavedRegistration, used: Mapping[int, Source], lens: BandLens | None) -> PlacedImages:
    """The images with the homographies of the sidecar, corrected for the lens of their band."""
    to_registered = np.eye(3) if lens is None else np.linalg.inv(lens.homography)
    return PlacedImages(
        list(used.values()),
        np.array([saved.images[index].to_plane for index in used], dtype=np.float64) @ to_registered,
        list(used).index(saved.reference) if saved.reference in used else None,
        [
            None if field is None else field.resized(source.camera.image_size)
            for field, source in ((saved.images[index].displacement_field, source) for index, source in used.items())
        ],
        saved.turned,
        saved.place,
        tiles=saved.record.stage is not None,
        orientation=saved.orientation,
    )
