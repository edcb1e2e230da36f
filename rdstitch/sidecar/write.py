"""The sidecar of a stitched image: everything that was estimated, as JSON beside it; and of one composed again."""

import dataclasses
import platform
from pathlib import Path
from typing import Any, cast

import cv2
import numpy as np
from msgspec import UNSET
from msgspec.structs import replace as replace_fields

from rdstitch.geometry.camera import Camera
from rdstitch.geometry.camera_record import CameraRecord, camera_record, lens_fields
from rdstitch.geometry.exif_orientation import inverse
from rdstitch.results.stitch_result import StitchResult
from rdstitch.sidecar.image_record import ImageRecord, PoseRecord, image_fields, placement_fields
from rdstitch.sidecar.output_record import OutputRecord, SeamsRecord
from rdstitch.sidecar.paths import rebased_path, recorded_path
from rdstitch.sidecar.recomposition import Recomposition
from rdstitch.sidecar.records import (
    VERSION,
    Applied,
    Lens,
    LocalAlignmentRecord,
    Model,
    PairRecord,
    SidecarRecord,
    StageRecord,
    VerdictRecord,
)
from rdstitch.system.file_access import is_url
from rdstitch.system.records import to_jsonable

_OF_ANOTHER_LENS = {
    "lambda_std": None,
    "lambda_known": False,
    "tilt_deg": None,
    "rms_px": None,
    "lens_reason": "that of another band, from what images of both show",
}
"""What is not known of the lens of another band."""


def sidecar(result: StitchResult) -> dict[str, Any]:
    """The sidecar's content, as docs/formats.md describes it; every number that does not exist is null."""
    registration, alignment = result.registration, result.registration.alignment
    fits = {fit.images: fit for fit in alignment.links}
    names = [source.name for source in registration.sources]
    record = SidecarRecord(
        format="rdstitch sidecar",
        version=VERSION,
        lambda_std=alignment.distortion_std,
        lambda_known=alignment.lens_given,
        lens=cast(Lens, alignment.lens),
        lens_reason=alignment.lens_reason,
        tilt_deg=None if alignment.tilt is None else np.degrees(alignment.tilt).tolist(),
        **camera_fields(camera_record(registration.camera)),
        model=cast(Model, alignment.model),
        model_reason=alignment.model_reason,
        rms_px=alignment.rms,
        reference=names[alignment.reference],
        output=OutputRecord.of(result),
        local_alignment=LocalAlignmentRecord.of(result.local_alignment),
        seams=SeamsRecord.of(result),
        stage=StageRecord.of(registration),
        images=_images(result),
        pairs=[PairRecord.of(pair, fits.get(pair.images), names) for pair in registration.pairs],
        verdict=VerdictRecord.of(registration),
        options=dataclasses.asdict(result.options),
        seed=result.options.seed,
        versions=versions(),
    )
    content: dict[str, Any] = to_jsonable(record)
    return content


def camera_fields(camera: CameraRecord) -> dict[str, Any]:
    """The fields of a sidecar that say what the camera of its reference image is."""
    of_lens = ("lambda_", "lambda_px", "lambda_focal", "focal_px", "focal_source")
    return {"camera": camera, **{name: getattr(camera, name) for name in of_lens}}


def _images(result: StitchResult) -> list[ImageRecord]:
    """All images in their order; those that could not be read come last."""
    registration, alignment = result.registration, result.registration.alignment
    reasons = {Path(missing.images[0]): missing.text for missing in registration.left_out}
    position = np.cumsum(alignment.used) - 1  # among those of the output
    records = []
    for index, source in enumerate(registration.sources):
        fields, used = image_fields(source, alignment.cameras[index], result.output), bool(alignment.used[index])
        if used:
            fields |= placement_fields(result, int(position[index]))
        if used and alignment.poses is not None:
            fields["pose"] = PoseRecord.of(alignment.poses, index)
        reason = reasons.pop(source.path, "")
        records.append(ImageRecord(used=used, reason=reason, features=registration.keypoints[index], **fields))
    return records + [
        ImageRecord(path.name, recorded_path(path, result.output), None, False, reason)
        for path, reason in reasons.items()
    ]


def applied_sidecar(result: Recomposition, *, same_lens: bool) -> dict[str, Any]:
    """The sidecar of an image composed again: the saved registration, with the images that are in it now.

    It can be applied like any other; pairs stay in the one that was applied.
    """
    saved, record = result.saved, result.saved.record
    reference = result.sources[saved.reference] or result.placed.sources[0]
    stored_camera = reference.camera.turned(inverse(reference.metadata.orientation))
    camera = _with_errors_of(record.camera, stored_camera) if same_lens else camera_record(stored_camera)
    placed = (index for index, source in enumerate(result.sources) if source is not None)
    positions = {index: k for k, index in enumerate(placed)}  # of registered images among those of the output
    record = replace_fields(
        record,
        **({} if same_lens else _OF_ANOTHER_LENS),
        **camera_fields(camera),
        version=VERSION,
        reference=reference.name,
        output=OutputRecord.of(result),
        seams=SeamsRecord.of(result),
        images=[
            _used_image(result, index, positions[index], same_lens=same_lens)
            if index in positions
            else _unused_image(result, index)
            for index in range(len(saved.images))
        ],
        pairs=[],
        options={**record.options, "composite": result.options.composite},
        versions=versions(),
        applied=Applied(recorded_path(saved.path, result.output), result.matched),
    )
    content: dict[str, Any] = to_jsonable(record)
    return content


def _with_errors_of(registered: CameraRecord, camera: Camera) -> CameraRecord:
    """The record of a camera of the lens that was registered, perhaps on images of another size, with its errors."""
    record, focal_std = camera_record(camera), registered.focal_std_px
    if focal_std is not None and registered.focal_px and record.focal_px:
        focal_std *= record.focal_px / registered.focal_px
    return replace_fields(
        record,
        lambda_std=registered.lambda_std,
        lambda_observable=registered.lambda_observable,
        lens_covariance=registered.lens_covariance,
        focal_std_px=focal_std,
        tilt_deg=registered.tilt_deg,
        tilt_std_deg=registered.tilt_std_deg,
    )


def _used_image(result: Recomposition, index: int, position: int, *, same_lens: bool) -> ImageRecord:
    image, source = result.saved.images[index], result.placed.sources[position]
    original = result.saved.original(image)
    is_original = original is not None and original.resolve() == source.path.resolve()
    return replace_fields(
        image,
        features=image.features if is_original else None,
        pose=image.pose if same_lens else None,
        lambda2=UNSET,
        **image_fields(source, source.camera, result.output),
        **placement_fields(result, position),
    )


def _unused_image(result: Recomposition, index: int) -> ImageRecord:
    """The record of a registered image that is not in the output."""
    image, left_out = result.saved.images[index], result.left_out.get(index)
    path = image.path
    # An array has a name without an ending, and no file.
    if not is_url(path) and (Path(path).suffix or result.saved.original(image)):
        path = rebased_path(Path(path), result.saved.path.parent, result.output)
    return replace_fields(
        image,
        path=path,
        used=False,
        reason=image.reason if left_out is None else left_out.text,
        to_plane=None,
        to_output=None,
        pose=None,
        lambda2=UNSET,
        **({} if image.camera is None else lens_fields(image.camera)),
    )


def versions() -> dict[str, str]:
    """Versions of what has a say in the result."""
    from importlib.metadata import version

    import scipy

    return {
        "rdstitch": version("rdstitch"),
        "numpy": np.__version__,
        "scipy": scipy.__version__,
        # Whichever of its wheels is installed.
        "opencv": cv2.__version__,
        "python": platform.python_version(),
    }
