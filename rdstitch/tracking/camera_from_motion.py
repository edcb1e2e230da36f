"""Tilt, focal length and delay of attitudes of a camera whose lens is known, by the motions between frames."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from rdstitch.alignment.delays import at_delay, smooth
from rdstitch.arrays import FloatArray
from rdstitch.geometry.planar_motion import rotation_from_tilt
from rdstitch.inputs.delays import DELAY_STD

_POINTS = 32  # of a pair; 16: NEES 0.78; 64: 1.06
_OUTLIER = 3.0  # medians of the errors; 2: three claims beyond 5 σ; 5: NEES 0.81
_TILT_STARTS = (0.0, 0.0), (0.35, 0.0), (-0.35, 0.0), (0.0, 0.35), (0.0, -0.35)
_STEPS = 15  # Gauss-Newton steps, at most
_HALVINGS = 6  # of a step, until errors become smaller
_DIFFERENCE = 1e-5  # radians (of log focal length, s): by which derivatives are taken
_SETTLED = 1e-6  # the same: a step that is the last
_MAX_CONDITION = 1e6  # of the derivatives, from which on motions show no focal length
_HORIZON = 0.05  # of a ray of unit depth: what is nearer to the horizon has no place
_SHARED = 2.0  # pairs that the errors of a frame are common to; 1: NEES 1.07, up to 4.7 σ; 4: 2.8 mm
_PSI, _THETA, _LOG_FOCAL, _DELAY = range(4)


@dataclass(frozen=True, eq=False)
class SeenPairs:
    """Points that K pairs of frames share."""

    rays: FloatArray  # (2, K, M, 2): undistorted, in focal lengths
    attitudes: FloatArray | None  # (2, K, S, 2): ψ and θ as measured at so many delays, radians
    weights: FloatArray  # (K, M): 0 for points that do not move with the plane, else 1

    @classmethod
    def of(cls, rays: Sequence[FloatArray], attitudes: Sequence[FloatArray]) -> "SeenPairs":
        """Pairs by the rays (N, 2) of the one and the other frame of the first pair, of the second, and so on."""
        chosen = [some[np.linspace(0, len(some) - 1, _POINTS).astype(np.intp)] for some in rays]
        measured = smooth(np.array([attitudes[::2], attitudes[1::2]])) if attitudes else None
        return cls(np.array([chosen[::2], chosen[1::2]]), measured, np.ones((len(chosen) // 2, _POINTS)))

    def errors(self, camera: FloatArray) -> FloatArray:
        """Errors (2 K M,) of points on the plane against a rigid motion, focal lengths; inf beyond the horizon.

        ``camera``: the tilt, the logarithm of how much longer the focal length is, and the delay.
        """
        focal_factor = math.exp(camera[_LOG_FOCAL])
        tilts = np.broadcast_to(camera[:2], (*self.rays.shape[:2], 2))
        if self.attitudes is not None:
            tilts = tilts + at_delay(self.attitudes, float(camera[_DELAY]))
        rays = np.concatenate([self.rays / focal_factor, np.ones((*self.rays.shape[:3], 1))], axis=-1)
        seen = rays @ rotation_from_tilt(tilts)
        depth = np.where(seen[..., 2] > _HORIZON, seen[..., 2], np.nan)
        places = np.nan_to_num((seen[..., 0] + 1j * seen[..., 1]) / depth, nan=np.inf)
        weights = self.weights
        middles = (places * weights).sum(axis=-1, keepdims=True) / weights.sum(axis=-1)[:, None]
        one, two = (places - middles) * weights
        turn = (one * two.conj()).sum(axis=-1, keepdims=True)
        # In given focal lengths, as the points were measured: a longer one makes no errors smaller.
        errors = (one - turn / np.maximum(abs(turn), 1e-300) * two) * focal_factor
        return np.concatenate([errors.real.ravel(), errors.imag.ravel()])

    def without_outliers(self, errors: FloatArray) -> "SeenPairs":
        """The pairs without the points whose ``errors`` are out of proportion to those of most."""
        size = np.hypot(*errors.reshape(2, *self.weights.shape))
        good = size <= _OUTLIER * np.median(size)
        enough = good.sum(axis=1, keepdims=True) >= _POINTS / 2
        return replace(self, weights=np.where(enough, good, 1.0))


@dataclass(frozen=True)
class CameraEstimate:
    """Camera as motions show it."""

    tilt_given_focal: tuple[float, float]  # (ψ, θ), radians, with the focal length that is given
    tilt_std: float  # of its less certain direction
    rms: float  # of the points on the plane, heights
    log_focal: float  # log of how much longer the focal length is than the given one, by the motions alone
    log_focal_std: float
    tilt_free_focal: tuple[float, float]  # (ψ, θ), radians, with the focal length that motions show
    delay: float  # s, by which times of attitudes are late; with the prior of that
    delay_std: float


def camera_from_motion(pairs: SeenPairs, tilt: tuple[float, float] | None = None) -> CameraEstimate:
    """The tilt, about as given if it is, and the focal length, by which the motions between frames are rigid."""
    count = pairs.rays.shape[1]
    base = [_PSI, _THETA] if pairs.attitudes is None else [_PSI, _THETA, _DELAY]
    with np.errstate(all="ignore"):  # beyond the horizon
        starts = _TILT_STARTS if tilt is None else (tilt,)
        fits = [_fitted(pairs, np.array([*start, 0.0, 0.0]), base) for start in starts]
        camera, value, slope = min(fits, key=lambda fit: _cost(fit[1]))
        if np.isfinite(value).all():
            pairs = pairs.without_outliers(value)
            camera, value, slope = _fitted(pairs, camera, base)
        if not np.isfinite(slope).all():
            return CameraEstimate((0.0, 0.0), math.inf, math.inf, 0.0, math.inf, (0.0, 0.0), 0.0, DELAY_STD)
        free = [*base, _LOG_FOCAL]
        freed, errors_freed, slope_freed = _fitted(pairs, camera, free)
    variance = _covariance(value, slope, count)
    known = np.isfinite(slope_freed).all() and np.linalg.cond(slope_freed) < _MAX_CONDITION and count >= 2 * len(free)
    freer = _covariance(errors_freed, slope_freed, count) if known else np.full((4, 4), math.inf)
    delay, delay_std = 0.0, DELAY_STD
    if pairs.attitudes is not None and variance[2, 2] > 0.0:
        delay_std = 1.0 / math.sqrt(1.0 / float(variance[2, 2]) + 1.0 / DELAY_STD**2)
        delay = float(camera[_DELAY]) * delay_std**2 / float(variance[2, 2])
    return CameraEstimate(
        (float(camera[_PSI]), float(camera[_THETA])),
        math.sqrt(max(float(np.linalg.eigvalsh(variance[:2, :2])[-1]), 0.0)),
        math.sqrt(_cost(value) / max(float(pairs.weights.sum()), 1.0)),
        float(freed[_LOG_FOCAL]) if known else 0.0,
        math.sqrt(float(freer[-1, -1])),
        (float(freed[_PSI]), float(freed[_THETA])),
        delay,
        delay_std,
    )


def _cost(errors: FloatArray) -> float:
    cost = float(errors @ errors)
    return cost if math.isfinite(cost) else math.inf


def _covariance(errors: FloatArray, slope: FloatArray, pairs: int) -> FloatArray:
    """Covariance (F, F) of what was fitted, by errors (2 K M,) that those of one pair may have in common."""
    freedom = slope.shape[1]
    inverse = np.linalg.pinv(slope.T @ slope, hermitian=True)
    variance = float(errors @ errors) / max(len(errors) - 3 * pairs - freedom, 1)
    of_pairs = (slope * errors[:, None]).reshape(2, pairs, -1, freedom).sum(axis=(0, 2))
    together = pairs / max(pairs - freedom, 1) * of_pairs.T @ of_pairs
    return np.asarray(variance * inverse + _SHARED * inverse @ together @ inverse)


def _fitted(pairs: SeenPairs, start: FloatArray, free: list[int]) -> tuple[FloatArray, FloatArray, FloatArray]:
    """The camera, its errors and their derivatives (2 N, F) after Gauss and Newton's steps."""
    camera, value, change = start, pairs.errors(start), np.full((1, len(free)), np.nan)
    steps = _DIFFERENCE * np.eye(len(start))[free]
    for _ in range(_STEPS):
        change = np.stack([pairs.errors(camera + step) - value for step in steps], axis=1) / _DIFFERENCE
        if not np.isfinite(change).all():
            break
        step = np.zeros(len(start))
        step[free] = np.linalg.lstsq(change, value, rcond=None)[0]
        shorter = ((step / 2**k, pairs.errors(camera - step / 2**k)) for k in range(_HALVINGS))
        step, after = next((one for one in shorter if _cost(one[1]) < _cost(value)), (step, None))
        if after is None:
            break
        camera, value = camera - step, after
        if abs(step).max() < _SETTLED:
            break
    return camera, value, change
