"""The camera: image size, distortion centre, focal length and division-model distortion λ.

Points are in pixels ``(u, v)`` with the centre of the top-left pixel at ``(0, 0)``, or *normalized*:
``x = (u - c) / s`` with ``c`` the distortion centre and ``s`` the scale in px. λ belongs to its scale;
:class:`Camera` keeps it for ``s`` = half the image diagonal, so that ``1 + λ`` is the factor at the image
corner.

The division model (Fitzgibbon 2001; Valtonen Örnhag et al., eq. 2) with an optional second coefficient μ is
``x_u = x_d / (1 + λ r² + μ r⁴)``, ``r = |x_d|``; λ < 0 is barrel distortion.
"""

import json
import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rdstitch.arrays import FloatArray
from rdstitch.errors import ArgumentError
from rdstitch.records import Record, read_json

_NEWTON_STEPS, _NEWTON_TOLERANCE = 12, 1e-14

FOCAL_LOG_STD = {"option": 0.01, "file": 0.01, "estimate": 0.05, "exif": 0.05, "guess": 0.3}
"""Standard deviation of the logarithm of a focal length, by where it comes from."""

_FOCAL_LIMITS = 0.05, 1e3  # half diagonals; the widest fisheyes have 0.3

_GUESSED_FOCAL = 1.2  # half diagonals: a 26 mm lens on 36 x 24 mm, in the middle of what phones and drones carry


def undistort(points: ArrayLike, distortion: ArrayLike, distortion2: float = 0.0) -> FloatArray:
    """Undistort normalized points.

    Parameters
    ----------
    points : array_like of shape (..., 2)
        Distorted points, normalized with the centre at the origin.
    distortion : array_like
        λ in the same frame; its shape broadcasts against ``points.shape[:-1]``.
    distortion2 : float
        μ in the same frame.

    Returns
    -------
    ndarray of shape (..., 2)
        Undistorted points; NaN where the model has no meaning (``1 + λ r² + μ r⁴ <= 0``).
    """
    x = np.asarray(points, dtype=np.float64)
    radius2 = np.einsum("...i,...i->...", x, x)
    denominator = 1.0 + (np.asarray(distortion) + distortion2 * radius2) * radius2
    return x / np.where(denominator > 0.0, denominator, np.nan)[..., None]


def distort(points: ArrayLike, distortion: ArrayLike, distortion2: float = 0.0) -> FloatArray:
    """Distort normalized points: the inverse of :func:`undistort`.

    For μ = 0 in closed form, ``x_d = 2 x_u / (1 + sqrt(1 - 4 λ |x_u|²))``, which is stable at λ = 0 and at the
    centre; otherwise Newton's method on the radius starts there.

    Parameters
    ----------
    points : array_like of shape (..., 2)
        Undistorted points, normalized with the centre at the origin.
    distortion, distortion2
        As in :func:`undistort`.

    Returns
    -------
    ndarray of shape (..., 2)
        Distorted points; NaN where no distorted point maps to the given one.
    """
    x = np.asarray(points, dtype=np.float64)
    radius2 = np.einsum("...i,...i->...", x, x)
    discriminant = 1.0 - 4.0 * np.asarray(distortion) * radius2
    if distortion2 == 0.0:
        return x * (2.0 / (1.0 + np.sqrt(np.where(discriminant >= 0.0, discriminant, np.nan))))[..., None]
    with np.errstate(over="ignore", invalid="ignore"):
        ratio = _two_coefficient_ratio(radius2, np.asarray(distortion), distortion2, discriminant)
    return x * ratio[..., None]


def _two_coefficient_ratio(
    radius2: FloatArray, distortion: NDArray[Any], distortion2: float, discriminant: FloatArray
) -> FloatArray:
    """``r_d / r_u`` for λ and μ: Newton on ``k = 1 + λ k² r² + μ k⁴ r⁴``, from the root for μ = 0."""
    ratio = 2.0 / (1.0 + np.sqrt(np.maximum(discriminant, 0.0)))
    for _ in range(_NEWTON_STEPS):
        value = 1.0 - ratio + distortion * ratio**2 * radius2 + distortion2 * ratio**4 * radius2**2
        slope = -1.0 + 2.0 * distortion * ratio * radius2 + 4.0 * distortion2 * ratio**3 * radius2**2
        step = value / np.where(slope < 0.0, slope, -1.0)
        ratio = ratio - step
        if not (np.abs(step) > _NEWTON_TOLERANCE).any():
            break
    value = 1.0 - ratio + distortion * ratio**2 * radius2 + distortion2 * ratio**4 * radius2**2
    slope = -1.0 + 2.0 * distortion * ratio * radius2 + 4.0 * distortion2 * ratio**3 * radius2**2
    solved = (np.abs(value) <= 1e-9 * np.abs(ratio)) & (ratio > 0.0) & (slope < 0.0)
    return np.where(solved, ratio, np.nan)


def is_focal_length(focal: float, image_size: tuple[int, int]) -> bool:
    """Whether a number can be a focal length, px, of pictures of a size; damaged files hold others."""
    low, high = _FOCAL_LIMITS
    return low < focal / (math.hypot(*image_size) / 2) < high


@dataclass(frozen=True)
class Camera:
    """One camera with one lens.

    Attributes
    ----------
    image_size : (int, int)
        Width and height, px.
    distortion : float
        λ of the division model for ``s`` = half the image diagonal; negative is barrel distortion.
    distortion2 : float
        μ, coefficient of r⁴, in the same frame; 0 for the one-parameter model.
    center : (float, float), optional
        Distortion centre and principal point, px; the image centre if not given.
    focal : float or None
        Focal length, px, or None where nothing is known of it.
    focal_source : str or None
        Where the focal length comes from, a key of :data:`FOCAL_LOG_STD`.
    distortion_std : float or None
        Standard deviation of λ; None where it was given and not estimated.

    Raises
    ------
    ArgumentError
        When a value is not finite, or when λ folds the picture at a corner.
    """

    image_size: tuple[int, int]
    distortion: float = 0.0
    distortion2: float = 0.0
    center: tuple[float, float] = (math.nan, math.nan)
    focal: float | None = None
    focal_source: str | None = None
    distortion_std: float | None = None

    def __post_init__(self) -> None:
        """Fill in the image centre and check every value."""
        width, height = self.image_size
        if width < 1 or height < 1:
            raise ArgumentError(f"image size must be at least 1 x 1 pixel, not {width} x {height}")
        if all(math.isnan(value) for value in self.center):
            object.__setattr__(self, "center", ((width - 1) / 2, (height - 1) / 2))
        numbers = (self.distortion, self.distortion2, *self.center)
        if not all(math.isfinite(value) for value in numbers):
            raise ArgumentError(f"camera has a value that is not finite: {numbers}")
        if self.focal is not None and not is_focal_length(self.focal, self.image_size):
            raise ArgumentError(f"no lens has a focal length of {self.focal:g} px for {width} x {height} px")
        if self.focal_source is not None and self.focal_source not in FOCAL_LOG_STD:
            raise ArgumentError(f"unknown source of a focal length: {self.focal_source!r}")
        with np.errstate(all="ignore"):  # absurd values, from a damaged file, overflow
            corners = undistort(self.normalize(self.outline(1)), self.distortion, self.distortion2)
        if not np.isfinite(corners).all():
            raise ArgumentError(f"distortion {self.distortion:g} folds the picture at a corner; it must be above -1")

    @property
    def half_diagonal(self) -> float:
        """Half the image diagonal, px: the scale ``s`` of the frame that λ is given in."""
        return math.hypot(*self.image_size) / 2

    @property
    def distortion_px(self) -> float:
        """λ for points in px from the centre: ``λ / s²``, 1/px²."""
        return self.distortion / self.half_diagonal**2

    @property
    def distortion_focal(self) -> float | None:
        """λ for points in focal lengths from the centre, or None without a focal length."""
        return None if self.focal is None else self.distortion_px * self.focal**2

    @property
    def focal_log_std(self) -> float:
        """Standard deviation of the logarithm of the focal length."""
        return FOCAL_LOG_STD[self.focal_source or "guess"]

    def with_focal(self) -> Self:
        """The camera with a guessed focal length where none is known."""
        if self.focal is not None:
            return self
        return replace(self, focal=_GUESSED_FOCAL * self.half_diagonal, focal_source="guess")

    def normalize(self, points: ArrayLike) -> FloatArray:
        """Pixels (..., 2) to normalized points, in half diagonals from the centre."""
        return (np.asarray(points, dtype=np.float64) - self.center) / self.half_diagonal

    def denormalize(self, points: ArrayLike) -> FloatArray:
        """Normalized points (..., 2), in half diagonals from the centre, to pixels."""
        return np.asarray(points, dtype=np.float64) * self.half_diagonal + self.center

    def undistort(self, points: ArrayLike) -> FloatArray:
        """Measured pixels (..., 2) to the pixels of a lens without distortion; NaN outside the model's domain."""
        return self.denormalize(undistort(self.normalize(points), self.distortion, self.distortion2))

    def distort(self, points: ArrayLike) -> FloatArray:
        """Pixels (..., 2) of a lens without distortion to measured pixels; NaN outside the model's domain."""
        return self.denormalize(distort(self.normalize(points), self.distortion, self.distortion2))

    def outline(self, points_per_side: int) -> FloatArray:
        """Outer border of the picture, clockwise from the top-left corner, px, shape (4 points_per_side, 2)."""
        width, height = self.image_size
        corners = np.array([(0, 0), (width, 0), (width, height), (0, height)], dtype=np.float64) - 0.5
        steps = np.arange(points_per_side)[:, None] / points_per_side
        sides = [a + steps * (b - a) for a, b in zip(corners, np.roll(corners, -1, axis=0), strict=True)]
        return np.concatenate(sides)

    def resized(self, image_size: tuple[int, int]) -> Self:
        """The same lens on a picture of another size: λ stays, centre and focal length scale."""
        if image_size == self.image_size:
            return self
        factor = math.hypot(*image_size) / math.hypot(*self.image_size)
        offset = [(c - (n - 1) / 2) * factor for c, n in zip(self.center, self.image_size, strict=True)]
        center = ((image_size[0] - 1) / 2 + offset[0], (image_size[1] - 1) / 2 + offset[1])
        focal = None if self.focal is None else self.focal * factor
        return replace(self, image_size=image_size, center=center, focal=focal)

    def as_dict(self) -> dict[str, Any]:
        """Everything known of the camera as plain values, the content of a camera file."""
        return {
            "format": "rdstitch camera",
            "version": 1,
            "image_size": list(self.image_size),
            "center_px": list(self.center),
            "lambda": self.distortion,
            "lambda_std": self.distortion_std,
            "lambda2": self.distortion2,
            "lambda_px": self.distortion_px,
            "lambda_focal": self.distortion_focal,
            "focal_px": self.focal,
            "focal_source": self.focal_source,
        }

    def save(self, path: str | Path) -> None:
        """Write a camera file (JSON) that :meth:`load` reads."""
        Path(path).write_text(json.dumps(self.as_dict(), indent=2) + "\n", encoding="utf-8")

    @classmethod
    def load(cls, path: str | Path) -> Self:
        """Read a camera file.

        Raises
        ------
        InputError
            When the file cannot be read or is no camera file.
        """
        return cls.from_record(read_json(path))

    @classmethod
    def from_record(cls, record: Record) -> Self:
        """The camera that :meth:`as_dict` gave.

        Raises
        ------
        InputError
            When the record is something else; the text names the field.
        """
        if record["format"].value != "rdstitch camera" or record["version"].value != 1:
            record.fail("is not an rdstitch camera of version 1")
        focal, std, second = record.get("focal_px"), record.get("lambda_std"), record.get("lambda2")
        try:
            return cls(
                image_size=record["image_size"].size(),
                distortion=record["lambda"].number(),
                distortion2=0.0 if second is None else second.number(),
                center=record["center_px"].pair(),
                focal=None if focal is None else focal.number(),
                focal_source=None if focal is None else "file",
                distortion_std=None if std is None else std.number(),
            )
        except ArgumentError as error:
            record.fail(str(error))
