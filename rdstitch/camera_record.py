"""Cameras from what :meth:`rdstitch.camera.Camera.as_dict` gave: records of camera files and sidecars."""

import math
from dataclasses import replace
from typing import Annotated, Literal

from msgspec import Meta, Struct, field

from rdstitch.camera import FILE_VERSION, Camera
from rdstitch.records import NonNegative, Pair, Size, Triple

FocalSource = Literal["option", "file", "exif", "estimate", "guess"]
_Row = tuple[float, float, float, float, float]


class LensRecord(Struct, kw_only=True):
    """What of a camera depends on the size of the image, and λ with it."""

    center_px: Pair | None = None
    image_circle_px: float | None = None
    lambda_: float | None = field(name="lambda", default=None)
    # Version 1 had λ and μ only.
    lambda2: float = 0.0
    coefficients: Triple | None = None
    focal_px: float | None = None
    focal_source: FocalSource | None = None

    def lens(self, size: tuple[int, int]) -> Camera:
        """The lens on an image of a size; not how far it is determined.

        Raises
        ------
        ValueError
            When there is none, or it is impossible.
        """
        if self.center_px is None or (self.coefficients is None and self.lambda_ is None):
            raise ValueError(f"{'center_px' if self.center_px is None else 'lambda'} is missing")
        distortion, second, third = self.coefficients or (self.lambda_ or 0.0, self.lambda2, 0.0)
        return Camera(
            image_size=size,
            distortion=distortion,
            distortion2=second,
            distortion3=third,
            center=self.center_px,
            focal=self.focal_px,
            focal_source=self.focal_source,
            image_circle=self.image_circle_px,
        )


class CameraRecord(LensRecord, kw_only=True):
    """A camera file of rdstitch."""

    format: Literal["rdstitch camera"]
    version: Annotated[int, Meta(ge=1, le=FILE_VERSION)]
    image_size: Size
    lambda_std: NonNegative | None = None
    lambda_fit_rms_px: NonNegative = 0.0
    lambda_fit_largest_px: NonNegative = 0.0
    lens_covariance: tuple[_Row, _Row, _Row, _Row, _Row] | None = None
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
        return replace(
            lens,
            focal_source=None if lens.focal is None else "file",
            distortion_std=self.lambda_std,
            lens_covariance=self.lens_covariance,
            focal_std=self.focal_std_px,
            tilt=_radians(self.tilt_deg),
            tilt_std=_radians(self.tilt_std_deg),
        )


def _radians(angles: Pair | None) -> Pair | None:
    return None if angles is None else (math.radians(angles[0]), math.radians(angles[1]))
