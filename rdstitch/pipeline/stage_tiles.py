"""Recipe: tiles on a microscope's stage, at roughly known places, become one image or a table of places."""

import os
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rdstitch.arrays import evenly_spaced
from rdstitch.errors import ArgumentError, InputError
from rdstitch.export.places_files import fiji_list, places_table
from rdstitch.inputs.find import FoundImages
from rdstitch.inputs.frame import Frame, Images, frame_numbers
from rdstitch.inputs.source import Source, read_sources
from rdstitch.io.flat_field import FlatField
from rdstitch.io.reduction import mean_of_channels
from rdstitch.io.stored_tiles import StoredTile
from rdstitch.local_alignment import no_local_alignment
from rdstitch.options.files_beside import NOTHING_BESIDE, FilesBeside, ImageFiles
from rdstitch.options.option import options_of, with_fields
from rdstitch.options.stitch_options import StitchOptions
from rdstitch.options.tile_options import TileOptions
from rdstitch.pipeline.composition.flat_field import NO_FLAT_FIELD, with_flat_field
from rdstitch.pipeline.composition.lay_out import lay_out
from rdstitch.pipeline.outputs.output_files import OutputFiles
from rdstitch.pipeline.recipes import compose_registration
from rdstitch.pipeline.run import RecipeInput, Run
from rdstitch.pipeline.tiles_as_registration import tiles_as_registration
from rdstitch.results.messages import Message, left_out
from rdstitch.results.registration import Registration
from rdstitch.results.stitch_result import StitchResult
from rdstitch.stage.axes import with_measured_axes
from rdstitch.stage.coarse_tile import coarse_tile
from rdstitch.stage.estimate_flat_field import agrees_with_overlaps
from rdstitch.stage.grid import TileGrid
from rdstitch.stage.pair_candidates import SearchPlan
from rdstitch.stage.positions import Scan, grid_from_arrays, grid_from_names, grid_from_table, grid_from_tiles
from rdstitch.stage.register_tiles import LensEstimate, TileRegistration, register_tiles
from rdstitch.stage.sentences import axes_contradicted, neighbours_contradicted
from rdstitch.stage.tile_inputs import as_tiles, tile_frames
from rdstitch.system.native_threads import one_native_thread
from rdstitch.system.outputs import Outputs, text_bytes
from rdstitch.system.progress import Progress, silent

_SAMPLED_OVERLAPS = 32  # overlaps by which a flat field is judged
_FEW_WRONG = 0.01  # of the overlaps: of lines of a hundred tiles a hundredth is at the ends, and a wrong one is fewer


@one_native_thread()
def tiles(
    inputs: Images | Iterable[Any],
    output: str | Path | None = None,
    options: TileOptions | None = None,
    *,
    positions_file: str | Path | None = None,
    progress: Progress = silent,
    beside: ImageFiles = NOTHING_BESIDE,
    **fields: Any,
) -> StitchResult:
    """Stitch tiles taken on a stage, whose places are roughly known.

    Parameters
    ----------
    inputs : path, array, or iterable of them
        What :func:`rdstitch.mosaic` takes; or arrays of NumPy, Dask, Zarr and the like, (H, W) or with channels first
        or last, read when they are needed; or one array (N, …) of all tiles.
    output : path, optional
        As for :func:`rdstitch.mosaic`.
    options : TileOptions, optional
    positions_file : path, optional
        CSV file to write the places to as well; Fiji's list of tiles where its name ends in ``.txt``.
    progress
        As for :func:`rdstitch.mosaic`.
    beside : FilesBeside
        What else is written: report, layers, a project of Hugin.
    **fields
        Fields of the options, instead of those in ``options``: ``tiles(arrays, positions=places, pixel_size=0.65)``.

    Raises
    ------
    RdstitchError
        See the tree in :mod:`rdstitch.errors`.
    """
    options = with_fields(options_of(TileOptions, options), fields)
    given = _as_recipe_input(inputs, options)
    run = Run.of(given, output, FilesBeside.of(ImageFiles, beside, "tiles"), progress)
    with given.find_images(run.output) as images, run.outputs:
        files = _checked_files(images, run, options, positions_file)
        registration = _register(images, run, options, files)
        _write_beside(registration, run.outputs, positions_file, options)
        with run.executor(len(registration.sources)) as executor:
            chosen = lay_out(registration, no_local_alignment("tiles on a stage"), run.options.compositing)
            return compose_registration(chosen, run, files, executor)


def _as_recipe_input(tiles: Images | Iterable[Any], options: TileOptions) -> RecipeInput:
    """Tiles with what the stages after registration take of the options."""
    settings = StitchOptions(
        distortion=None if options.distortion == "auto" else options.distortion,
        composite=options.composite,
        **options.of_run,
    )
    return RecipeInput(as_tiles(tiles), settings, files=options.files)


@one_native_thread()
def place_tiles(
    inputs: Images | Iterable[Any],
    positions_file: str | Path | None = None,
    options: TileOptions | None = None,
    *,
    progress: Progress = silent,
    **fields: Any,
) -> tuple[TileRegistration, Registration]:
    """Find the places of tiles as :func:`tiles` does, and compose nothing.

    Parameters
    ----------
    positions_file : path, optional
        As for :func:`tiles`.
    inputs, options, progress, **fields
        As for :func:`tiles`.
    """
    options = with_fields(options_of(TileOptions, options), fields)
    given = _as_recipe_input(inputs, options)
    run = Run.of(given, progress=progress)
    with given.find_images() as images, run.outputs:
        files = _checked_files(images, run, options, positions_file)
        registration = _register(images, run, options, files)
        _write_beside(registration, run.outputs, positions_file, options)
    assert registration.tiles is not None
    return registration.tiles, registration


def _checked_files(
    images: FoundImages, run: Run, options: TileOptions, positions_file: str | Path | None
) -> OutputFiles:
    tables = [Path(file) for file in (positions_file, options.save_flat_field) if file is not None]
    names = [frame.name for frame in images.frames]
    files = OutputFiles.of_images(run, images.files, names, more_files=tables)
    files.check()
    return files


def _register(images: FoundImages, run: Run, options: TileOptions, files: OutputFiles) -> Registration:
    """Register all tiles that can be read."""
    frames, stored, notes = tile_frames(images.frames, options.z, options.time)
    limit = options.composite.max_memory
    sources, unread = read_sources(frames, skip_bad=not options.strict, guard=run.guard, max_memory=limit)
    files.check_places(sources)
    sources, excluded = _of_one_kind(sources, options.strict)
    missing = [*unread, *excluded]
    grid_of = partial(_grid, frames=frames, stored=stored, options=options)
    sources, tiled, messages = _placed_without_unreadable(sources, missing, grid_of, options, run.progress)
    registration = tiles_as_registration(sources, replace(tiled, z=options.z, time=options.time))
    return registration.with_messages([*images.messages, *notes, *messages])


def _placed_without_unreadable(
    sources: list[Source],
    missing: list[Message],
    grid_of: Callable[[list[Source]], TileGrid],
    options: TileOptions,
    progress: Progress,
) -> tuple[list[Source], TileRegistration, list[Message]]:
    """Place tiles; where samples of some turn out to be unreadable, without these, which are ``missing`` too then."""
    if len(sources) < 2:
        raise InputError(f"{missing[0].images[0]}: {missing[0].text}" if missing else "name two tiles or more")
    nominal = grid_of(sources)
    try:
        placed, tiled, messages = _placed(sources, nominal, options, progress)
        return placed, tiled, [*missing, *messages]
    except InputError:
        readable, unreadable = _readable(sources)
        if options.strict or not unreadable:
            raise
    return _placed_without_unreadable(readable, [*missing, *unreadable], grid_of, options, progress)


def _of_one_kind(sources: list[Source], strict: bool) -> tuple[list[Source], list[Message]]:
    """The tiles with as many channels and bits as most have, and why the others are left out."""
    kinds = []
    for source in sources:
        count, planes = source.metadata.channels, source.metadata.planes
        kinds.append((count if planes else 3 if count > 2 else 1, source.metadata.bit_depth))
    usual = Counter(kinds).most_common(1)[0][0] if kinds else (1, 8)
    excluded = []
    for source, kind in zip(sources, kinds, strict=True):
        if kind != usual:
            each = (f"{_channels(count)} of {bits}" for count, bits in (kind, usual))
            text = "has {} bits, but most tiles {}".format(*each)
            if strict:
                raise InputError(f"{source.path}: {text}")
            excluded.append(left_out(source.path, text))
    return [source for source, kind in zip(sources, kinds, strict=True) if kind == usual], excluded


def _readable(sources: Sequence[Source]) -> tuple[list[Source], list[Message]]:
    """The tiles that can be read, and why others cannot."""
    readable, unreadable = [], []
    for source in sources:
        try:
            source.read()
            readable.append(replace(source, flat_field=None))
        except InputError as error:
            unreadable.append(left_out(source.path, str(error)))
    return readable, unreadable


def _placed(
    sources: list[Source], nominal: TileGrid, options: TileOptions, progress: Progress
) -> tuple[list[Source], TileRegistration, list[Message]]:
    """Correct the illumination of the tiles and find their places; with messages."""
    if len({source.camera.image_size for source in sources}) > 1:
        text = "tiles of several sizes have no flat field in common"
        illumination = [Message(text, severity="note", code="flat-field")]
        if options.flat_field not in ("auto", "off") or options.distortion not in (None, "auto", 0.0):
            raise ArgumentError("tiles of several sizes have neither a flat field nor a lens in common")
    else:
        sources, illumination = with_flat_field(sources, options.flat_field)
    read = partial(_plane, sources, options.channel)
    plan = SearchPlan.of(nominal, options.search)
    factor = plan.factor
    grid, shown = with_measured_axes(nominal, lambda index: coarse_tile(read(index), factor), factor, plan.search)
    messages = [axes_contradicted(nominal.source, shown)] if shown else []
    if grid.pixel_size is not None:
        sources = [replace(s, metadata=replace(s.metadata, pixel_size=grid.pixel_size)) for s in sources]
    known = LensEstimate.FREE if options.distortion == "auto" else options.distortion
    lens = LensEstimate.IF_SHOWN if known is None else known
    tiled = register_tiles(replace(plan, grid=grid), read, distortion=lens, progress=progress)
    off, held = tiled.contradicting, int(tiled.adjustment.holding.sum())
    if len(off) > _FEW_WRONG * held:
        names = [sources[k].name for k in off[0].tolist()]
        messages.append(neighbours_contradicted(nominal.source, names, len(off), held))
    # Tiles without a neighbour are read too: one that cannot be is to be left out now, not fail the composition.
    for index in set(range(len(grid))) - set(tiled.compared.ravel().tolist()):
        read(index)
    field = sources[0].flat_field
    if options.flat_field == "auto" and field is not None and not _overlaps_show(field, sources, tiled):
        sources, illumination = [replace(source, flat_field=None) for source in sources], [NO_FLAT_FIELD]
    return sources, tiled, [*illumination, *messages]


def _overlaps_show(field: FlatField, sources: Sequence[Source], tiled: TileRegistration) -> bool:
    """Check whether the flat field, which was found without overlaps, makes these more alike."""
    raw = [replace(source, flat_field=None) for source in sources]
    pairs = tiled.links.tiles[tiled.adjustment.holding]
    chosen = pairs[evenly_spaced(len(pairs), _SAMPLED_OVERLAPS)]
    places = tiled.adjustment.places
    compared = ((raw[a].read().pixels, raw[b].read().pixels, places[b] - places[a]) for a, b in chosen.tolist())
    return agrees_with_overlaps(field, compared)


def _write_beside(registration: Registration, outputs: Outputs, file: str | Path | None, options: TileOptions) -> None:
    """Stage the table of places and the flat field, if wanted."""
    sources, tiled = registration.sources, registration.tiles
    if options.dry_run:
        return
    if file is not None and tiled is not None:
        names = [source.name for source in sources]
        places = tiled.adjustment.places - tiled.adjustment.places.min(axis=0)
        fiji = Path(file).suffix.lower() == ".txt"
        outputs.write(file, text_bytes(fiji_list(names, places) if fiji else places_table(names, tiled)))
    field = sources[0].flat_field
    if options.save_flat_field is not None and field is not None:
        with outputs.writing(options.save_flat_field) as staged:
            field.write(staged)


def _plane(sources: Sequence[Source], channel: int | None, index: int) -> NDArray[Any]:
    """Read the channel of a tile that is registered."""
    pixels = sources[index].read(keep=True).pixels
    count = 1 if pixels.ndim == 2 else pixels.shape[2]
    if channel is not None and channel >= count:
        raise ArgumentError(f"{sources[index].path}: has {_channels(count)}, none with the number {channel}")
    if pixels.ndim == 2:
        return pixels
    if channel is None:
        return mean_of_channels(pixels.astype(np.float32))
    return np.ascontiguousarray(pixels[..., channel])


def _channels(count: int) -> str:
    return "1 channel" if count == 1 else f"{count} channels"


def _grid(
    sources: Sequence[Source], frames: Sequence[Frame], stored: Mapping[Path, StoredTile], options: TileOptions
) -> TileGrid:
    """The nominal grid, counted over all files named, so that a missing tile moves no other."""
    sizes = np.array([source.camera.image_size for source in sources], dtype=np.intp)
    width, height = sizes.max(axis=0).tolist()
    size, pixel_size = (width, height), options.pixel_size or sources[0].metadata.pixel_size
    names = [source.name for source in sources]
    if options.grid is not None:
        scan = Scan(options.columns, options.order, options.origin)
        all_names = [frame.name for frame in frames]
        grid = grid_from_names(names, options.grid, options.overlap, size, scan, all_names)
        grid = replace(grid, pixel_size=pixel_size)
    elif isinstance(options.positions, str | os.PathLike):
        grid = grid_from_table(names, options.positions, size, pixel_size)
    elif options.positions is not None:
        lines = dict(zip(frames, frame_numbers(frames), strict=True))
        numbers = [lines[source.frame] for source in sources if source.frame is not None]
        grid = grid_from_arrays(options.positions, numbers, size, pixel_size, list(lines.values()))
    else:
        known = [stored.get(source.path) or StoredTile(source.path, {}) for source in sources]
        grid = grid_from_tiles(known, size, options.pixel_size)
    return grid if (sizes == sizes[0]).all() else replace(grid, tile_sizes=sizes)
