"""What a camera file tells: the division model itself, or λ fitted to the lens model of others."""

from dataclasses import dataclass

from rdstitch.camera import Camera
from rdstitch.camera_files.lens_fit import Forward, LensFit, fit_lens
from rdstitch.camera_files.lens_models import ForeignLens
from rdstitch.errors import ArgumentError

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


def fitted_camera(
    forward: Forward,
    kind: str,
    size: tuple[int, int],
    center: tuple[float, float],
    focal: float,
    field: str = "",
    cause: str = "",
) -> CameraFile:
    """A camera whose λ is fitted to the lens model of a file.

    Raises
    ------
    ArgumentError
        When that is impossible; ``field`` begins and ``cause`` ends the text.
    """
    camera = Camera(size, center=center, focal=focal, focal_source="file")
    try:
        lens, fit = fit_lens(forward, camera)
    except ArgumentError as error:
        raise ArgumentError(f"{field}{error}{cause and f'; {cause}'}") from error
    return CameraFile(lens, kind, fit, cause)


def fitted_lens(lens: ForeignLens, kind: str, size: tuple[int, int], field: str = "") -> CameraFile:
    """The same for a lens model that several formats share, with what of it λ cannot describe."""
    stretch = lens.focal[0] / lens.focal[1] - 1.0
    cause = ""
    if abs(stretch) > _SQUARE:
        cause = f"its focal lengths along x and y differ by {abs(stretch):.1%}, but only square pixels are known here"
    return fitted_camera(lens.distort, kind, size, lens.center, lens.mean_focal, field, cause)
