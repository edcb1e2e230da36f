"""The sidecar of a stitched image: everything that was estimated, as JSON beside it."""

import dataclasses
import platform
from pathlib import Path
from typing import Any, cast

import cv2
import numpy as np

from rdstitch.geometry.camera_record import CameraRecord, camera_record
from rdstitch.results.stitch_result import StitchResult
from rdstitch.sidecar.image_record import ImageRecord, PoseRecord, image_fields, placement_fields
from rdstitch.sidecar.output_record import OutputRecord, SeamsRecord
from rdstitch.sidecar.paths import recorded_path
from rdstitch.sidecar.records import (
    VERSION,
    Lens,
    LocalAlignmentRecord,
    Model,
    PairRecord,
    SidecarRecord,
    StageRecord,
    VerdictRecord,
)
from rdstitch.system.records import to_jsonable


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
