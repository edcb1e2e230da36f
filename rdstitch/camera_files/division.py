"""What every foreign camera file gets besides: the division model itself, so that λ comes back as it was."""

from dataclasses import dataclass
from typing import Any

from rdstitch.camera import Camera
from rdstitch.camera_files.lens_fit import Forward, LensFit, fit_lens
from rdstitch.errors import ArgumentError
from rdstitch.records import Record


@dataclass(frozen=True)
class CameraFile:
    """A camera as a file tells it.

    Attributes
    ----------
    camera : Camera
    kind : str
        Whose format it is: "rdstitch", "OpenCV", "OpenDroneMap" or "Hugin".
    fit : LensFit or None
        How well λ agrees with the file's own lens model; None where the file gives λ itself.
    """

    camera: Camera
    kind: str
    fit: LensFit | None = None


def own_node(camera: Camera, fit: LensFit) -> dict[str, Any]:
    """The camera, and the residual of the model that was fitted to it; what is not known is left out."""
    known = {key: value for key, value in camera.as_dict().items() if value is not None}
    return {**known, "fit_rms_px": fit.rms, "fit_largest_px": fit.largest}


def fitted_camera(record: Record, kind: str, forward: Forward, camera: Camera) -> CameraFile:
    """A camera whose λ is fitted to the lens model of a file.

    Raises
    ------
    InputError
        When that is impossible.
    """
    try:
        lens, fit = fit_lens(forward, camera)
        return CameraFile(lens, kind, fit)
    except ArgumentError as error:
        record.fail(str(error))
