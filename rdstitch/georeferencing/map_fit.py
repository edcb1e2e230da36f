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
from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from rdstitch.arrays import BoolArray, ComplexArray, FloatArray
from rdstitch.geometry.places import POSITION_STD
from rdstitch.georeferencing.camera_views import Views
from rdstitch.robust.similarity_fit import OUTLYING, fit_similarity

SLOPE_STD = math.radians(1.0)  # of the ground: level to gently sloping in the classes of the FAO (up to 5 %)
_ROUNDS = 12
_SMALLEST = 0.1  # pixels of the images: an error that every position has
_SHOWN = 4.0  # standard deviations from which on the ground is not level
_MEDIANS = 2.0  # of the residuals: standard deviations and more, whatever the share that is wrong
_HELD = 1e-9  # standard deviation of what is not a parameter
# Parameters: relative change of the scale, place of the middle, altitude of the ground there, its slope; relative
# change of the focal length, tilt that all images share.
_SCALE, _ORIGIN, _ALTITUDE, _SLOPE, _FOCAL, _TILT = (slice(*ends) for ends in pairwise((0, 2, 4, 5, 7, 8, 10)))
_PARAMETERS = 10


@dataclass(frozen=True, eq=False)
class MapFit:
    """``place = scale * pixel + origin`` in complex numbers, of places on the ground."""

    scale: complex
    origin: complex
    left_out: ComplexArray  # (N,): how far each position is from where all others put it
    used: BoolArray  # (N,)
    std: float | None  # of one coordinate of the ground, in the mean over what the images show
    scale_std: float = 0.0  # relative, of the scale; of the direction in radians
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
    if level is None:
        count = len(measured.places)
        return MapFit(0.0, 0.0, np.full(count, complex(np.inf)), np.zeros(count, dtype=bool), None)
    if not _has_altitudes(views, measured.altitude).any():
        return level
    sloping = _fitted(views, measured, SLOPE_STD)
    return sloping if sloping is not None and sloping.slope_squared > _SHOWN**2 else level


def _fitted(views: Views, measured: Measured, slope_std: float) -> MapFit | None:
    """The fit of ground that slopes by so many radians."""
    places = measured.places
    start = fit_similarity(views.foot, places, POSITION_STD)
    scale, middle, center = start.scale, complex(views.foot.mean()), complex(places.mean())
    if not (abs(scale) > 0.0 and math.isfinite(abs(scale))):
        return None
    # No position is off by less than a part of a pixel.
    smallest = 0.0 if measured.has_std else _SMALLEST * views.pixel
    noise = 1.0 if measured.has_std else max(float(np.median(start.residuals)), smallest * abs(scale))
    trust = _Trust(np.stack([start.weights, start.weights], axis=1), np.full(2, noise), start.weights > 0.0)
    for _ in range(_ROUNDS):
        system = _system(views, places - center, measured.altitude, scale, measured.map_scale, slope_std)
        step = _solved(system, np.repeat(trust.weights / (measured.full_std * trust.noise) ** 2, (2, 1), axis=1))
        scale = scale * (1.0 + complex(*step.solution[_SCALE]))
        origin = center + complex(*step.solution[_ORIGIN])
        trust = _reweighted(step, measured, 1.0 if measured.has_std else smallest * abs(scale))
    left_out = np.linalg.solve(np.eye(3) - step.hat, step.residual[..., None])[..., 0]
    left_out = left_out / step.own_freedom(measured.leverage)[:, None]
    dependence = _dependence(left_out[trust.used])
    slope = step.solution[_SLOPE]
    return MapFit(
        scale,
        origin - scale * middle,
        left_out[:, 0] + 1j * left_out[:, 1],
        trust.used,
        math.sqrt(_ground_variance(scale * (views.ground - middle), step.covariance) * dependence),
        math.sqrt(np.trace(step.covariance[_SCALE, _SCALE]) / 2.0 * dependence),
        float(slope @ np.linalg.solve(step.covariance[_SLOPE, _SLOPE], slope)),
    )


class _Trust(NamedTuple):
    """How far each measurement counts."""

    weights: FloatArray  # (N, 2): of the place and of the altitude; 0 for what is far off
    noise: FloatArray  # (2,): of both, in their standard deviations
    used: BoolArray  # (N,): places that are not far off


class _Step(NamedTuple):
    solution: FloatArray  # (P,)
    covariance: FloatArray  # (P, P)
    residual: FloatArray  # (N, 3): east, north, altitude
    hat: FloatArray  # (N, 3, 3): how far each measurement moves its own prediction

    def own_freedom(self, leverage: FloatArray) -> FloatArray:
        """Part (N,) of an error of a place that its residual shows, where it has put itself by ``leverage`` before."""
        free = 1.0 - leverage
        return np.asarray(free / np.maximum(1.0 - (self.hat[:, 0, 0] + self.hat[:, 1, 1]) / 2.0, free))


def _solved(system: "_System", precision: FloatArray) -> _Step:
    """Least squares with priors; ``precision`` (N, 3) of east, north and altitude."""
    weighted = system.rows * precision[..., None]
    normal = np.einsum("nij,nik->jk", weighted, system.rows) + np.diag(system.prior)
    covariance = np.linalg.inv(normal)
    solution = covariance @ np.einsum("nij,ni->j", weighted, system.right)
    hat = np.einsum("nij,jk,nlk->nil", system.rows, covariance, weighted)
    return _Step(solution, covariance, system.rows @ solution - system.right, hat)


def _reweighted(step: _Step, measured: Measured, least: float) -> _Trust:
    """What the residuals say of each measurement and of the noise, which is ``least`` or more."""
    (east, north, up), hat = step.residual.T, step.hat
    away = np.stack([np.hypot(east, north), np.abs(up)], axis=1) / measured.full_std
    width = OUTLYING * np.maximum(least, _MEDIANS * np.median(away, axis=0))
    weights = 1.0 / (1.0 + (away / width) ** 2) ** 2
    own = np.stack([hat[:, 0, 0] + hat[:, 1, 1], hat[:, 2, 2]], axis=1).sum(axis=0)
    freedom = step.own_freedom(measured.leverage)
    squares = (weights * away**2 / np.stack([freedom, np.ones_like(freedom)], axis=1)).sum(axis=0)
    counts = (weights * (2.0, 1.0)).sum(axis=0)
    noise = np.maximum(np.sqrt(squares / np.maximum(counts - own, 0.25 * counts)), least)
    if not measured.has_std:  # no receiver measures heights better than places
        noise[1] = max(noise)
    return _Trust(weights, noise, (away <= width)[:, 0])


def _ground_variance(ground: ComplexArray, covariance: FloatArray) -> float:
    """Of one coordinate, in the mean over places (N,) on the map, relative to the middle."""
    turned = np.stack([np.stack([ground.real, -ground.imag]), np.stack([ground.imag, ground.real])], axis=-1)
    moved = np.concatenate([turned, np.tile(np.eye(2)[:, None], (1, len(ground), 1))], axis=-1)
    return float(np.einsum("cni,ij,cnj->cn", moved, covariance[:4, :4], moved).mean())


def _dependence(residuals: FloatArray) -> float:
    """By what variances of means grow since errors (N, 3) of successive positions are alike."""
    horizontal = residuals[:, :2]
    correlation = float((horizontal[1:] * horizontal[:-1]).sum() / max(float((horizontal**2).sum()), 1e-300))
    correlation = min(max(correlation, 0.0), 0.9)
    return (1.0 + correlation) / (1.0 - correlation)


class _System(NamedTuple):
    """Equations that are linear around a scale; P parameters, named by their slices above."""

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
    """The equations of places relative to their mean."""
    rows, right = np.zeros((len(places), 3, _PARAMETERS)), np.zeros((len(places), 3))
    height = abs(scale) * np.nan_to_num(views.height)  # on the map
    base, lever = scale * (views.foot - complex(views.foot.mean())), scale * (views.foot - views.ground)
    leaning = views.right * (scale / abs(scale))
    one = np.ones_like(base)
    on_map = [
        (_SCALE, (base, 1j * base)),
        (_ORIGIN, (one, 1j * one)),
        (_SLOPE, (height, 1j * height)),
        (_FOCAL, (2.0 * lever,)),
        (_TILT, (height * leaning, 1j * (height * leaning))),
    ]
    for parameters, columns in on_map:
        shift = np.stack(columns, axis=1)
        rows[:, 0, parameters], rows[:, 1, parameters] = shift.real, shift.imag
    right[:, 0], right[:, 1] = (places - base).real, (places - base).imag
    known, away, rise = _has_altitudes(views, altitude), places / map_scale, height / map_scale
    slopes = [-(np.conj(axis) * away).real for axis in (1.0, 1j, leaning, 1j * leaning)]
    vertical = [
        (_SCALE, (rise, np.zeros_like(rise))),
        (_ALTITUDE, (np.ones_like(rise),)),
        (_SLOPE, slopes[:2]),
        (_FOCAL, (rise,)),
        (_TILT, slopes[2:]),
    ]
    for parameters, lifts in vertical:
        rows[known, 2, parameters] = np.stack(lifts, axis=1)[known]
    right[known, 2] = (altitude - rise)[known]
    std = np.full(_PARAMETERS, np.inf)
    std[_ALTITUDE] = np.inf if known.any() else _HELD
    std[_SLOPE], std[_FOCAL], std[_TILT] = (max(value, _HELD) for value in (slope_std, views.focal_std, views.tilt_std))
    return _System(rows, right, 1.0 / std**2)
