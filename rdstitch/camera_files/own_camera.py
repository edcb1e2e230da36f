"""What every foreign camera file gets besides: the division model itself, so that λ comes back as it was."""

import json
from dataclasses import dataclass, replace
from typing import Any

from rdstitch.camera import Camera
from rdstitch.camera_files.lens_fit import Forward, LensFit, fit_lens
from rdstitch.camera_files.lens_models import ForeignLens
from rdstitch.camera_record import camera_from_record
from rdstitch.errors import ArgumentError, InputError
from rdstitch.records import Record, parse_json

_OWN = "#rdstitch "
_SQUARE = 0.005  # calibrations give focal lengths along x and y that differ by less


@dataclass(frozen=True)
class CameraFile:
    """A camera as a file tells it.

    Attributes
    ----------
    camera : Camera
    kind : str
        Whose format it is: "rdstitch", "OpenCV", "COLMAP", "Kalibr", "OpenDroneMap" or "Hugin".
    fit : LensFit or None
        How well λ agrees with the file's own lens model; None where the file gives λ itself.
    cause : str
        What of the file's model λ cannot describe; empty where it is only the curve of the lens.
    """

    camera: Camera
    kind: str
    fit: LensFit | None = None
    cause: str = ""


def own_node(camera: Camera, fit: LensFit) -> dict[str, Any]:
    """The camera, and the residual of the model that was fitted to it; what is not known is left out."""
    known = {key: value for key, value in camera.as_dict().items() if value is not None}
    return {**known, "fit_rms_px": fit.rms, "fit_largest_px": fit.largest}


def fitted_camera(
    record: Record,
    kind: str,
    forward: Forward,
    size: tuple[int, int],
    center: tuple[float, float],
    focal: float,
    model: Record | None = None,
) -> CameraFile:
    """A camera whose λ is fitted to the lens model of a file; ``model`` is where that stands in the record.

    Raises
    ------
    InputError
        When that is impossible.
    """
    try:
        camera = Camera(size, center=center, focal=focal, focal_source="file")
    except ArgumentError as error:
        record.fail(str(error))
    try:
        lens, fit = fit_lens(forward, camera)
    except ArgumentError as error:
        (model or record).fail(str(error))
    return CameraFile(lens, kind, fit)


def fitted_lens(
    record: Record, kind: str, lens: ForeignLens, size: tuple[int, int], model: Record | None = None
) -> CameraFile:
    """The same for a lens model that several formats share, with what of it λ cannot describe.

    Raises
    ------
    InputError
        As :func:`fitted_camera`.
    """
    stretch = lens.focal[0] / lens.focal[1] - 1.0
    cause = ""
    if abs(stretch) > _SQUARE:
        cause = f"its focal lengths along x and y differ by {abs(stretch):.1%}, but only square pixels are known here"
    try:
        found = fitted_camera(record, kind, lens.distort, size, lens.center, lens.mean_focal, model)
    except InputError as error:
        raise InputError(f"{error}; {cause}" if cause else str(error)) from error
    return replace(found, cause=cause)


def comments(camera: Camera, fit: LensFit, model: str) -> str:
    """Comment lines, the last one with the camera itself."""
    return f"# {model}: at most {fit.largest:.3f} pixels from the lens\n{_OWN}{json.dumps(own_node(camera, fit))}\n"


def read_comments(text: str, file: str, kind: str) -> CameraFile | None:
    """The camera of a comment line; None where there is none."""
    own = next((line for line in text.splitlines() if line.startswith(_OWN)), None)
    if own is None:
        return None
    return CameraFile(camera_from_record(parse_json(own.removeprefix(_OWN), file)), kind)
