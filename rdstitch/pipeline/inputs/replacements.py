"""Reading the images that take the places of registered ones, with corrections and the registered cameras."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

from rdstitch.errors import InputError, PartialResultError
from rdstitch.geometry.camera import Camera
from rdstitch.inputs.frame import Frame
from rdstitch.inputs.input_guard import InputGuard
from rdstitch.inputs.masks import with_masks
from rdstitch.inputs.source import Source, read_sources
from rdstitch.options.apply_options import ApplyOptions
from rdstitch.pipeline.composition.flat_field import check_one_size, with_flat_field
from rdstitch.pipeline.inputs.counterparts import find_counterparts
from rdstitch.results.messages import Message, left_out, merge_by_reason
from rdstitch.sidecar.read import SavedRegistration
from rdstitch.sidecar.records import MatchedBy
from rdstitch.stage.tile_inputs import tile_frames


@dataclass(frozen=True)
class Replacements:
    """Images in the places of registered ones, by the numbers of these."""

    sources: Mapping[int, Source]  # with their cameras, masks and flat field
    left_out: Mapping[int, Message]
    matched: MatchedBy
    messages: Sequence[Message]


def read_replacements(
    saved: SavedRegistration, frames: Sequence[Frame], options: ApplyOptions, guard: InputGuard, max_memory: int | None
) -> Replacements:
    """Find, read and correct the images of the output: at least one, or, if strict, all that were registered."""
    notes: list[Message] = []
    stage = saved.record.stage
    if stage is not None:
        frames, _, notes = tile_frames(frames, stage.z, stage.time)
    found = find_counterparts(saved, frames, options.match)
    sources, missing = _read(saved, found.chosen, guard, max_memory)
    if options.strict and missing:
        raise PartialResultError("; ".join(map(str, merge_by_reason(missing.values()))))
    if not sources:
        first = next(iter(missing.values()))
        raise InputError(f"{saved.path}: none of its images can be used; {first.images[0]}: {first.text}")
    used = with_masks(list(sources.values()), options.mask)
    if stage is not None and stage.pixel_um is not None:
        used = [replace(s, metadata=replace(s.metadata, pixel_size=stage.pixel_um)) for s in used]
    illumination: list[Message] = []
    if options.flat_field != "off":
        check_one_size(used)
        used, illumination = with_flat_field(used, options.flat_field)
    messages = [*notes, *found.unused, *illumination]
    return Replacements(dict(zip(sources, used, strict=True)), missing, found.matched, messages)


def _read(
    saved: SavedRegistration, chosen: Sequence[Frame | None], guard: InputGuard, max_memory: int | None
) -> tuple[dict[int, Source], dict[int, Message]]:
    """Read the image in the place of each used one, with its camera; or a message why there is none."""
    sources: dict[int, Source] = {}
    missing: dict[int, Message] = {}
    for index, (image, frame) in enumerate(zip(saved.images, chosen, strict=True)):
        if image.camera is None or image.to_plane is None:
            continue
        if frame is None:
            missing[index] = left_out(saved.original(image) or image.path, "is not among the given images")
            continue
        read, unread = read_sources([frame], skip_bad=True, guard=guard, max_memory=max_memory)
        if unread:
            missing[index] = unread[0]
        else:
            sources[index] = replace(read[0], camera=_resized(image.camera, read[0]))
    return sources, missing


def _resized(camera: Camera, source: Source) -> Camera:
    """The registered camera for an image that shows the same at perhaps another size."""
    (w1, h1), (w2, h2) = camera.image_size, source.metadata.size
    # Sizes are whole pixels, so that the shape may differ by one pixel of the image.
    if abs(w1 * h2 - h1 * w2) > max(w1, h1):
        raise InputError(
            f"{source.path}: has {w2} x {h2} pixels, which is not the shape of the {w1} x {h1} that were registered"
        )
    return camera.resized((w2, h2))
