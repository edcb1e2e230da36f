"""The camera as a record: its own files, which sidecars and the files of other programs hold too."""

import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any, Literal, cast

from msgspec import UNSET, Meta, Struct, UnsetType, field

from rdstitch.choices import FocalSource
from rdstitch.geometry.camera import FOCAL_LOG_STD, Camera
from rdstitch.geometry.lens_model import LensModel
from rdstitch.system.file_access import read_text
from rdstitch.system.output_checks import check_outputs, check_suffix
from rdstitch.system.outputs import json_bytes, write_bytes_atomic
from rdstitch.system.records import NonNegative, Pair, Size, Triple, convert, parse_json, to_jsonable

VERSION = 2
"""Version 1 had λ and μ only, as ``lambda`` and ``lambda2``."""

_MAX_COEFFICIENTS = 8  # of lens models: OpenCV's rational one
_Row = tuple[float, float, float, float, float]
_Covariance = tuple[_Row, _Row, _Row, _Row, _Row]


class LensRecord(Struct, kw_only=True):
    """What of a camera depends on the size of the image, and λ with it."""

    center_px: Pair | None = None
    image_circle_px: float | None = None
    lambda_: float | None = field(name="lambda", default=None)
    lambda2: float | UnsetType = UNSET  # of version 1
    coefficients: Triple | None = None
    lens_model: LensModel | None = None
    focal_px: float | None = None
    focal_source: FocalSource | None = None

    def lens(self, size: tuple[int, int]) -> Camera:
        """The lens on an image of a size; not how far it is determined."""
        if self.center_px is None or (self.coefficients is None and self.lambda_ is None):
            raise ValueError(f"{'center_px' if self.center_px is None else 'lambda'} is missing")
        if self.lens_model is not None and len(self.lens_model.coefficients) > _MAX_COEFFICIENTS:
            raise ValueError(f"lens_model.coefficients: expected at most {_MAX_COEFFICIENTS}")
        second = 0.0 if self.lambda2 is UNSET else self.lambda2
        distortion, second, third = self.coefficients or (self.lambda_ or 0.0, second, 0.0)
        return Camera(
            image_size=size,
            distortion=distortion,
            distortion2=second,
            distortion3=third,
            center=self.center_px,
            focal=self.focal_px,
            focal_source=self.focal_source,
            image_circle=self.image_circle_px,
            lens_model=self.lens_model,
        )


class CameraRecord(LensRecord):
    """A camera file of rdstitch."""

    format: Literal["rdstitch camera"]
    version: Annotated[int, Meta(ge=1, le=VERSION)]
    image_size: Size
    lambda_std: NonNegative | None = None
    lambda_observable: bool = True
    lambda_fit_rms_px: NonNegative = 0.0
    lambda_fit_largest_px: NonNegative = 0.0
    lens_covariance: _Covariance | None = None
    lambda_px: float | None = None
    lambda_focal: float | None = None
    focal_std_px: NonNegative | None = None
    tilt_deg: Pair | None = None
    tilt_std_deg: Pair | None = None

    def __post_init__(self) -> None:
        self.camera()

    def camera(self) -> Camera:
        """The camera that it describes."""
        lens = self.lens(self.image_size)
        source, std = lens.focal_source, self.focal_std_px
        if source not in ("guess", "exif"):  # which are no calibration by being saved
            if lens.focal is not None and source == "estimate" and std is None:
                std = FOCAL_LOG_STD[source] * lens.focal
            source = None if lens.focal is None else "file"
        return replace(
            lens,
            focal_source=source,
            distortion_std=self.lambda_std or None if self.lambda_observable else math.inf,  # 0 of earlier versions
            lens_covariance=self.lens_covariance,
            focal_std=std,
            tilt=_converted(math.radians, self.tilt_deg),
            tilt_std=_converted(math.radians, self.tilt_std_deg),
        )


def _converted(convert_angle: Callable[[float], float], angles: Pair | None) -> Pair | None:
    return None if angles is None else (convert_angle(angles[0]), convert_angle(angles[1]))


def lens_fields(camera: Camera) -> dict[str, Any]:
    """The fields of :class:`LensRecord`."""
    return {
        "center_px": camera.center,
        "image_circle_px": camera.image_circle,
        "lambda_": camera.nearest_distortion,
        "coefficients": camera.coefficients,
        "lens_model": camera.lens_model,
        "focal_px": camera.focal,
        "focal_source": camera.focal_source or (None if camera.focal is None else "guess"),
    }


def camera_record(camera: Camera) -> CameraRecord:
    """Everything known of a camera."""
    _, rms, largest = camera.one_parameter_fit()
    if camera.focal_std == math.inf:  # nothing was found of it
        camera = replace(camera, focal_source="guess", focal_std=None)
    tilt_std = camera.tilt_std if camera.tilt_std and all(map(math.isfinite, camera.tilt_std)) else None
    return CameraRecord(
        "rdstitch camera",
        VERSION,
        camera.image_size,
        lambda_std=camera.distortion_std,
        lambda_observable=camera.distortion_std != math.inf,
        lambda_fit_rms_px=rms,
        lambda_fit_largest_px=largest,
        lens_covariance=cast("_Covariance | None", camera.lens_covariance),
        lambda_px=camera.distortion_px,
        lambda_focal=camera.distortion_focal,
        focal_std_px=camera.focal_std,
        tilt_deg=_converted(math.degrees, camera.tilt),
        tilt_std_deg=_converted(math.degrees, tilt_std),
        **lens_fields(camera),
    )


def camera_json(camera: Camera) -> dict[str, Any]:
    """The content of a camera file."""
    content: dict[str, Any] = to_jsonable(camera_record(camera))
    return content


def save_own(camera: Camera, path: str | Path) -> None:
    """Write a camera file."""
    check_outputs([check_suffix(path, (".json",))], overwrite=True)
    write_bytes_atomic(path, json_bytes(camera_json(camera)))


def load_own(path: str | Path) -> Camera:
    """Read a camera file."""
    return convert(parse_json(read_text(path), str(path)), CameraRecord, str(path)).camera()
