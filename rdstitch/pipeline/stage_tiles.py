"""Tiles on a stage: from files whose places are roughly known to one image, or to a table of places."""

import math
import os
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import PIL.Image
from numpy.typing import NDArray

from rdstitch.alignment import Alignment
from rdstitch.alignment.result import LinkFit, ReliefTest, Unused
from rdstitch.arrays import FloatArray, evenly_spaced
from rdstitch.errors import ArgumentError, InputError, RegistrationError
from rdstitch.export.places_files import fiji_list, places_table
from rdstitch.features import Correspondences
from rdstitch.geometry.camera import Camera
from rdstitch.geometry.radial_homography import RadialHomography
from rdstitch.inputs.find import FoundImages, found_images
from rdstitch.inputs.frame import Frame, Images, Named, array_as_image, as_inputs
from rdstitch.inputs.input_guard import InputGuard
from rdstitch.inputs.source import Source, read_sources
from rdstitch.io.metadata import Metadata
from rdstitch.io.read import DecodedImage, as_image
from rdstitch.io.reduction import mean_of_channels
from rdstitch.io.stored_tiles import StoredTile
from rdstitch.local_alignment import no_local_alignment
from rdstitch.matching.feature_store import StoredMatches
from rdstitch.matching.two_view import PairRegistration
from rdstitch.options.files_beside import NOTHING_BESIDE, FilesBeside
from rdstitch.options.stitch_options import StitchOptions
from rdstitch.options.tile_options import TileOptions
from rdstitch.pipeline.choose_layout import lay_out
from rdstitch.pipeline.compose import check_world_files
from rdstitch.pipeline.output_plan import check_run
from rdstitch.pipeline.read_inputs import NO_FLAT_FIELD, with_flat_field
from rdstitch.pipeline.recipes import compose_registration
from rdstitch.pipeline.run import Run
from rdstitch.results.messages import MAX_NAMED, Message, left_out, names_of, shortened
from rdstitch.results.registration import Registration
from rdstitch.results.stitch_result import StitchResult
from rdstitch.stage.axes import with_axes_shown
from rdstitch.stage.correlation import coarse_tile
from rdstitch.stage.estimate_flat_field import agrees_with_overlaps
from rdstitch.stage.grid import TileGrid
from rdstitch.stage.positions import (
    Scan,
    grid_from_arrays,
    grid_from_names,
    grid_from_table,
    grid_from_tiles,
)
from rdstitch.stage.register_tiles import (
    SearchPlan,
    TileRegistration,
    register_tiles,
)
from rdstitch.stage.tile_frames import tile_frames, with_position_folders
from rdstitch.system.opencv_state import one_opencv_thread
from rdstitch.system.outputs import Outputs, text_bytes
from rdstitch.system.progress import Progress, StageTimer, silent

_COMPARED = 32  # overlaps by which a flat field is judged


@one_opencv_thread()
def tiles(
    inputs: Images | Iterable[Any],
    output: str | Path | None = None,
    options: TileOptions | None = None,
    *,
    positions_file: str | Path | None = None,
    progress: Progress = silent,
    beside: FilesBeside = NOTHING_BESIDE,
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
    progress, beside
        As for :func:`rdstitch.mosaic`.
    **fields
        Fields of the options, instead of those in ``options``: ``tiles(arrays, positions=places, pixel_size=0.65)``.

    Raises
    ------
    RdstitchError
        See the tree in :mod:`rdstitch.errors`.
    """
    options = replace(options or TileOptions(), **fields)
    run = Run(_stitch_options(options), output, beside, StageTimer(progress))
    with found_images(_as_tiles(inputs), output=output, topic=options.topic) as listed:
        registration, tiled = _registered(listed, run, options, positions_file)
        with Outputs(options.overwrite) as outputs, run.executor(len(registration.sources)) as executor:
            _write_beside(outputs, positions_file, options, registration, tiled)
            chosen = lay_out(registration, no_local_alignment("tiles on a stage"), options.composite)
            chosen = replace(chosen, layout=replace(chosen.layout, photographs=False))
            return compose_registration(chosen, run, outputs, executor)


def _stitch_options(options: TileOptions) -> StitchOptions:
    """What the stages after registration take of the options."""
    return StitchOptions(
        distortion=None if options.distortion == "auto" else options.distortion,
        composite=options.composite,
        overwrite=options.overwrite,
        dry_run=options.dry_run,
        workers=options.workers,
    )


@one_opencv_thread()
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
    options = replace(options or TileOptions(), **fields)
    with found_images(_as_tiles(inputs), topic=options.topic) as listed:
        run = Run(_stitch_options(options), progress=StageTimer(progress))
        registration, tiled = _registered(listed, run, options, positions_file)
    with Outputs(options.overwrite) as outputs:
        _write_beside(outputs, positions_file, options, registration, tiled)
    return tiled, registration


def _as_tiles(inputs: Any) -> list[Named]:
    """What the user gave as a list of files and images."""
    if not isinstance(inputs, str | os.PathLike | PIL.Image.Image) and getattr(inputs, "ndim", 0) in (3, 4):
        inputs = [inputs[k] if isinstance(inputs, np.ndarray) else _Part(inputs, k) for k in range(inputs.shape[0])]
    if isinstance(inputs, str | os.PathLike | PIL.Image.Image):
        return with_position_folders(as_inputs(inputs))
    return with_position_folders(as_inputs([_as_tile(item, index) for index, item in enumerate(inputs)]))


class _Part:
    """One tile of an array of all, which is read when it is needed."""

    def __init__(self, whole: Any, index: int) -> None:
        self._whole, self._index = whole, index
        self.shape, self.dtype = tuple(whole.shape[1:]), whole.dtype

    def __array__(self, dtype: Any = None, copy: Any = None) -> NDArray[Any]:
        """The tile in memory."""
        return np.asarray(self._whole[self._index])


def _as_tile(item: Any, index: int) -> Any:
    """An array whose channels come first, or that is not in memory, which is read when it is needed; others stay."""
    if isinstance(item, str | os.PathLike | PIL.Image.Image | Frame) or not hasattr(item, "shape"):
        return item
    shape, name = tuple(item.shape), Path(f"image_{index:04d}")
    planes = len(shape) == 3 and shape[0] < min(shape[1:])
    if isinstance(item, np.ndarray) and not planes:
        return item
    if len(shape) not in (2, 3):
        raise ArgumentError(f"tile {index}: expected an array of two or three dimensions, not of shape {shape}")
    height, width, *channels = (*shape[1:], shape[0]) if planes else shape
    bits = 8 * np.dtype(item.dtype).itemsize
    metadata = Metadata((width, height), bit_depth=bits, channels=(channels or [1])[0], planes=planes)

    def load() -> DecodedImage:
        samples = np.asarray(item)
        if planes:
            return as_image(name, np.moveaxis(samples, 0, -1), None, metadata)
        return array_as_image(str(name), samples, "bgr")

    return Frame(name, index, load=load, metadata=metadata)


def _registered(
    listed: FoundImages, run: Run, options: TileOptions, positions_file: str | Path | None
) -> tuple[Registration, TileRegistration]:
    """The places of all tiles, once it is clear that everything can be written."""
    positions = options.positions if isinstance(options.positions, str | os.PathLike) else None
    read = [positions, None if options.flat_field in ("auto", "off") else options.flat_field]
    check_run(
        run,
        [*listed.files, *(file for file in read if file is not None)],
        [frame.name for frame in listed.frames],
        others=[Path(file) for file in (positions_file, options.save_flat_field) if file is not None],
    )
    guard = InputGuard(options.strict)
    frames, stored, notes = tile_frames(listed.frames, options.z, options.time)
    limit = options.composite.max_memory
    sources, unread = read_sources(frames, skip_bad=not options.strict, guard=guard, max_memory=limit)
    check_world_files([] if run.output is None else [run.output], sources, options.overwrite)
    sources, odd = _of_one_kind(sources, options.strict)
    unread += odd
    while True:
        if len(sources) < 2:
            raise InputError(f"{unread[0].images[0]}: {unread[0].text}" if unread else "name two tiles or more")
        nominal = _grid(sources, stored, options)
        try:
            sources, tiled, said = _placed(sources, nominal, options, run.progress)
            break
        except InputError:
            sources, damaged = _readable(sources)
            if options.strict or not damaged:
                raise
            unread += damaged
    tiled = replace(tiled, z=options.z, time=options.time)
    return _registration(sources, tiled).with_messages([*unread, *listed.messages, *notes, *said]), tiled


def _of_one_kind(sources: list[Source], strict: bool) -> tuple[list[Source], list[Message]]:
    """The tiles with as many channels and bits as most have, and why the others are left out."""
    kinds = []
    for source in sources:
        count, planes = source.metadata.channels, source.metadata.planes
        kinds.append((count if planes else 3 if count > 2 else 1, source.metadata.bit_depth))
    usual = Counter(kinds).most_common(1)[0][0] if kinds else (1, 8)
    left = []
    for source, kind in zip(sources, kinds, strict=True):
        if kind != usual:
            text = "has {} of {} bits, but most tiles {} of {}".format(
                *(part for count, bits in (kind, usual) for part in (_channels(count), bits))
            )
            if strict:
                raise InputError(f"{source.path}: {text}")
            left.append(left_out(source.path, text))
    return [source for source, kind in zip(sources, kinds, strict=True) if kind == usual], left


def _readable(sources: Sequence[Source]) -> tuple[list[Source], list[Message]]:
    """The tiles that can be read, and why others cannot."""
    good, bad = [], []
    for source in sources:
        try:
            source.read()
            good.append(replace(source, flat_field=None))
        except InputError as error:
            bad.append(left_out(source.path, str(error)))
    return good, bad


def _placed(
    sources: list[Source], nominal: TileGrid, options: TileOptions, progress: Progress
) -> tuple[list[Source], TileRegistration, list[Message]]:
    """The tiles with their illumination taken out, where they are, and what there is to say of that."""
    if len({source.camera.image_size for source in sources}) > 1:
        said = [Message("tiles of several sizes have no flat field in common", severity="note", code="flat-field")]
        if options.flat_field not in ("auto", "off") or isinstance(options.distortion, float):
            raise ArgumentError("tiles of several sizes have neither a flat field nor a lens in common")
    else:
        sources, said = with_flat_field(sources, options.flat_field)
    read = partial(_plane, sources, options.channel)
    plan = SearchPlan.of(nominal, options.search)
    factor = plan.factor
    grid, shown = with_axes_shown(nominal, lambda index: coarse_tile(read(index), factor), factor, plan.search)
    if shown:
        said.append(Message(f"{nominal.source} contradicted: {shown}", code="grid-as-shown"))
    if grid.pixel_size is not None:
        sources = [replace(s, metadata=replace(s.metadata, pixel_size=grid.pixel_size)) for s in sources]
    tiled = register_tiles(replace(plan, grid=grid), read, distortion=options.distortion, progress=progress)
    for index in set(range(len(grid))) - set(tiled.compared.ravel().tolist()):
        read(index)
    if options.flat_field == "auto" and sources[0].flat_field is not None and not _overlaps_show(sources, tiled):
        sources, said = [replace(source, flat_field=None) for source in sources], [*said[1:], NO_FLAT_FIELD]
    return sources, tiled, said


def _overlaps_show(sources: Sequence[Source], tiled: TileRegistration) -> bool:
    """Check whether overlaps are more alike with the flat field, which was found without them, than without."""
    field = sources[0].flat_field
    assert field is not None
    raw = [replace(source, flat_field=None) for source in sources]
    pairs = tiled.links.tiles[tiled.adjustment.weights > 0.5]
    chosen = pairs[evenly_spaced(len(pairs), _COMPARED)]
    places = tiled.adjustment.places
    compared = ((raw[a].read().pixels, raw[b].read().pixels, places[b] - places[a]) for a, b in chosen.tolist())
    return agrees_with_overlaps(field, compared)


def _write_beside(
    outputs: Outputs,
    file: str | Path | None,
    options: TileOptions,
    registration: Registration,
    tiled: TileRegistration,
) -> None:
    """The table of places, and the flat field, where they are wanted."""
    if file is not None:
        names = [source.name for source in registration.sources]
        places = tiled.adjustment.places - tiled.adjustment.places.min(axis=0)
        fiji = Path(file).suffix.lower() == ".txt"
        outputs.write(file, text_bytes(fiji_list(names, places) if fiji else places_table(names, tiled)))
    field = registration.sources[0].flat_field
    if options.save_flat_field is not None and field is not None:
        with outputs.writing(options.save_flat_field) as staged:
            field.write(staged)


def _plane(sources: Sequence[Source], channel: int | None, index: int) -> NDArray[Any]:
    """A tile as it is registered."""
    pixels = sources[index].read(keep=True).pixels
    count = 1 if pixels.ndim == 2 else pixels.shape[2]
    if channel is not None and channel >= count:
        raise ArgumentError(f"{sources[index].path}: has {_channels(count)}, none with the number {channel}")
    if pixels.ndim == 2:
        return pixels
    if channel is None:
        return mean_of_channels(pixels.astype(np.float32)) if count <= 4 else pixels.mean(axis=2)
    return np.ascontiguousarray(pixels[..., channel])


def _channels(count: int) -> str:
    return "1 channel" if count == 1 else f"{count} channels"


def _grid(sources: Sequence[Source], stored: Mapping[Path, StoredTile], options: TileOptions) -> TileGrid:
    """Where the tiles should be."""
    sizes = np.array([source.camera.image_size for source in sources], dtype=np.intp)
    width, height = sizes.max(axis=0).tolist()
    size, pixel_size = (width, height), options.pixel_size or sources[0].metadata.pixel_size
    names = [source.name for source in sources]
    if options.grid is not None:
        scan = Scan(options.columns, options.order, options.origin)
        grid = grid_from_names(names, options.grid, options.overlap, size, scan)
        grid = replace(grid, pixel_size=pixel_size)
    elif isinstance(options.positions, str | os.PathLike):
        grid = grid_from_table(names, options.positions, size, pixel_size)
    elif options.positions is not None:
        # Of tiles that are left out the lines are, too.
        numbers = [source.number(k) for k, source in enumerate(sources)]
        grid = grid_from_arrays(options.positions, numbers, size, pixel_size)
    else:
        told = [stored.get(source.path) or StoredTile(source.path, {}) for source in sources]
        grid = grid_from_tiles(told, size, options.pixel_size)
    return grid if (sizes == sizes[0]).all() else replace(grid, own_sizes=sizes)


def _registration(sources: Sequence[Source], tiled: TileRegistration) -> Registration:
    """What was found, in the form that everything after registration takes."""
    fitted, links = tiled.adjustment, tiled.links
    if not tiled.linked.any():
        raise RegistrationError(
            f"none of {len(tiled.compared)} pairs of neighbours show the same where they should: the places "
            f"({tiled.grid.source}) or the overlap may be wrong; --search PX looks farther"
        )
    distortion, std = fitted.distortion, fitted.distortion_std
    cameras = [replace(source.camera, distortion=distortion, distortion_std=std) for source in sources]
    places = fitted.places - fitted.places[0]
    exact = _homographies(cameras, places)
    pairs, fits = zip(*(_pair(tiled, cameras, exact, number) for number in range(len(links.tiles))), strict=True)
    used_pairs = [fit for fit in fits if fit.used]
    rms = math.sqrt(float(np.mean([fit.rms**2 for fit in used_pairs if fit.inliers] or [math.nan])))
    alignment = Alignment(
        cameras=tuple(cameras),
        # Without a lens to take out every sample can stay as it was measured.
        homographies=_homographies(cameras, np.rint(places)) if fitted.distortion == 0.0 else exact,
        used=np.ones(len(sources), dtype=np.bool_),
        components=(tuple(range(len(sources))),),
        reference=0,
        model="rigid",
        model_reason="a stage moves without turning",
        rms=rms,
        links=fits,
        relief=ReliefTest(False, 0.0, 0.0, "Taken to be flat: tiles on a stage."),
    )
    counts = np.bincount(links.tiles[links.pair].ravel(), minlength=len(sources))
    return Registration(
        tuple(sources), tuple(counts.tolist()), pairs, alignment, _messages(sources, tiled), tiles=tiled
    )


def _homographies(cameras: Sequence[Camera], places: FloatArray) -> FloatArray:
    """From each tile's normalized coordinates to those of the first (N, 3, 3); places (N, 2) are its pixels."""
    # Of tiles of several sizes each has its own frame.
    scales, centers = (np.array([getattr(camera, part) for camera in cameras]) for part in ("scale", "center"))
    matrices = np.tile(np.eye(3), (len(cameras), 1, 1))
    matrices[:, [0, 1], [0, 1]] = (scales / scales[0])[:, None]
    matrices[:, :2, 2] = (places + centers - centers[0]) / scales[0]
    return matrices


def _pair(
    tiled: TileRegistration, cameras: Sequence[Camera], homographies: FloatArray, number: int
) -> tuple[PairRegistration, LinkFit]:
    """A link between tiles, and how well it fits."""
    fitted, links = tiled.adjustment, tiled.links
    first, second = links.tiles[number].tolist()
    of_pair = np.flatnonzero(links.pair == number)
    agreeing = fitted.squared[of_pair] / fitted.noise < 16.0
    errors, used = np.linalg.norm(fitted.residuals[of_pair], axis=1), bool(fitted.weights[number] > 0.25)
    rms = math.sqrt(float((errors[agreeing] ** 2).mean())) if agreeing.any() else math.nan
    matrix = np.linalg.solve(homographies[second], homographies[first])
    relation = RadialHomography(
        matrix, cameras[first], cameras[second], agreeing, model="rigid", rms=rms, reason="correlation"
    )
    indices = np.tile(np.arange(len(of_pair), dtype=np.intp)[:, None], 2)
    matches = Correspondences(indices, links.points1[of_pair], links.points2[of_pair], np.zeros(len(of_pair)))
    reason = Unused.NO if used else Unused.CONTRADICTS
    fit = LinkFit(first, second, len(errors), int(agreeing.sum()), rms if used else math.nan, used, reason)
    return PairRegistration(first, second, StoredMatches.of(matches), relation), fit


def _messages(sources: Sequence[Source], tiled: TileRegistration) -> tuple[Message, ...]:
    """What the user should know of the places."""
    fitted = tiled.adjustment

    def named(tiles: Iterable[int]) -> str:
        return shortened(names_of([str(sources[k].path) for k in tiles]))

    messages = []
    if len(alone := np.flatnonzero(~tiled.linked)):
        who = "1 tile has its place" if len(alone) == 1 else f"{len(alone)} tiles have their places"
        text = (
            f"{who} from the stage alone, ± {_rms(tiled.stds[alone]):.1f} pixels, since no neighbour shows the same: "
            f"{named(alone)}"
        )
        messages.append(Message(text, severity="note", code="nominal-places"))
    if len(tiled.groups) > 1:
        others = [k for group in tiled.groups[1:] for k in group]
        text = (
            f"tiles form {len(tiled.groups)} groups that only the stage holds together, ± "
            f"{_rms(tiled.stds[others]):.1f} pixels: {named(others)} have no link to the largest"
        )
        messages.append(Message(text, code="nominal-places"))
    if len(astray := np.flatnonzero(tiled.linked & (tiled.off_stage > max(tiled.search, 5.0 * fitted.stage.std)))):
        off = ", ".join(f"{value:.0f}" for value in tiled.off_stage[astray][:MAX_NAMED])
        messages.append(Message(f"not where the stage was sent, {off} pixels off by what they show: {named(astray)}"))
    if fitted.distortion != 0.0:
        text = (
            f"the lens, λ = {fitted.distortion:.4f}, is corrected by resampling; --lambda 0 keeps the measured samples"
        )
        messages.append(Message(text, severity="note"))
    return tuple(messages)


def _rms(values: FloatArray) -> float:
    return math.sqrt(float((values**2).mean()))
