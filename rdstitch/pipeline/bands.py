"""Mosaics of all bands of a multispectral rig on one pixel grid: the first band is registered, the others follow."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from fnmatch import fnmatchcase
from functools import reduce
from itertools import chain
from pathlib import Path

import numpy as np

from rdstitch.choices import Purpose
from rdstitch.errors import ArgumentError, InputError
from rdstitch.inputs.find import FoundImages
from rdstitch.inputs.frame import Frame, Images
from rdstitch.inputs.selection import selected
from rdstitch.inputs.source import read_sources
from rdstitch.io.fingerprint import fingerprint
from rdstitch.io.metadata import Metadata
from rdstitch.io.strips import ImageSpec, Strip
from rdstitch.io.tiff import written_strips
from rdstitch.io.write import write_strips
from rdstitch.io.write_ome import OME_SUFFIXES
from rdstitch.options.apply_options import ApplyOptions
from rdstitch.options.files_beside import NOTHING_BESIDE, FilesBeside
from rdstitch.options.stitch_options import StitchOptions
from rdstitch.pipeline.apply_sidecar import apply_to_images, settings_of
from rdstitch.pipeline.outputs.output_files import file_of_part
from rdstitch.pipeline.recipes import stitch_images
from rdstitch.pipeline.run import RecipeInput, Run
from rdstitch.results.messages import Message
from rdstitch.results.stitch_result import StitchResult
from rdstitch.sidecar.read import read_sidecar
from rdstitch.sidecar.recomposition import Recomposition
from rdstitch.sidecar.write import sidecar
from rdstitch.system.native_threads import one_native_thread
from rdstitch.system.outputs import Outputs, json_bytes
from rdstitch.system.progress import Progress, silent


@one_native_thread()
def mosaic_bands(
    inputs: Images,
    output: str | Path,
    bands: Mapping[str, str],
    options: StitchOptions | None = None,
    *,
    every: int | None = None,
    progress: Progress = silent,
    beside: FilesBeside = NOTHING_BESIDE,
) -> tuple[StitchResult, tuple[Recomposition, ...]]:
    """Stitch the images of several bands, all on the same pixels, into one file and each into one of its own.

    ``bands`` are patterns of the names of images by the names of bands, the registered one first; ``beside`` is for
    it alone. ``field.tif`` has all bands, with their names; ``field-NIR.tif`` and so on one each. Formats that hold
    no number of bands have only the latter. Returns the result of the first band, and those of the others, each
    composed with its own lens.
    """
    if len(bands) < 2 or not all(bands) or not all(bands.values()) or {"/", "\\"} & set("".join(bands)):
        raise ArgumentError(f"bands must be patterns by two names or more that files can have, not {dict(bands)}")
    file = Path(output)
    files = [file_of_part(file, name) for name in bands]
    given = RecipeInput.of(inputs, options, Purpose.MOSAIC, every)
    run = Run.of(given, files[0], beside, progress)
    options, outputs = run.options, run.outputs
    if options.dry_run:
        raise ArgumentError("bands have no plan before the first of them is registered: leave out dry_run")
    stack = [file, Path(f"{file}.json")] if file.suffix.lower() in (".tif", ".tiff") else []
    with given.find_images(file, *files) as images, outputs:  # all are published together
        frames = selected(images.frames, options.exclude, options.include_only)
        chosen = _by_band(frames, bands)
        is_ome = file.name.lower().endswith(OME_SUFFIXES)
        _check_alike(dict(zip(bands, chosen, strict=True)), in_one_file=bool(stack), is_ome=is_ome)
        of_first = replace(images, frames=chosen[0], containers=tuple(images.files))
        run_of_first = run.of_part(files[0], replace(options, exclude=(), include_only=()), run.beside)
        first = stitch_images(of_first, run_of_first, more_images=files[1:], more_files=stack)
        saved = replace(read_sidecar(outputs.where(f"{files[0]}.json")), path=Path(f"{files[0]}.json"))
        same = ApplyOptions(mask=options.mask, channel_order=options.channel_order, **options.of_run)
        settings = settings_of(saved, saved.composite, same)
        others = tuple(
            apply_to_images(saved, FoundImages(band, []), run.of_part(name, settings), same)
            for band, name in zip(chosen[1:], files[1:], strict=True)
        )
        if stack:
            _stage_stack(file, dict(zip(bands, files, strict=True)), first, outputs)
            first = first.with_messages([Message(f"{file} has all bands: {', '.join(bands)}", severity="note")])
    return first, others


def _check_alike(bands: Mapping[str, list[Frame]], *, in_one_file: bool, is_ome: bool) -> None:
    """Refuse bands whose images differ in size from the first, or that one file cannot hold."""
    kinds = {}
    for name, frames in bands.items():
        sources, unread = read_sources(frames, skip_bad=True)
        if not sources:
            raise InputError(f"{unread[0].images[0]}: {unread[0].text}; no other image of {name} can be read either")
        read = [source.metadata for source in sources]
        if is_ome and any(one.planes or one.channels not in (1, 3) for one in read):  # each is read from one page
            raise ArgumentError(f"bands: images of {name} are neither grey nor RGB, as an OME-TIFF needs; name a .tif")
        written = [next(depth for depth in (8, 16, 64) if one.bit_depth <= depth) for one in read]
        depths = {depth: f"{one.bit_depth} bits" for depth, one in zip(written, read, strict=True)}
        kinds[name] = {"{} x {} pixels".format(*one.size) for one in read}, depths
    first = next(iter(bands))
    for name, (sizes, depths) in kinds.items():
        if sizes != kinds[first][0]:
            reason, differing = "their lenses are compared at one size", (kinds[first][0], sizes)
        elif in_one_file and depths.keys() != kinds[first][1].keys():
            reason, differing = "one TIFF cannot hold both", ({*kinds[first][1].values()}, {*depths.values()})
        else:
            continue
        one, other = (", ".join(sorted(values)) for values in differing)
        text = f"bands: images of {first} have {one}, those of {name} {other}, but {reason}"
        raise ArgumentError(f"{text}; convert the images of one of them, or stitch them separately")


def _stage_stack(file: Path, bands: Mapping[str, Path], first: StitchResult, outputs: Outputs) -> None:
    """Stage one file of all bands, which are staged already; it is transparent where any band is."""

    def joined(parts: Sequence[Strip]) -> Strip:
        alphas = [alpha for _, alpha in parts if alpha is not None]
        return np.concatenate([samples for samples, _ in parts], axis=2), reduce(np.minimum, alphas) if alphas else None

    streams = [written_strips(outputs.where(path)) for path in bands.values()]
    heads = [next(stream) for stream in streams]
    names: list[str] = []
    for name, (samples, _) in zip(bands, heads, strict=True):
        count = samples.shape[2]
        names += [name] if count == 1 else [f"{name} {k}" for k in range(1, count + 1)]
    metadata = Metadata(first.canvas.size, channels=len(names), planes=True, channel_names=tuple(names))
    spec = ImageSpec(first.canvas.size, len(names), heads[0][0].dtype, transparent=True, metadata=metadata)
    tags = [] if first.georeference is None else first.georeference.tiff_tags()
    strips = map(joined, chain([heads], zip(*streams, strict=True)))
    write_strips(file, spec, strips, tags, outputs=outputs)
    # It is the first band's in all but its own bytes, which say that it is no image to stitch.
    written, record = fingerprint(outputs.where(file)), sidecar(first)
    record["output"] |= {"file": file.name, "bytes": written.size, "sha256": written.sha256}
    outputs.write(f"{file}.json", json_bytes(record))


def _by_band(frames: Sequence[Frame], bands: Mapping[str, str]) -> list[list[Frame]]:
    """Assign images to bands; none may belong to two."""
    chosen: dict[str, list[Frame]] = {name: [] for name in bands}
    for frame in frames:
        fitting = [name for name in bands if fnmatchcase(frame.name.rpartition("/")[2].lower(), bands[name].lower())]
        if len(fitting) > 1:
            one, other = (f"{name}={bands[name]}" for name in fitting[:2])
            raise ArgumentError(f"bands: {frame.name} fits both {one} and {other}; change one of these patterns")
        for name in fitting:
            chosen[name].append(frame)
    for name, of_band in chosen.items():
        if not of_band:
            raise ArgumentError(f"bands: no image has a name like {bands[name]}")
    return list(chosen.values())
