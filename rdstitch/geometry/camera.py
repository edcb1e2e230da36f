"""The camera: image size, distortion centre, focal length and division-model distortion λ.

Points are in pixels ``(u, v)`` with the centre of the top-left pixel at ``(0, 0)``, or *normalized*:
``x = (u - c) / s`` with ``c`` the distortion centre and ``s`` the scale in pixels. λ belongs to its scale;
:class:`Camera` keeps it for ``s`` = half the image diagonal, so that ``1 + λ`` is the factor at the image
corner; where the lens draws a circle that is smaller than the image, ``s`` is the radius of that circle.

The lens is the division model of :mod:`rdstitch.geometry.division_model`, with λ alone or with further even
coefficients.
"""

import math
import operator
from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from numbers import Real
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike

from rdstitch.arrays import FloatArray
from rdstitch.choices import FocalSource
from rdstitch.errors import ArgumentError, ImpossibleCameraError
from rdstitch.geometry.division_model import (
    distort,
    folds,
    horizon_radius,
    is_one_to_one,
    nearest_one_parameter,
    stretch_radius,
    undistort,
)
from rdstitch.geometry.exif_orientation import SIDEWAYS, turned_size, turning_matrix
from rdstitch.geometry.lens_model import LensModel
from rdstitch.geometry.planar_motion import turned_tilt

LENS_PARAMETERS = ("distortion", "distortion2", "distortion3", "center_x", "center_y")
"""The parameters of a lens: λ, μ, ν, and the distortion centre, in the half-diagonal frame."""

FOCAL_LOG_STD: dict[FocalSource, float] = {"option": 0.01, "file": 0.01, "estimate": 0.05, "exif": 0.05, "guess": 0.3}
"""Standard deviation of the logarithm of a focal length, by where it comes from."""

_LEAST_LOG_STD = 1e-6  # of a focal length: what is exact has no inverse variance
_GRID = 33  # points along each side of the image at which lenses are compared
_FOCAL_LIMITS = 0.05, 1e3  # half diagonals; the widest fisheyes have 0.3
_NEAREST_HORIZON = 0.2  # half diagonals: a circle of 180 degrees that is smaller is a wrong camera file

_MAX_STRETCH = 20.0
"""How much the lens may stretch what is drawn where it sees beyond the horizon: to 77 degrees off the axis."""

_SHAPES: dict[str, tuple[int, ...]] = {
    "distortion": (),
    "distortion2": (),
    "distortion3": (),
    "center": (2,),
    "focal": (),
    "focal_std": (),
    "distortion_std": (),
    "tilt": (2,),
    "tilt_std": (2,),
    "image_circle": (),
    "lens_covariance": (5, 5),
}
"""Of the numbers that a camera has."""

_GUESSED_FOCAL = 1.2  # half diagonals: a 26 mm lens on 36 x 24 mm, in the middle of what phones and drones carry


def _real_numbers(name: str, value: Any, shape: tuple[int, ...]) -> Any:
    """A number, or tuples of them, of a shape."""
    if not shape and not isinstance(value, bool) and isinstance(value, Real):
        return float(value)
    rows = tuple(value) if shape and isinstance(value, Iterable) else ()
    if not rows or len(rows) != shape[0]:
        wanted = " x ".join(map(str, shape)) + " numbers" if shape else "a number"
        raise ArgumentError(f"{name} of a camera must be {wanted}, not {value!r}")
    return tuple(_real_numbers(name, row, shape[1:]) for row in rows)


def _pairs(points: ArrayLike) -> FloatArray:
    """Points as an array of pairs of coordinates."""
    array = np.asarray(points, dtype=np.float64)
    if array.shape[-1:] != (2,):
        raise ArgumentError(f"points must be an array of shape (..., 2), not {array.shape}")
    return array


def is_focal_length(focal: float, image_size: tuple[int, int]) -> bool:
    """Check whether a number can be a focal length, pixels, of images of a size; damaged files hold others."""
    low, high = _FOCAL_LIMITS
    return low < focal / (math.hypot(*image_size) / 2) < high


def border_of(image_size: tuple[int, int], points_per_side: int) -> FloatArray:
    """Outer border of a whole image, clockwise from the top-left corner, pixels, (4 points_per_side, 2)."""
    width, height = image_size
    corners = np.array([(0, 0), (width, 0), (width, height), (0, height)], dtype=np.float64) - 0.5
    steps = np.arange(points_per_side)[:, None] / points_per_side
    sides = [a + steps * (b - a) for a, b in zip(corners, np.roll(corners, -1, axis=0), strict=True)]
    return np.concatenate(sides)


def points_over(image_size: tuple[int, int], per_side: int) -> FloatArray:
    """Points on a grid from edge to edge of a whole image, row by row, pixels, (per_side², 2)."""
    u, v = (np.linspace(-0.5, side - 0.5, per_side) for side in image_size)
    return np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 2)


@dataclass(frozen=True)
class Camera:
    """One camera with one lens.

    Attributes
    ----------
    image_size : (int, int)
        Width and height, pixels.
    distortion : float
        λ of the division model for ``s`` = half the image diagonal; negative is barrel distortion.
    distortion2, distortion3 : float
        μ and ν, coefficients of r⁴ and r⁶, in the same frame; 0 for the one-parameter model.
    center : (float, float), optional
        Distortion centre and principal point, pixels; the image centre if not given.
    focal : float or None
        Focal length, pixels, or None where nothing is known of it.
    focal_source : FocalSource or None
        Where the focal length comes from, a key of :data:`FOCAL_LOG_STD`; None counts as "guess".
    focal_std : float or None
        Standard deviation of an estimated focal length, pixels; None where :data:`FOCAL_LOG_STD` stands for it.
    tilt, tilt_std : (float, float) or None
        (ψ, θ) of the camera to the plane of its images, radians, and their standard deviations; None where not known.
    distortion_std : float or None
        Standard deviation of :attr:`nearest_distortion`, with what is left open of parameters that were not estimated,
        and of the ground; None where it was given and not estimated.
    image_circle : float or None
        Radius about :attr:`center`, pixels, out to which the lens draws; None where it fills the image.
    lens_covariance : tuple of 5 tuples of 5 floats, or None
        Covariance of :data:`LENS_PARAMETERS` by the matches alone, if those that were not estimated, for which it is
        zero, are exactly as given; None where nothing was.
    lens_model : LensModel or None
        The lens itself, of another program's calibration, that the coefficients only come close to: images are
        resampled so that they are exactly those of the coefficients. None where they are so as they are.

    Raises
    ------
    ArgumentError
        When a value is of another type or shape, or not finite, or a standard deviation negative; when the lens folds
        the image: its model must be one-to-one out to the corners, or to the horizon, the rays at 90 degrees to its
        axis; or when that is so near that next to nothing is seen.

    Notes
    -----
    What a fisheye of 180 degrees and more shows beyond its horizon has no place on a plane: it is undistorted to NaN,
    and masked in images.
    """

    image_size: tuple[int, int]
    distortion: float = 0.0
    distortion2: float = 0.0
    center: tuple[float, float] = None  # type: ignore[assignment]  # never so once it is made
    focal: float | None = None
    focal_source: FocalSource | None = None
    distortion_std: float | None = None
    distortion3: float = 0.0
    lens_covariance: tuple[tuple[float, ...], ...] | None = field(default=None, repr=False)
    focal_std: float | None = None
    tilt: tuple[float, float] | None = None
    tilt_std: tuple[float, float] | None = None
    image_circle: float | None = None
    lens_model: LensModel | None = field(default=None, repr=False)

    def __post_init__(self) -> None:
        """Fill in the image centre and check every value."""
        try:
            width, height = map(operator.index, self.image_size)
        except (TypeError, ValueError):
            raise ArgumentError(f"image size must be two whole numbers of pixels, not {self.image_size}") from None
        if width < 1 or height < 1:
            raise ArgumentError(f"image size must be at least 1 x 1 pixel, not {width} x {height}")
        object.__setattr__(self, "image_size", (width, height))
        for name, shape in _SHAPES.items():  # tuples, whatever was given: cameras are compared and hashed
            value = self.image_center if name == "center" and self.center is None else getattr(self, name)
            if value is not None or self.__dataclass_fields__[name].default is not None:
                object.__setattr__(self, name, _real_numbers(name, value, shape))
        self._check_numbers()
        self._check_focal()
        self._check_lens()

    @property
    def image_center(self) -> tuple[float, float]:
        """The middle of the image, pixels."""
        return (self.image_size[0] - 1) / 2, (self.image_size[1] - 1) / 2

    def _check_numbers(self) -> None:
        for name, values in (("value", (*self.coefficients, *self.center)), ("tilt", self.tilt or ())):
            if not all(map(math.isfinite, values)):
                raise ImpossibleCameraError(f"camera has a {name} that is not finite: {values}")
        if self.lens_covariance is not None and not all(math.isfinite(v) for row in self.lens_covariance for v in row):
            raise ImpossibleCameraError("camera has a covariance of the lens that is not finite")
        stds = (self.distortion_std, self.focal_std, *(self.tilt_std or ()))
        # Infinite is that of what is not observable.
        if not all(std >= 0.0 for std in stds if std is not None):
            raise ImpossibleCameraError(f"camera has a standard deviation that is not 0 or above: {stds}")

    def _check_focal(self) -> None:
        width, height = self.image_size
        if self.focal is not None and not is_focal_length(self.focal, self.image_size):
            raise ImpossibleCameraError(
                f"no lens of {width} x {height} pixels has a focal length of {self.focal:g} pixels"
            )
        if self.focal_source is not None and self.focal_source not in FOCAL_LOG_STD:
            raise ArgumentError(f"unknown source of a focal length: {self.focal_source!r}")

    def _check_lens(self) -> None:
        named = ", ".join(f"{value:g}" for value in self.coefficients if value)
        with np.errstate(all="ignore"):  # absurd values, from a damaged file, overflow
            if self.image_circle is not None and not self.image_circle > 0.0:
                raise ImpossibleCameraError(f"an image circle has a radius above 0 pixels, not {self.image_circle:g}")
            corner = self._corner_radius
            if not (math.isfinite(corner * corner) and not folds(corner, self.distortion, self.higher)):
                raise ImpossibleCameraError(f"distortion {named} folds the image")
            if horizon_radius(self.distortion, self.higher) < _NEAREST_HORIZON:
                raise ImpossibleCameraError(f"distortion {named} leaves next to nothing of the image before the camera")

    @property
    def coefficients(self) -> tuple[float, float, float]:
        """λ, μ and ν in the half-diagonal frame."""
        return self.distortion, self.distortion2, self.distortion3

    @property
    def higher(self) -> tuple[float, ...]:
        """μ and ν in the half-diagonal frame; empty for the one-parameter model."""
        return self.coefficients[1:] if any(self.coefficients[1:]) else ()

    @property
    def nearest_distortion(self) -> float:
        """λ of the one-parameter model that is nearest to this lens over the image; see :meth:`one_parameter_fit`."""
        return self.one_parameter_fit()[0]

    def one_parameter_fit(self) -> tuple[float, float, float]:
        """The one-parameter model nearest to this lens, and how far they are apart.

        Nearest by least squares of the measured places of the same rays, evenly over the image, up to the scale of
        the undistorted image; the distortion centre is the same.

        Returns
        -------
        distortion, rms, largest : float
            λ in the half-diagonal frame, and the distances in pixels. λ itself and 0 for a one-parameter lens.
        """
        if not self.higher:
            return self.distortion, 0.0, 0.0
        radii = np.sqrt(self.squared_radii())
        excess = self.excess_radius(radii)
        nearest, _ = nearest_one_parameter(radii**2, self.distortion, self.higher)
        return nearest, float(np.sqrt(np.mean(excess**2))), float(np.abs(excess).max())

    def excess_radius(self, radii: FloatArray) -> FloatArray:
        """How much farther out this lens measures rays than the nearest one-parameter lens does, pixels (N,).

        ``radii`` (N,) are where this lens measures them, half diagonals from the distortion centre.
        """
        nearest, scale = nearest_one_parameter(self.squared_radii(), self.distortion, self.higher)
        straight = undistort(np.stack([radii, np.zeros_like(radii)], axis=-1), self.distortion, self.higher)
        other = distort(straight / scale, nearest)[..., 0]
        return np.asarray((radii - other) * self.scale)

    @property
    def sees_beyond_horizon(self) -> bool:
        """Whether a part of the image shows what is at 90 degrees to the axis and more."""
        return not is_one_to_one(self._corner_radius, self.distortion, self.higher)

    @property
    def _corner_radius(self) -> float:
        """Distance of the farthest corner from the centre, or of the edge of the image circle, half diagonals."""
        farthest = (max(c, n - 1 - c) + 0.5 for c, n in zip(self.center, self.image_size, strict=True))
        return min(math.hypot(*farthest), self.image_circle or math.inf) / self.scale

    def squared_radii(self) -> FloatArray:
        """Squared radii, half diagonals, of points evenly over the image, as far as it can be undistorted."""
        x, y = self.normalize(points_over(self.image_size, _GRID)).T
        squares: FloatArray = x**2 + y**2
        farthest = self.drawn_radius / self.scale
        return squares[(squares > 0.0) & (squares <= farthest**2)]

    @property
    def drawn_radius(self) -> float:
        """Measured radius, pixels, up to which images are drawn; inf where that is all of them."""
        circle = self.image_circle or math.inf
        if not self.sees_beyond_horizon:
            return circle
        return min(circle, stretch_radius(self.distortion, self.higher, _MAX_STRETCH) * self.scale)

    @property
    def scale(self) -> float:
        """The scale ``s`` of λ's frame, pixels: half the image diagonal, or the radius of a smaller image circle."""
        return min(math.hypot(*self.image_size) / 2, self.image_circle or math.inf)

    @property
    def distortion_px(self) -> float:
        """:attr:`nearest_distortion` for points in pixels from the centre: ``λ / s²``, 1/px²."""
        return self.nearest_distortion / self.scale**2

    @property
    def distortion_focal(self) -> float | None:
        """:attr:`nearest_distortion` for points in focal lengths from the centre, or None without a focal length."""
        return None if self.focal is None else self.distortion_px * self.focal**2

    @property
    def focal_log_std(self) -> float:
        """Standard deviation of the logarithm of the focal length."""
        if self.focal is not None and self.focal_std is not None:
            return max(self.focal_std / self.focal, _LEAST_LOG_STD)
        return FOCAL_LOG_STD[self.focal_source or "guess"]

    def with_focal(self, focal: float, source: FocalSource = "guess", std: float | None = None) -> Self:
        """The camera with a focal length, pixels."""
        return replace(self, focal=focal, focal_source=source, focal_std=std)

    def with_guessed_focal(self) -> Self:
        """The camera with its focal length; with a guessed one where none is known."""
        return self if self.focal is not None else self.with_focal(_GUESSED_FOCAL * self.scale)

    def without_focal(self) -> Self:
        """The camera without its focal length."""
        return replace(self, focal=None, focal_source=None, focal_std=None)

    def with_coefficients(self, distortion: float, distortion2: float = 0.0, distortion3: float = 0.0) -> Self:
        """The camera with another, given lens; the distortion centre stays."""
        model = self.lens_model if (distortion, distortion2, distortion3) == self.coefficients else None
        return replace(
            self,
            distortion=distortion,
            distortion2=distortion2,
            distortion3=distortion3,
            distortion_std=None,
            lens_covariance=None,
            lens_model=model,
        )

    def without_lens(self) -> "Camera":
        """A camera of which only the images' size and centre, and its image circle, are known."""
        return Camera(self.image_size, center=self.center, image_circle=self.image_circle)

    def normalize(self, points: ArrayLike) -> FloatArray:
        """Pixels (..., 2) to normalized points, from the centre in units of :attr:`scale`."""
        return (_pairs(points) - self.center) / self.scale

    def denormalize(self, points: ArrayLike) -> FloatArray:
        """Normalized points (..., 2), from the centre in units of :attr:`scale`, to pixels."""
        return _pairs(points) * self.scale + self.center

    def undistort(self, points: ArrayLike) -> FloatArray:
        """Measured pixels (..., 2) to the pixels of a lens without distortion; NaN outside the model's domain."""
        return self.denormalize(undistort(self.normalize(points), self.distortion, self.higher))

    def distort(self, points: ArrayLike) -> FloatArray:
        """Pixels (..., 2) of a lens without distortion to measured pixels; NaN outside the model's domain."""
        return self.denormalize(distort(self.normalize(points), self.distortion, self.higher))

    def outline(self, points_per_side: int) -> FloatArray:
        """Outer border of what is drawn of the image, pixels, shape (4 points_per_side, 2).

        Clockwise from the top-left corner. Where the lens sees beyond the horizon, that lies within the circle up to
        which it stretches what it shows by less than 20 times.
        """
        border, farthest = border_of(self.image_size, points_per_side), self.drawn_radius
        if farthest == math.inf:
            return border
        offset = border - self.center
        radius = np.linalg.norm(offset, axis=1, keepdims=True)
        return np.asarray(self.center + offset * np.minimum(1.0, farthest / radius))

    def resized(self, image_size: tuple[int, int]) -> Self:
        """The same lens on an image of another size: λ stays, centre and focal length scale."""
        if tuple(image_size) == self.image_size:
            return self
        factor = math.hypot(*image_size) / math.hypot(*self.image_size)
        offset = [(c - (n - 1) / 2) * factor for c, n in zip(self.center, self.image_size, strict=True)]
        center = ((image_size[0] - 1) / 2 + offset[0], (image_size[1] - 1) / 2 + offset[1])
        focal, std, circle = (
            None if value is None else value * factor for value in (self.focal, self.focal_std, self.image_circle)
        )
        lens = None if self.lens_model is None else self.lens_model.resized(factor, center)
        sized = replace(self, image_size=image_size, center=center, focal=focal, focal_std=std, image_circle=circle)
        return replace(sized, lens_model=lens)

    def turned(self, orientation: int) -> Self:
        """The same camera on the image after an EXIF orientation: what has a direction is turned with it."""
        if orientation == 1:
            return self
        matrix, size = turning_matrix(orientation), turned_size(self.image_size, orientation)
        offset = matrix @ (np.array(self.center) - (np.array(self.image_size) - 1.0) / 2.0)
        x, y = (offset + (np.array(size) - 1.0) / 2.0).tolist()
        if (covariance := self.lens_covariance) is not None:
            lens = np.eye(len(LENS_PARAMETERS))
            lens[3:, 3:] = matrix
            covariance = tuple(map(tuple, (lens @ np.array(covariance) @ lens.T).tolist()))
        tilt, std = self.tilt, self.tilt_std
        if tilt is not None:
            tilt = turned_tilt(tilt, matrix)
        if std is not None and orientation in SIDEWAYS:
            std = std[1], std[0]
        turned = replace(self, image_size=size, center=(x, y), lens_covariance=covariance, tilt=tilt, tilt_std=std)
        return replace(turned, lens_model=None if self.lens_model is None else self.lens_model.turned(matrix, (x, y)))

    def save(self, path: str | Path) -> None:
        """Write a camera file of rdstitch, ``.json``; :func:`rdstitch.save_camera` writes the formats of others too.

        Raises
        ------
        OutputError
            When the name ends otherwise, or the file cannot be written.
        """
        from rdstitch.geometry.camera_record import save_own

        save_own(self, path)

    @staticmethod
    def load(path: str | Path) -> "Camera":
        """Read a camera file of rdstitch; :func:`rdstitch.load_camera` reads the formats of others too.

        Raises
        ------
        InputError
            When the file cannot be read or is no camera file of rdstitch.
        """
        from rdstitch.geometry.camera_record import load_own

        return load_own(path)
