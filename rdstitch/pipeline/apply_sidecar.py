"""Recomposing from a saved registration: other bands of the same flight, other sizes, other compositing options."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from msgspec import UNSET
from msgspec.structs import replace as replace_fields

from rdstitch.arrays import FloatArray
from rdstitch.compositing import CompositeOptions
from rdstitch.errors import InputError, PartialResultError
from rdstitch.export.georeference import Georeference
from rdstitch.geometry.camera import Camera
from rdstitch.geometry.camera_record import CameraRecord, camera_record, lens_fields
from rdstitch.geometry.exif_orientation import inverse
from rdstitch.inputs.find import found_images
from rdstitch.inputs.frame import Frame, Images, as_inputs
from rdstitch.inputs.input_guard import InputGuard
from rdstitch.inputs.selection import with_masks
from rdstitch.inputs.source import Source, read_sources
from rdstitch.options.apply_options import ApplyOptions
from rdstitch.options.stitch_options import StitchOptions
from rdstitch.pipeline.band_lens import BandLens, band_lens
from rdstitch.pipeline.compose import Layout, check_world_files, compose_images, image_files, plainly_viewed, write_page
from rdstitch.pipeline.counterparts import MatchedBy, counterparts, registered_files
from rdstitch.pipeline.placed_images import PlacedImages
from rdstitch.pipeline.read_inputs import check_size, with_flat_field
from rdstitch.pipeline.run import Run
from rdstitch.pipeline.straighten import reoriented
from rdstitch.results.messages import Message, merge_by_reason
from rdstitch.results.messages import left_out as left_out_message
from rdstitch.results.stitch_result import OutputImage
from rdstitch.sidecar.read import SavedRegistration, mismatch_with_image, read_sidecar
from rdstitch.sidecar.records import VERSION, Applied, ImageRecord
from rdstitch.sidecar.write import displacement_record, output_record, seams_record, taken_fields, to_output, versions
from rdstitch.stage.tile_frames import tile_frames, with_position_folders
from rdstitch.system.native_threads import one_native_thread
from rdstitch.system.outputs import Outputs, check_outputs, check_suffix, json_bytes
from rdstitch.system.progress import Progress, StageTimer, silent
from rdstitch.system.records import to_jsonable


@dataclass(frozen=True, repr=False, kw_only=True)
class Recomposition(OutputImage):
    """An image made from a saved registration; also as :class:`rdstitch.results.stitch_result.OutputImage` has it.

    Attributes
    ----------
    saved : SavedRegistration
    sources : tuple of Source or None
        For each image of the registration the one that took its place, with its camera; None where there is none.
    matched : str
        "name", "time", "position" or "order".
    left_out : dict of int to Message
        Images that the registration used and that are not in the output, by their number, with the reason.
    placed : PlacedImages
        Those that are in the output.
    messages : tuple of Message
        What the user should know of the compositing, and of the sidecar.
    """

    saved: SavedRegistration
    sources: tuple[Source | None, ...]
    matched: MatchedBy
    left_out: Mapping[int, Message]
    placed: PlacedImages
    messages: tuple[Message, ...] = ()

    @property
    def summary(self) -> str:
        """What was made, and of how many images, in one line."""
        used = sum(source is not None for source in self.sources)
        return f"{super().summary}, {used} of {used + len(self.left_out)} images"


def applied_sidecar(result: Recomposition) -> dict[str, Any]:
    """The sidecar of a recomposed image: what was estimated then, of the images that are in it now.

    It can be applied like any other. Pairs are those of the sidecar that was applied, and stay there.
    """
    then, saved = result.saved.record, result.saved
    images = [_image(result, index) for index in range(len(then.images))]
    # An image without any image in it is never written.
    reference = next(index for index in (saved.reference, *range(len(images))) if images[index].used)
    source = result.sources[reference]
    assert source is not None
    # How far the camera was determined then.
    determined = ("lens_covariance", "tilt_deg", "tilt_std_deg")
    camera = replace_fields(
        camera_record(source.camera.turned(inverse(source.metadata.orientation))),
        lambda_std=then.lambda_std,
        **{name: getattr(then.camera, name) for name in determined},
        focal_std_px=_resized_std(then.camera, source.camera.focal),
    )
    now = replace_fields(
        then,
        version=VERSION,
        lambda_=source.camera.distortion,
        lambda_px=camera.lambda_px,
        lambda_focal=camera.lambda_focal,
        camera=camera,
        focal_px=camera.focal_px,
        reference=source.name,
        output=output_record(result, turned=saved.turned),
        seams=seams_record(result.seams, [source.name for source in result.placed.sources]),
        images=images,
        pairs=[],
        options={**then.options, "composite": result.options.composite},
        versions=versions(),
        applied=Applied(str(saved.path), result.matched),
    )
    content: dict[str, Any] = to_jsonable(now)
    return content


def _image(result: Recomposition, index: int) -> ImageRecord:
    """One image's record, brought up to date."""
    source, image = result.sources[index], result.saved.images[index]
    if source is None or image.to_plane is None:
        reason = result.left_out[index].text if index in result.left_out else image.reason
        lens = {} if image.camera is None else lens_fields(image.camera)
        gone = {"used": False, "reason": reason, "to_plane": None, "to_output": None, "pose": None}
        return replace_fields(image, **lens, **gone, lambda2=UNSET)
    to_plane = result.placed.homographies[sum(earlier is not None for earlier in result.sources[:index])]
    field, size = image.displacement_field(), source.camera.image_size
    return replace_fields(
        image,
        name=source.name,
        path=str(source.path),
        size=size,
        to_plane=to_plane.tolist(),
        to_output=to_output(result.canvas, to_plane),
        displacement=displacement_record(None if field is None else field.resized(size)),
        lambda2=UNSET,
        **taken_fields(source),
        **lens_fields(source.camera),
    )


def _resized_std(then: CameraRecord, focal: float | None) -> float | None:
    """The standard deviation that a focal length had, for the same lens on an image of another size."""
    std, former = then.focal_std_px, then.focal_px
    return std * (focal / former) if std and former and focal else None


@one_native_thread()
def apply(
    sidecar: str | Path,
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
    sidecar : path
        What :func:`rdstitch.pano` or :func:`rdstitch.mosaic` wrote beside its image.
    images : path, ndarray, or iterable of them
        The same images, or others that were taken by the same lens from the same places: other bands, other sizes of
        the same shape, masks. Whatever :func:`rdstitch.mosaic` takes.
    output : path, optional
        Image to write, with a sidecar of its own beside it; without it the image is in the result.
    composite : CompositeOptions, optional
        Those of the sidecar if not given.
    options : ApplyOptions, optional
    progress : callable
    **fields
        Fields of the options, instead of those in ``options``: ``apply(sidecar, images, match="order")``.

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
    options = replace(options or ApplyOptions(), **fields)
    saved = read_sidecar(sidecar)
    mismatch = mismatch_with_image(saved)
    if options.strict and mismatch:
        raise InputError(mismatch)
    given = as_inputs(images, options.channel_order)
    if saved.record.stage is not None:
        given = with_position_folders(given)
    with (
        found_images(given, output=output, every=options.every, topic=options.topic) as listed,
        Outputs(options.overwrite) as outputs,
    ):
        if output is not None:
            check_outputs(image_files(check_suffix(output)), options.overwrite, [*listed.files, sidecar])
        composite = composite or saved.composite
        chosen = _chosen(saved, listed.frames, options, composite.max_memory)
        if output is not None:
            check_world_files([output], list(chosen.used.values()), options.overwrite)
        layout, composite, said = _laid_out(saved, chosen, composite, progress)
        settings = StitchOptions(
            composite=composite,
            reference=saved.images[saved.reference].name,
            channel_order=options.channel_order,
            workers=options.workers,
            dry_run=options.dry_run,
        )
        composed, notes = compose_images(layout, Run(settings, output, progress=StageTimer(progress)), outputs)
        sources = dict(zip(chosen.used, layout.placed.sources, strict=True))
        result = Recomposition(
            saved=saved,
            sources=tuple(map(sources.get, range(len(saved.images)))),
            matched=chosen.matched,
            left_out=chosen.left_out,
            placed=layout.placed,
            messages=(
                *([Message(mismatch)] if mismatch else []),
                *chosen.messages,
                *said,
                *listed.messages,
                *chosen.guard.messages,
                *notes,
            ),
            **composed.fields,
        )
        if options.dry_run or output is None:
            return result
        page = partial(plainly_viewed, result.canvas, [source.name for source in layout.placed.sources])
        result = replace(result, messages=(*result.messages, *write_page(result, outputs, page)))
        outputs.write(f"{output}.json", json_bytes(applied_sidecar(result)))
        return result


@dataclass(frozen=True)
class _Chosen:
    """The given images, by the numbers of those whose places they take."""

    frames: Mapping[int, Frame]
    used: Mapping[int, Source]  # with their cameras, masks and flat field
    left_out: Mapping[int, Message]
    matched: MatchedBy
    guard: InputGuard
    messages: Sequence[Message]


def _chosen(
    saved: SavedRegistration, frames: Sequence[Frame], options: ApplyOptions, max_memory: int | None
) -> _Chosen:
    """Which of the given images take whose places, read and corrected."""
    messages: list[Message] = []
    stage, guard = saved.record.stage, InputGuard(options.strict)
    if stage is not None:
        frames, _, messages = tile_frames(frames, stage.z, stage.time)
    chosen, matched, said = counterparts(saved, frames, options.match)
    messages += said
    sources, left_out = _sources(saved, chosen, guard, max_memory)
    used = _used(saved, sources, left_out, options.mask, strict=options.strict)
    if stage is not None and stage.pixel_um is not None:
        used = {k: replace(s, metadata=replace(s.metadata, pixel_size=stage.pixel_um)) for k, s in used.items()}
    if options.flat_field != "off":
        check_size(list(used.values()))
        corrected, said = with_flat_field(list(used.values()), options.flat_field)
        used = dict(zip(used, corrected, strict=True))
        messages += said
    of_used = {index: frame for index, frame in enumerate(chosen) if index in used and frame is not None}
    return _Chosen(of_used, used, left_out, matched, guard, messages)


def _laid_out(
    saved: SavedRegistration, chosen: _Chosen, composite: CompositeOptions, progress: Progress
) -> tuple[Layout, CompositeOptions, list[Message]]:
    """Where the images lie, by the sidecar and the lens of their band, and how they are composed there."""
    used = chosen.used
    # Channels of a microscope have their places in common, not their content.
    tiles = saved.record.stage is not None
    lens, messages = (None, []) if tiles else _lens_of_band(saved, chosen.frames, used, progress)
    if lens is not None:
        used = {index: replace(source, camera=lens.camera(source.camera)) for index, source in used.items()}
    placed, said = reoriented(_placed(saved, used, lens), composite, saved.composite)
    if (grid := _same_grid(saved, used, composite)) is not None:
        placed, composite = replace(placed, grid=grid), replace(composite, crop="none")
    return Layout.of(placed, composite), composite, [*messages, *said]


_GEOMETRY = (
    "scale",
    "max_size",
    "crop",
    "projection",
    "max_stretch",
    "rotate",
    "north_up",
    "gsd",
    "epsg",
    "like",
    "extent",
    "georeference",
)
"""Options of compositing that say which pixels the output has."""


def _same_grid(
    saved: SavedRegistration, used: Mapping[int, Source], options: CompositeOptions
) -> tuple[FloatArray, tuple[int, int], Georeference | None] | None:
    """The pixels of the saved output, where images of the same sizes are to have the same: bands, and dates."""
    asked = any(getattr(options, name) != getattr(saved.composite, name) for name in _GEOMETRY)
    matrix, size = saved.plane_to_output, saved.record.output.size
    same_sizes = all(saved.images[index].size == source.camera.image_size for index, source in used.items())
    if (
        asked
        or not same_sizes
        or saved.turned
        or not options.same_turn(saved.composite)
        or matrix is None
        or size is None
    ):
        return None
    return matrix, size, saved.output_place


def _lens_of_band(
    saved: SavedRegistration, frames: Mapping[int, Frame], used: Mapping[int, Source], progress: Progress
) -> tuple[BandLens | None, list[Message]]:
    """The lens that took the given images, where that is another one than took those that were registered."""
    there = registered_files(saved, frames)
    pairs: dict[int, tuple[Source, Source]] = {}
    for index, file in there.items():
        camera, size = saved.images[index].camera, used[index].camera.image_size
        if camera is not None and frames[index].number is None and camera.image_size == size:
            read, _ = read_sources([Frame(file)], skip_bad=True)
            if read and read[0].metadata.size == size:
                pairs[index] = replace(read[0], camera=camera), used[index]
    return band_lens(pairs, lambda done, total: progress("comparing bands", done, total))


def _placed(saved: SavedRegistration, used: Mapping[int, Source], lens: BandLens | None) -> PlacedImages:
    """The images at the places that the sidecar has for them, or that the lens of a band gives them."""
    to_registered = np.eye(3) if lens is None else np.linalg.inv(lens.homography)
    return PlacedImages(
        list(used.values()),
        [source.camera for source in used.values()],
        np.array([saved.images[index].to_plane for index in used], dtype=np.float64) @ to_registered,
        list(used).index(saved.reference) if saved.reference in used else None,
        [
            None if field is None else field.resized(source.camera.image_size)
            for field, source in ((saved.images[index].displacement_field(), source) for index, source in used.items())
        ],
        saved.turned,
        saved.place,
        whole=saved.record.stage is not None,
        orientation=saved.orientation,
    )


def _used(
    saved: SavedRegistration,
    sources: Sequence[Source | None],
    left_out: Mapping[int, Message],
    mask: str | Path | None,
    *,
    strict: bool,
) -> dict[int, Source]:
    """The images of the output, with their masks, by their number in the registration; at least one, or all."""
    if strict and left_out:
        raise PartialResultError("; ".join(map(str, merge_by_reason(left_out.values()))))
    used = {index: source for index, source in enumerate(sources) if source is not None}
    if not used:
        first = next(iter(left_out.values()))
        raise InputError(f"{saved.path}: none of its images can be used; {first.images[0]}: {first.text}")
    return dict(zip(used, with_masks(list(used.values()), mask), strict=True))


def _sources(
    saved: SavedRegistration, chosen: Sequence[Frame | None], guard: InputGuard, max_memory: int | None
) -> tuple[list[Source | None], dict[int, Message]]:
    """The images with their cameras, and why which of those used then is not among them."""
    sources: list[Source | None] = []
    left_out: dict[int, Message] = {}
    for index, (image, frame) in enumerate(zip(saved.images, chosen, strict=True)):
        sources.append(None)
        if image.camera is None or image.to_plane is None:
            continue
        if frame is None:
            left_out[index] = left_out_message(image.path, "is not among the given images")
            continue
        read, unread = read_sources([frame], skip_bad=True, guard=guard, max_memory=max_memory)
        if unread:
            left_out[index] = unread[0]
        else:
            sources[-1] = replace(read[0], camera=_resized(image.camera, read[0]))
    return sources, left_out


def _resized(camera: Camera, source: Source) -> Camera:
    """The registered camera for an image that shows the same at perhaps another size."""
    (w1, h1), (w2, h2) = camera.image_size, source.metadata.size
    # Sizes are whole pixels, so that the shape may differ by one pixel of the image.
    if abs(w1 * h2 - h1 * w2) > max(w1, h1):
        raise InputError(
            f"{source.path}: has {w2} x {h2} pixels, which is not the shape of the {w1} x {h1} that were registered"
        )
    return camera.resized((w2, h2))
