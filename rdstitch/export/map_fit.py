"""The similarity from an output to the map by where its cameras were.

A position is that of a camera's centre of projection. Where the images have poses, the plane is where they put it under
the cameras; the fit has seven parameters, those of a similarity in space: four on the map, the height, and the slope
of the ground, which is level unless altitudes show otherwise. Two more are what images leave open of the cameras: the
focal length, with which heights and tilts grow, and the tilt that all share, with which the plane under a flight of one
heading leans. With homographies alone, the camera is above the point that its attitude says, else above the centre of
its image.

All is linear in small quantities, and solved by weighted least squares with priors; weights vanish for outliers.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from rdstitch.arrays import BoolArray, FloatArray
from rdstitch.geometry.camera import Camera
from rdstitch.geometry.radial_homography import to_plane
from rdstitch.robust.similarity_fit import OUTLYING, fit_similarity

SLOPE_STD = math.radians(1.0)
"""Of the ground: level to gently sloping in the classes of the FAO (up to 5 %)."""

_TILT_STD = math.radians(3.0)  # of a camera that is taken to look straight down, and of an attitude
_METRIC = 1e-4  # by which the axes of a plane seen from above differ, of their length: rounding
_ROUNDS = 12
_SMALLEST = 0.1  # pixels of the images: an error that every position has
_SHOWN = 4.0  # standard deviations from which on the ground is not level
_SLOPE = slice(5, 7)  # among the parameters
_MEDIANS = 2.0  # of the residuals: standard deviations and more, whatever the share that is wrong

POSITION_STD = 3.0
"""Metres: of one coordinate of a position by a receiver without corrections, within one flight."""

ComplexArray = NDArray[np.complex128]


@dataclass(frozen=True, eq=False)
class Views:
    """Where images, or points, are in the output: pixels as x - i y."""

    ground: ComplexArray  # (N,): middle of each image, or the point
    foot: ComplexArray  # (N,): what is straight below the camera, or the point
    height: FloatArray  # (N,): of the camera above the plane, pixels of the output; NaN where not known
    right: ComplexArray  # (N,): direction of the image's x axis, of length one
    known: Literal["poses", "attitudes", "centres", "points"]
    pixel: float = 1.0  # of the images, in the middle, pixels of the output
    focal_std: float = 0.0  # relative, of the focal length
    tilt_std: float = 0.0  # of the tilt that all images share, by their own axes, radians

    @classmethod
    def of_ground(cls, points: ComplexArray) -> "Views":
        """Of points on the ground."""
        return cls(points, points, np.full(len(points), np.nan), np.ones_like(points), "points")

    @property
    def usable(self) -> BoolArray:
        """Which of them are in the output (N,)."""
        return np.isfinite(self.foot)

    def of(self, chosen: BoolArray) -> "Views":
        """Some of them."""
        picked: dict[str, Any] = {n: getattr(self, n)[chosen] for n in ("ground", "foot", "height", "right")}
        return replace(self, **picked)


def views_of(
    cameras: Sequence[Camera], to_output: FloatArray, nadirs: Sequence[tuple[float, float, float] | None]
) -> Views:
    """The cameras of images that ``to_output`` (N, 3, 3) takes to the output; straight down by each one's attitude."""
    each = list(zip(cameras, to_output, strict=True))
    middle = np.array([_in_output(c, h, _middle(c)) for c, h in each])
    beside = np.array([_in_output(c, h, _middle(c) + np.array([1.0, 0.0])) for c, h in each])
    right = (beside - middle) / np.abs(beside - middle)
    pixel = float(np.median(np.abs(beside - middle)))
    focal = np.array([np.nan if c.focal is None else c.focal for c in cameras])
    if np.isfinite(focal).all() and (centres := _centres(cameras, focal, to_output)) is not None:
        known = cameras[0]
        tilt, tilt_std = known.tilt or (0.0, 0.0), known.tilt_std or (0.0, 0.0)
        # Tilt and focal length are known together far better than each is.
        rest = np.square(tilt_std) - np.square(np.array(tilt) * known.focal_log_std)
        tilt_alone = math.sqrt(max(float(rest.max()), 0.0))
        foot = centres[:, 0] - 1j * centres[:, 1]
        return Views(middle, foot, centres[:, 2], right, "poses", pixel, known.focal_log_std, tilt_alone)
    # A guess where nobody knows the focal length.
    height = np.array([c.with_focal().focal or 0.0 for c in cameras]) * np.abs(beside - middle)
    below = [_below(camera, nadir) for camera, nadir in zip(cameras, nadirs, strict=True)]
    if all(pixel is not None for pixel in below):
        foot = np.array([_in_output(*one, pixel) for one, pixel in zip(each, below, strict=True) if pixel is not None])
        return Views(middle, foot, height, right, "attitudes", pixel, 0.0, _TILT_STD)
    return Views(middle, middle, height, right, "centres", pixel, 0.0, _TILT_STD)


def _middle(camera: Camera) -> FloatArray:
    """The centre of an image, pixels."""
    width, height = camera.image_size
    return np.array([(width - 1) / 2, (height - 1) / 2])


def _in_output(camera: Camera, homography: FloatArray, pixel: FloatArray) -> complex:
    x, y = to_plane(camera, homography, pixel[None]).reshape(2)
    return complex(x, -y)


def _below(camera: Camera, nadir: tuple[float, float, float] | None) -> FloatArray | None:
    """The pixel straight below a camera by its attitude; None where that is not known or not ahead."""
    if nadir is None or camera.focal is None or nadir[2] <= 0.0:
        return None
    pixel: FloatArray = camera.distort(np.array([camera.center]) + np.array([nadir[:2]]) / nadir[2] * camera.focal)[0]
    return pixel


def _centres(cameras: Sequence[Camera], focal: FloatArray, to_output: FloatArray) -> FloatArray | None:
    """Centres of projection (N, 3): x, y and height above the output's plane, in its pixels.

    None where these are no images of a plane seen straight from above, as where the output is the plane of an image.
    """
    scale = np.array([camera.scale for camera in cameras]) / focal
    rays = np.linalg.inv(to_output)
    rays[:, :2] *= scale[:, None, None]
    lengths = np.linalg.norm(rays[:, :, :2], axis=1)
    rays /= lengths.mean(axis=1)[:, None, None]
    product = rays[:, :, :2].transpose(0, 2, 1) @ rays[:, :, :2]
    if not np.abs(product - np.eye(2)).max() < _METRIC:
        return None
    axes = np.concatenate([rays[:, :, :2], np.cross(rays[:, :, 0], rays[:, :, 1])[:, :, None]], axis=2)
    centres: FloatArray = -np.einsum("nij,ni->nj", axes, rays[:, :, 2])
    # The sign of a homography, and with it that of z, is arbitrary; the camera is above the plane.
    centres[:, 2] = np.abs(centres[:, 2])
    return centres


@dataclass(frozen=True, eq=False)
class MapFit:
    """``place = scale * pixel + origin`` in complex numbers, of places on the ground."""

    scale: complex
    origin: complex
    left_out: ComplexArray  # (N,): how far each position is from where all others put it
    used: BoolArray  # (N,)
    std: float | None  # of one coordinate of the ground, in the mean over what the images show
    slope_squared: float = 0.0  # of the ground, over its variance


@dataclass(frozen=True, eq=False)
class Measured:
    """Places of cameras or points on the map."""

    places: ComplexArray  # (N,): easting + i northing, m
    altitude: FloatArray  # (N,): m; NaN where not known
    # (N, 2): standard deviations of one horizontal coordinate and of the altitude, NaN where not known; where residuals
    # are larger, these count
    std: FloatArray
    leverage: FloatArray  # (N,): how far they have put themselves where the views are already, 0 to 1
    map_scale: float = 1.0  # metres of the map per metre on the ground

    def of(self, wanted: BoolArray) -> "Measured":
        """Some of them."""
        places, altitude = self.places[wanted], self.altitude[wanted]
        return Measured(places, altitude, self.std[wanted], self.leverage[wanted], self.map_scale)

    @property
    def has_std(self) -> bool:
        """Whether the accuracy of any is known."""
        return bool(np.isfinite(self.std).any())

    @property
    def full_std(self) -> FloatArray:
        """Standard deviations of all (N, 2); what is not known is what receivers have, or 1 m if none is known."""
        return np.where(np.isfinite(self.std), self.std, POSITION_STD if self.has_std else 1.0)


def fit_map(views: Views, measured: Measured) -> MapFit:
    """Fit measured places; the ground is level unless they clearly show that it slopes."""
    level = _fitted(views, measured, 0.0)
    if level is None or not _has_altitudes(views, measured.altitude).any():
        return level or _no_fit(len(measured.places))
    sloping = _fitted(views, measured, SLOPE_STD)
    return sloping if sloping is not None and sloping.slope_squared > _SHOWN**2 else level


def _no_fit(count: int) -> MapFit:
    return MapFit(0.0, 0.0, np.full(count, complex(np.inf)), np.zeros(count, dtype=bool), None)


def _fitted(views: Views, measured: Measured, slope_std: float) -> MapFit | None:
    """The fit of ground that slopes by so many radians."""
    places, declared, std = measured.places, measured.has_std, measured.full_std
    start = fit_similarity(views.foot, places, POSITION_STD)
    scale, middle, center = start.scale, complex(views.foot.mean()), complex(places.mean())
    if not (abs(scale) > 0.0 and math.isfinite(abs(scale))):
        return None
    weights = np.stack([start.weights, start.weights], axis=1)
    noise = np.full(
        2, 1.0 if declared else max(float(np.median(start.residuals)), _SMALLEST * views.pixel * abs(scale))
    )
    for _ in range(_ROUNDS):
        system = _system(views, places - center, measured.altitude, scale, measured.map_scale, slope_std)
        precision = np.repeat(weights / (std * noise) ** 2, (2, 1), axis=1)  # of east, north, altitude (N, 3)
        weighted = system.rows * precision[..., None]
        normal = np.einsum("nij,nik->jk", weighted, system.rows) + np.diag(system.prior)
        inverse = np.linalg.inv(normal)
        solution = inverse @ np.einsum("nij,ni->j", weighted, system.right)
        residual = system.rows @ solution - system.right
        hat = np.einsum("nij,jk,nlk->nil", system.rows, inverse, weighted)
        scale = scale * (1.0 + complex(solution[0], solution[1]))
        origin = center + complex(solution[2], solution[3])
        away = np.stack([np.hypot(residual[:, 0], residual[:, 1]), np.abs(residual[:, 2])], axis=1) / std
        # No position is off by less than a part of a pixel.
        least = 1.0 if declared else _SMALLEST * views.pixel * abs(scale)
        width = OUTLYING * np.maximum(least, _MEDIANS * np.median(away, axis=0))
        weights = 1.0 / (1.0 + (away / width) ** 2) ** 2
        used = away <= width
        own = np.stack([hat[:, 0, 0] + hat[:, 1, 1], hat[:, 2, 2]], axis=1).sum(axis=0)
        free = 1.0 - measured.leverage
        taken = free / np.maximum(1.0 - (hat[:, 0, 0] + hat[:, 1, 1]) / 2.0, free)
        squares = (weights * away**2 / np.stack([taken, np.ones_like(taken)], axis=1)).sum(axis=0)
        counts = (weights * (2.0, 1.0)).sum(axis=0)
        noise = np.maximum(np.sqrt(squares / np.maximum(counts - own, 0.25 * counts)), least)
        if not declared:  # no receiver measures heights better than places
            noise[1] = max(noise)
    left_out = np.linalg.solve(np.eye(3) - hat, residual[..., None])[..., 0] / taken[:, None]
    ground = scale * (views.ground - middle)
    turned = np.stack([np.stack([ground.real, -ground.imag]), np.stack([ground.imag, ground.real])], axis=-1)
    moved = np.concatenate([turned, np.tile(np.eye(2)[:, None], (1, len(places), 1))], axis=-1)
    variance = float(np.einsum("cni,ij,cnj->cn", moved, inverse[:4, :4], moved).mean())
    slope = solution[_SLOPE]
    return MapFit(
        scale,
        origin - scale * middle,
        left_out[:, 0] + 1j * left_out[:, 1],
        used[:, 0],
        math.sqrt(variance * _dependence(left_out[used[:, 0]])),
        float(slope @ np.linalg.solve(inverse[_SLOPE, _SLOPE], slope)),
    )


def _dependence(residuals: FloatArray) -> float:
    """By what variances of means grow since errors (N, 3) of successive positions are alike."""
    horizontal = residuals[:, :2]
    correlation = float((horizontal[1:] * horizontal[:-1]).sum() / max(float((horizontal**2).sum()), 1e-300))
    correlation = min(max(correlation, 0.0), 0.9)
    return (1.0 + correlation) / (1.0 - correlation)


@dataclass(frozen=True, eq=False)
class _System:
    rows: FloatArray  # (N, 3, P): derivatives of east, north and altitude
    right: FloatArray  # (N, 3): what they are to be
    prior: FloatArray  # (P,): inverse variances of the parameters


def _has_altitudes(views: Views, altitude: FloatArray) -> BoolArray:
    """Which altitudes (N,) can be compared with heights; such as are all the same were set, and not measured."""
    known: BoolArray = np.isfinite(altitude) & np.isfinite(views.height) & (views.known == "poses")
    return known if known.any() and np.ptp(altitude[known]) > 0.0 else np.zeros_like(known)


def _system(
    views: Views, places: ComplexArray, altitude: FloatArray, scale: complex, map_scale: float, slope_std: float
) -> _System:
    """The equations, linear around a scale, of places relative to their mean.

    Parameters: relative change of the scale (2), place of the middle (2), altitude of the ground in the middle, its
    slope (2), relative change of the focal length, tilt that all images share (2).
    """
    count, middle = len(places), complex(views.foot.mean())
    rows, right = np.zeros((count, 3, 10)), np.zeros((count, 3))
    height = abs(scale) * np.nan_to_num(views.height)  # on the map
    base, lever = scale * (views.foot - middle), scale * (views.foot - views.ground)
    leaning = views.right * (scale / abs(scale))
    tilted = height * leaning
    columns = (base, 1j * base, np.ones(count), np.full(count, 1j), np.zeros(count), height, 1j * height)
    for k, column in enumerate((*columns, 2.0 * lever, tilted, 1j * tilted)):
        rows[:, 0, k], rows[:, 1, k] = column.real, column.imag
    moved = places - base
    right[:, 0], right[:, 1] = moved.real, moved.imag
    known = _has_altitudes(views, altitude)
    away = places / map_scale
    rise = height / map_scale
    slopes = [-(np.conj(axis) * away).real for axis in (1.0, 1j, leaning, 1j * leaning)]
    none = np.zeros(count)
    vertical = np.stack([rise, none, none, none, none + 1.0, *slopes[:2], rise, *slopes[2:]], axis=1)
    rows[known, 2] = vertical[known]
    right[known, 2] = (altitude - rise)[known]
    held = 1e-9  # standard deviation of what is not a parameter here
    stds = np.array([np.inf] * 4 + [np.inf if known.any() else held] + [max(slope_std, held)] * 2)
    cameras = np.array([max(views.focal_std, held), *[max(views.tilt_std, held)] * 2])
    return _System(rows, right, 1.0 / np.concatenate([stds, cameras]) ** 2)
