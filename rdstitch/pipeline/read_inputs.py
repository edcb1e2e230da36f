"""From frames and options to the images that are registered."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from rdstitch.errors import ArgumentError, InputError
from rdstitch.inputs.attitudes import with_attitudes
from rdstitch.inputs.frame import Frame
from rdstitch.inputs.ground_control import with_ground_control
from rdstitch.inputs.image_folders import natural_key
from rdstitch.inputs.input_guard import InputGuard
from rdstitch.inputs.positions import with_positions
from rdstitch.inputs.selection import selected, with_masks
from rdstitch.inputs.source import Source, read_sources
from rdstitch.io.flat_field import read_flat_field
from rdstitch.matching.candidate_pairs import EXHAUSTIVE_UP_TO
from rdstitch.options.stitch_options import StitchOptions
from rdstitch.results.messages import Message
from rdstitch.system.process_memory import return_freed_memory

NO_FLAT_FIELD = Message(
    "the tiles show no illumination that all have in common, and samples stay as they are",
    severity="note",
    code="flat-field",
)


def in_order(frames: Sequence[Frame]) -> Sequence[Frame]:
    """Files by their names where every pair is compared; of more images, and of arrays, the order tells neighbours."""
    if len(frames) > EXHAUSTIVE_UP_TO or any(frame.image is not None for frame in frames):
        return frames
    return sorted(frames, key=lambda frame: (natural_key(frame.path), frame.number or 0))


def read_frames(
    frames: Sequence[Frame], options: StitchOptions, guard: InputGuard, *, skip_bad: bool
) -> tuple[list[Source], list[Message]]:
    """The images of frames, with what options say of their camera; and why others cannot be read."""
    return read_sources(
        frames,
        camera=options.known_camera,
        focal=options.focal,
        distortion=options.distortion,
        skip_bad=skip_bad,
        guard=guard,
        max_memory=options.composite.max_memory,
    )


def read_inputs(
    frames: Sequence[Frame], options: StitchOptions, guard: InputGuard, *, skip_bad: bool
) -> tuple[list[Source], list[Message]]:
    """The images that options leave, with what was measured of them; and why others cannot be read."""
    # Before the first large image is freed.
    return_freed_memory()
    chosen = selected(frames, options.exclude, options.include_only)
    sources, unread = read_frames(chosen, options, guard, skip_bad=skip_bad)
    if len(sources) < 2:
        if unread:
            few = "" if len(chosen) == 1 else "fewer than two images can be read; "
            raise InputError(f"{few}{unread[0].images[0]}: {unread[0].text}")
        twice = f"{chosen[0].path} is named twice: " if len(chosen) > 1 else ""
        raise ArgumentError(f"{twice}stitching needs two different images or more; name at least one more")
    sources = with_attitudes(with_masks(sources, options.mask), options.attitude)
    epsg = options.composite.epsg
    sources = with_positions(sources, options.positions, epsg, options.positions_offset, options.position_accuracy)
    for points, check in ((options.gcp, False), (options.check_points, True)):
        sources = with_ground_control(sources, points, epsg, check=check)
    return (sources if options.scheduler is None else [s.with_absolute_paths() for s in sources]), unread


def check_one_size(sources: Sequence[Source]) -> None:
    """Refuse images of several sizes."""
    w1, h1 = sources[0].camera.image_size
    other = next((source for source in sources if source.camera.image_size != (w1, h1)), None)
    if other is not None:
        w2, h2 = other.camera.image_size
        raise InputError(f"{other.path}: has {w2} x {h2} pixels, the images before it have {w1} x {h1}; leave it out")


def with_flat_field(sources: Sequence[Source], wanted: str | Path) -> tuple[list[Source], list[Message]]:
    """The tiles, which are read without the illumination that all have; and what there is to say of that."""
    # Imported late: images that are no tiles have no use for it.
    from rdstitch.stage.estimate_flat_field import FlatFieldUnknown, estimate_illumination

    if wanted == "off":
        return list(sources), []
    if wanted != "auto":
        pixels = sources[0].read().pixels
        channels = 1 if pixels.ndim == 2 else pixels.shape[2]
        field = read_flat_field(wanted, sources[0].camera.image_size, channels)
        return [replace(source, flat_field=field) for source in sources], []
    shown = estimate_illumination(lambda index: sources[index].read().pixels, len(sources))
    if shown is FlatFieldUnknown.FEW_TILES:
        text = f"{len(sources)} tiles are too few to show their flat field, and samples stay as they are"
        return list(sources), [Message(text, severity="note", code="flat-field")]
    if shown is FlatFieldUnknown.UNSURE:
        return list(sources), [NO_FLAT_FIELD]
    dark = ", ".join(f"{d.level:.0f} ± {d.std:.0f}" if d is not None else "not shown" for d in shown.dark)
    text = f"flat field: {shown.shading:.0%} less light where it is darkest, ± {shown.error:.1%}; dark level {dark}"
    return [replace(source, flat_field=shown.field) for source in sources], [Message(text, severity="note")]
