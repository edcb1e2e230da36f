"""Gain compensation and vignetting: gain per picture and channel, and one vignetting for all.

Two pictures of one point of the plane differ by their gains and the vignetting alone, which are linear in the
logarithm (:mod:`rdstitch.compositing.photometric`). Which response of the camera the pictures follow is decided by the
residuals. What is left over, and the brightness of the whole, is left to :mod:`rdstitch.compositing.brightness`.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.linalg import spsolve

from rdstitch.arrays import FloatArray
from rdstitch.camera import Camera
from rdstitch.compositing.boxes import Box, cut
from rdstitch.compositing.photometric import Exposure, full_scale, no_exposure, squared_radius
from rdstitch.compositing.placed_picture import PlacedPicture
from rdstitch.compositing.survey import Survey, SurveyTile

_SRGB_OFFSET = 0.055
# Samples outside this part of the range are clipped or mostly noise.
_DARKEST, _BRIGHTEST = 0.02, 0.97
_SAMPLES_PER_PAIR, _MAX_SAMPLES = 800, 200_000
_MIN_SAMPLES = 30
# Of thousands of overlaps, each needs fewer.
_FEWEST_SAMPLES = 10
# How well two pictures' brightness can agree, and how far gains stray (log units): keeps long chains from drifting.
_PAIR_SIGMA, _GAIN_SIGMA = 0.02, 0.5
# The same where the camera has written its exposure down: tone curves and apertures are not exact.
_EXIF_SIGMA = 0.15
# Power of the light that samples follow, for the prior: sRGB above its toe, or raw light.
_SRGB_POWER = 2.4
_VIGNETTING_SIGMA, _VIGNETTING_RANGE = 1.0, (0.15, 1.25)
_HUBER = 1.345
_ROUNDS = 6
# A model with more freedom must explain the data better by this share to be taken.
_MIN_RELATIVE_GAIN = 0.02


def estimate_gains(survey: Survey, pictures: Sequence[PlacedPicture]) -> Exposure:
    """Least squares over all overlaps, robust against what differs for other reasons (parallax, people).

    Parameters
    ----------
    pictures : sequence of PlacedPicture
        The distortion centre is the centre of the vignetting, and the exposure that the camera wrote down is a weak
        prior of the gain.

    Returns
    -------
    Exposure
        Without any correction where no pictures overlap.
    """
    cameras, exposures = zip(*((picture.camera, picture.exposure) for picture in pictures), strict=True)
    present = [tile for tile in survey.tiles if tile is not None]
    channels = present[0].pixels.shape[2] if present else 1
    samples = _collect(survey, cameras)
    if samples is None:
        return no_exposure(len(cameras), channels)
    offsets = (_SRGB_OFFSET, 0.0) if present[0].pixels.dtype.kind == "u" else (0.0,)
    priors = [_gain_prior(exposures, b) for b in offsets]
    fits = (_fit_light(samples, b, prior) for b, prior in zip(offsets, priors, strict=True))
    return min(fits, key=lambda fit: fit.rms_after)


def _gain_prior(exposures: Sequence[float | None], offset: float) -> tuple[FloatArray, FloatArray]:
    """Expected log gain of each picture, and its precision (N,): from the exposures where two or more are known."""
    count = len(exposures)
    mean, precision = np.zeros(count), np.full(count, _GAIN_SIGMA**-2)
    known = np.array([k for k, value in enumerate(exposures) if value is not None and value > 0.0], dtype=np.intp)
    if len(known) > 1:
        light = np.log([exposures[k] or 1.0 for k in known])
        mean[known] = (light - light.mean()) / (_SRGB_POWER if offset else 1.0)
        precision[known] = _EXIF_SIGMA**-2
    return mean, precision


@dataclass(frozen=True)
class _Samples:
    """Points that two pictures see: picture, weight, value (share of full) and r² of either; S of each.

    They are sorted by pair; ``start`` is where those of each begin.
    """

    start: NDArray[np.intp]
    first: NDArray[np.intp]
    second: NDArray[np.intp]
    share: FloatArray
    value1: FloatArray
    value2: FloatArray
    radius1: FloatArray
    radius2: FloatArray


def _collect(survey: Survey, cameras: Sequence[Camera]) -> _Samples | None:
    """Samples from every pair of overlapping pictures, evenly spread."""
    pairs = survey.pairs().tolist()
    limit = max(_FEWEST_SAMPLES, min(_SAMPLES_PER_PAIR, _MAX_SAMPLES // max(1, len(pairs))))
    found: list[tuple[Any, ...]] = []
    for i, j in pairs:
        a, b, box, inside = survey.overlap(i, j)
        where = np.flatnonzero(inside)
        if len(where) < _MIN_SAMPLES:
            continue
        where = where[:: max(1, len(where) // limit)]
        va, vb = (_values(tile, box, where) for tile in (a, b))
        usable = ((np.minimum(va, vb) > _DARKEST) & (np.maximum(va, vb) < _BRIGHTEST)).all(axis=1)
        if a.pixels.dtype.kind != "u":
            usable = ((va > 0) & (vb > 0)).all(axis=1)
        where, va, vb = where[usable], va[usable], vb[usable]
        if len(where) < min(_MIN_SAMPLES, limit):
            continue
        y, x = (index.astype(np.float64) for index in np.unravel_index(where, inside.shape))
        pa, pb = (survey.warps[k].source_points(x + box[0], y + box[1]) for k in (i, j))
        found.append((i, j, va, vb, squared_radius(cameras[i], pa), squared_radius(cameras[j], pb)))
    if not found:
        return None
    counts = [len(f[2]) for f in found]
    first, second = (np.repeat([f[k] for f in found], counts) for k in (0, 1))
    # A pair counts as one measurement however many samples it has.
    share = np.repeat([1.0 / n for n in counts], counts)
    start = np.concatenate([[0], np.cumsum(counts)[:-1]])
    return _Samples(start, first, second, share, *(np.concatenate([f[k] for f in found]) for k in range(2, 6)))


def _values(tile: SurveyTile, box: Box, where: NDArray[np.intp]) -> FloatArray:
    """Samples as share of the full range, (S, C)."""
    pixels = cut(tile.pixels, tile.box, box).reshape(-1, tile.pixels.shape[2])
    return pixels[where].astype(np.float64) / full_scale(tile.pixels.dtype)


def _fit_light(samples: _Samples, offset: float, prior: tuple[FloatArray, FloatArray]) -> Exposure:
    """Gains, and vignetting where it explains the data better."""
    gains, vignetted = (_fit(samples, offset, prior, vignetting) for vignetting in (False, True))
    return vignetted if vignetted.rms_after < (1.0 - _MIN_RELATIVE_GAIN) * gains.rms_after else gains


def _fit(samples: _Samples, offset: float, prior: tuple[FloatArray, FloatArray], vignetting: bool) -> Exposure:
    """Gains and vignetting for one response of the camera, by iteratively reweighted least squares."""
    count = len(prior[0])
    difference = np.log(samples.value1 + offset) - np.log(samples.value2 + offset)
    grey = difference.mean(axis=1)
    level = np.sqrt((samples.value1.mean(axis=1) + offset) * (samples.value2.mean(axis=1) + offset))
    powers = [samples.radius1**k - samples.radius2**k for k in (1, 2, 3)]
    radial = np.stack(powers, axis=1) if vignetting else np.zeros((len(grey), 0))
    robust = np.ones(len(grey))
    before = _robust_rms(grey * level, samples.share)
    for _ in range(_ROUNDS):
        weight = robust * samples.share / _PAIR_SIGMA**2
        solution = _solve(samples, weight, grey[:, None], radial, prior)
        residual = grey - (solution[samples.first] - solution[samples.second])[:, 0] - radial @ solution[count:, 0]
        scale = max(1.4826 * float(np.median(np.abs(residual))), 1e-4)
        robust = 1.0 / np.maximum(1.0, np.abs(residual) / (_HUBER * scale))
    coefficients = np.zeros(3)
    if vignetting:
        coefficients = solution[count:, 0]
        profile = np.exp(np.stack([np.linspace(0, 1, 20) ** k for k in (1, 2, 3)], axis=1) @ coefficients)
        if not ((profile > _VIGNETTING_RANGE[0]) & (profile < _VIGNETTING_RANGE[1])).all():
            return Exposure(offset, np.zeros((count, difference.shape[1])), rms_before=before, rms_after=np.inf)
    flat = difference - (radial @ solution[count:])
    gains = _solve(samples, robust * samples.share / _PAIR_SIGMA**2, flat, np.zeros((len(grey), 0)), prior)
    after = _robust_rms((flat - gains[samples.first] + gains[samples.second]).mean(axis=1) * level, samples.share)
    return Exposure(offset, gains, coefficients, rms_before=before, rms_after=after)


def _robust_rms(errors: FloatArray, share: FloatArray) -> float:
    """Mean absolute error over pairs."""
    return float((np.abs(errors) * share).sum() / share.sum())


def _solve(
    samples: _Samples,
    weight: FloatArray,
    values: FloatArray,
    radial: FloatArray,
    prior_gain: tuple[FloatArray, FloatArray],
) -> FloatArray:
    """Weighted least squares of ``g_first - g_second + radial a = values``; shape (N + K, C)."""
    (mean, precision), extra = prior_gain, radial.shape[1]
    count = len(mean)
    # All samples of a pair have the same gains: their normal equations are summed first.
    ends = samples.first[samples.start], samples.second[samples.start]
    total, gain_radial, gain_value = (
        np.add.reduceat(weight[:, None] * v, samples.start, axis=0) for v in (np.ones((len(weight), 1)), radial, values)
    )
    between = sparse.csr_array(
        (np.repeat([1.0, -1.0], len(total)), (np.concatenate(ends), np.tile(np.arange(len(total)), 2))),
        shape=(count, len(total)),
    )
    border = sparse.csr_array(between @ gain_radial)
    gains = between @ sparse.diags_array(total[:, 0]) @ between.T
    bends = sparse.csr_array((weight[:, None] * radial).T @ radial)
    prior = sparse.diags_array(np.concatenate([precision, np.full(extra, _VIGNETTING_SIGMA**-2)]))
    normal = sparse.block_array([[gains, border], [border.T, bends]]) + prior
    expected = (precision * mean)[:, None]
    right = np.concatenate([between @ gain_value + expected, (weight[:, None] * radial).T @ values])
    return np.asarray(spsolve(normal.tocsc(), right), dtype=np.float64).reshape(count + extra, -1)
