"""Reading the images to be registered, with masks, attitudes, positions and control points."""

from collections.abc import Sequence

from rdstitch.errors import ArgumentError, InputError
from rdstitch.inputs.attitudes import with_attitudes
from rdstitch.inputs.frame import Frame
from rdstitch.inputs.ground_control import with_ground_control
from rdstitch.inputs.image_folders import natural_key
from rdstitch.inputs.input_guard import InputGuard
from rdstitch.inputs.masks import with_masks
from rdstitch.inputs.positions import with_positions
from rdstitch.inputs.selection import selected
from rdstitch.inputs.source import Source, read_sources
from rdstitch.matching.candidate_pairs import EXHAUSTIVE_UP_TO
from rdstitch.options.stitch_options import StitchOptions
from rdstitch.results.messages import Message
from rdstitch.system.process_memory import return_freed_memory


def in_order(frames: Sequence[Frame]) -> Sequence[Frame]:
    """Sort files by name if every pair is compared; of more images, or arrays, the given order shows neighbours."""
    if len(frames) > EXHAUSTIVE_UP_TO or any(frame.image is not None for frame in frames):
        return frames
    return sorted(frames, key=lambda frame: (natural_key(frame.path), frame.number or 0))


def read_frames(
    frames: Sequence[Frame], options: StitchOptions, guard: InputGuard, *, skip_bad: bool
) -> tuple[list[Source], list[Message]]:
    """Read frames with the camera of the options; with messages on those that cannot be read."""
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
    """Read the selected images with all measurements; with messages on those that cannot be read or have none."""
    # Before the first large image is freed.
    return_freed_memory()
    chosen = selected(frames, options.exclude, options.include_only)
    sources, unread = read_frames(chosen, options, guard, skip_bad=skip_bad)
    if len(sources) < 2:
        if unread:
            few = "" if len(chosen) == 1 else "fewer than two images can be read; "
            raise InputError(f"{few}{unread[0].images[0]}: {unread[0].text}")
        if len(chosen) < 2 <= len(frames):
            raise ArgumentError(
                f"--exclude and --include-only leave {len(chosen)} of {len(frames)} images; stitching needs two or more"
            )
        twice = f"{chosen[0].path} is named twice: " if len(chosen) > 1 else ""
        raise ArgumentError(f"{twice}stitching needs two different images or more; name at least one more")
    sources = with_attitudes(with_masks(sources, options.mask), options.attitude)
    epsg, offset, accuracy = options.composite.epsg, options.positions_offset, options.position_accuracy
    notes = list[Message]()
    sources = with_positions(sources, options.positions, epsg, offset, accuracy, notes.append)
    for points, check in ((options.gcp, False), (options.check_points, True)):
        sources = with_ground_control(sources, points, epsg, check=check, report=notes.append)
    return (sources if options.scheduler is None else [s.with_absolute_paths() for s in sources]), [*unread, *notes]
