"""The sidecar of an image that was composed again: what was estimated then, of the images that are in it now."""

from pathlib import Path
from typing import Any

from msgspec import UNSET
from msgspec.structs import replace as replace_fields

from rdstitch.arrays import FloatArray
from rdstitch.geometry.camera_record import CameraRecord, camera_record, lens_fields
from rdstitch.geometry.exif_orientation import inverse
from rdstitch.sidecar.parts import (
    displacement_record,
    output_record,
    rebased_path,
    recorded_path,
    seams_record,
    taken_fields,
    to_output,
    versions,
)
from rdstitch.sidecar.recomposition import Recomposition
from rdstitch.sidecar.records import VERSION, Applied, ImageRecord
from rdstitch.system.file_access import is_url
from rdstitch.system.records import to_jsonable


def applied_sidecar(result: Recomposition, *, same_lens: bool) -> dict[str, Any]:
    """The content of the sidecar, which can be applied like any other; pairs stay in the one that was applied."""
    saved, then = result.saved, result.saved.record
    sources = {index: source for index, source in enumerate(result.sources) if source is not None}
    to_plane = dict(zip(sources, result.placed.homographies, strict=True))
    # An image without any image in it is never written.
    source = sources.get(saved.reference) or next(iter(sources.values()))
    # How far the camera was determined then.
    names = ("lambda_std", "lens_covariance", "lambda_observable", "tilt_deg", "tilt_std_deg")
    determined = {name: getattr(then.camera, name) for name in names}
    determined["focal_std_px"] = _resized_std(then.camera, source.camera.focal)
    camera = camera_record(source.camera.turned(inverse(source.metadata.orientation)))
    if same_lens:
        camera = replace_fields(camera, **determined)
    of_lens = {"lambda_std": None, "lambda_known": False, "tilt_deg": None, "rms_px": None}
    now = replace_fields(
        then,
        **({} if same_lens else of_lens | {"lens_reason": "that of another band, from what images of both show"}),
        version=VERSION,
        lambda_=camera.lambda_,
        lambda_px=camera.lambda_px,
        lambda_focal=camera.lambda_focal,
        camera=camera,
        focal_px=camera.focal_px,
        reference=source.name,
        output=output_record(result, turned=saved.turned),
        seams=seams_record(result.seams, [source.name for source in sources.values()]),
        images=[
            _used_image(result, index, to_plane[index], same_lens=same_lens)
            if index in sources
            else _unused_image(result, index)
            for index in range(len(saved.images))
        ],
        pairs=[],
        options={**then.options, "composite": result.options.composite},
        versions=versions(),
        applied=Applied(recorded_path(saved.path, result.output), result.matched),
    )
    content: dict[str, Any] = to_jsonable(now)
    return content


def _used_image(result: Recomposition, index: int, to_plane: FloatArray, *, same_lens: bool) -> ImageRecord:
    """The record of an image, with what took its place."""
    image, source = result.saved.images[index], result.sources[index]
    assert source is not None
    field, size, original = image.displacement_field(), source.camera.image_size, result.saved.original(image)
    is_original = original is not None and original.resolve() == source.path.resolve()
    return replace_fields(
        image,
        name=source.name,
        path=recorded_path(source.path, result.output),
        size=size,
        features=image.features if is_original else None,
        pose=image.pose if same_lens else None,
        to_plane=to_plane.tolist(),
        to_output=to_output(result.canvas, to_plane),
        displacement=displacement_record(None if field is None else field.resized(size)),
        lambda2=UNSET,
        **taken_fields(source),
        **lens_fields(source.camera),
    )


def _unused_image(result: Recomposition, index: int) -> ImageRecord:
    """The record of an image that is not in the output."""
    image, left_out = result.saved.images[index], result.left_out.get(index)
    lens = {} if image.camera is None else lens_fields(image.camera)
    reason = image.reason if left_out is None else left_out.text
    gone = {"used": False, "reason": reason, "to_plane": None, "to_output": None, "pose": None}
    # An array has a name without an ending, and no file.
    if not is_url(image.path) and (Path(image.path).suffix or result.saved.original(image)):
        gone["path"] = rebased_path(Path(image.path), result.saved.path.parent, result.output)
    return replace_fields(image, **lens, **gone, lambda2=UNSET)


def _resized_std(then: CameraRecord, focal: float | None) -> float | None:
    """The standard deviation that a focal length had, for the same lens on an image of another size."""
    std, former = then.focal_std_px, then.focal_px
    return std * (focal / former) if std and former and focal else None
