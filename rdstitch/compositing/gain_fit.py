"""Gain and vignetting of each image that explain what overlaps show, in the logarithm of the samples."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from rdstitch.arrays import FloatArray
from rdstitch.compositing.cell_least_squares import VISIBLE, Prior, fit_robustly
from rdstitch.compositing.overlap_cells import Cells
from rdstitch.compositing.photometric import Exposure, squared_radius
from rdstitch.compositing.source_images import PlacedImage
from rdstitch.system.late_imports import sparse

MIN_RELATIVE_GAIN = 0.05  # a model with more freedom must explain the data better by this share to be taken

_PAIR_SIGMA = 0.02  # log units to which the gains of two images can explain their overlap
_GAIN_SIGMA = 0.5  # log units that gains stray, which keeps long chains from drifting
_EXIF_SIGMA = 0.15  # the same where the camera wrote its exposure down: tone curves and apertures are not exact
# Power of the light that samples follow, for the prior: sRGB above its toe, or raw light.
_SRGB_POWER = 2.4
_VIGNETTING_SIGMA = 1.0  # of each coefficient
_VIGNETTING_RANGE = 0.15, 1.25  # of the light of the middle, that may be left at any radius


@dataclass(frozen=True, eq=False)
class Differences:
    """What the first image of each cell is brighter by, log units, for one response of the camera."""

    cells: Cells
    offset: float
    values: FloatArray  # (M, C)
    level: FloatArray  # (M,): share of the full range that one log unit is there

    @classmethod
    def of(cls, cells: Cells, offset: float) -> Self:
        log = np.log(cells.values + offset)
        return cls(cells, offset, log[0] - log[1], np.sqrt((cells.values.mean(axis=-1) + offset).prod(axis=0)))

    def misfit(self, errors: FloatArray, weights: FloatArray | None = None) -> float:
        """Geometric mean of what is left, share of the full range: content that differs hardly counts."""
        floor = VISIBLE * float(np.median(self.cells.values))
        size = np.hypot(np.abs(errors).max(axis=1) * self.level, floor)
        return float(np.exp(np.average(np.log(size), weights=self.cells.evidence if weights is None else weights)))


def fit_gain_and_vignetting(data: Differences, images: Sequence[PlacedImage]) -> tuple[Exposure, FloatArray]:
    """Gains, and vignetting where it explains the data better; and the errors."""
    cells, prior = data.cells, _gain_prior(images, data.offset)
    radius2 = np.empty((2, len(data.level)))
    for end, image, chosen in cells.by_image():
        radius2[end, chosen] = squared_radius(images[image].camera, cells.points[end, chosen])
    powers = np.stack([radius2[0] ** k - radius2[1] ** k for k in (1, 2, 3)], axis=1)
    gains, errors = _fit_gains(cells, data.values, powers[:, :0], prior)
    exposure = Exposure(data.offset, gains, rms_before=data.misfit(data.values), rms_after=data.misfit(errors))
    coefficients = _fit_gains(cells, data.values, powers, prior)[0][len(images) :].mean(axis=1)
    gains, flat = _fit_gains(cells, data.values - (powers @ coefficients)[:, None], powers[:, :0], prior)
    profile = np.exp(np.linspace(0.0, 1.0, 20)[:, None] ** (1, 2, 3) @ coefficients)
    possible = profile.min() > _VIGNETTING_RANGE[0] and profile.max() < _VIGNETTING_RANGE[1]
    if possible and (better := data.misfit(flat)) < (1.0 - MIN_RELATIVE_GAIN) * exposure.rms_after:
        return replace(exposure, log_gain=gains, vignetting=coefficients, rms_after=better), flat
    return exposure, errors


def _gain_prior(images: Sequence[PlacedImage], offset: float) -> tuple[FloatArray, FloatArray]:
    """Expected log gain of each image, and its precision (N,): from the exposures where two or more are known."""
    light = np.array([np.log(p.exposure) if p.exposure and p.exposure > 0.0 else np.nan for p in images])
    known = np.isfinite(light)
    if known.sum() < 2:
        return np.zeros(len(light)), np.full(len(light), _GAIN_SIGMA**-2)
    mean = (light - light[known].mean()) / (_SRGB_POWER if offset else 1.0)
    return np.where(known, mean, 0.0), np.where(known, _EXIF_SIGMA, _GAIN_SIGMA) ** -2.0


def _fit_gains(
    cells: Cells, values: FloatArray, radial: FloatArray, prior: tuple[FloatArray, FloatArray]
) -> tuple[FloatArray, FloatArray]:
    """Gains (N, C) and below them the coefficients of further columns (M, K), and the errors (M, C)."""
    (mean, precision), (rows, extra) = prior, radial.shape
    signed = np.tile([1.0, -1.0], rows), cells.images.T.ravel(), 2 * np.arange(rows + 1)
    design = sparse.hstack([sparse.csr_array(signed, shape=(rows, len(mean))), sparse.csr_array(radial)])
    # A pair counts as one measurement however many cells it has.
    weight = cells.evidence / (np.bincount(cells.pair, cells.evidence)[cells.pair].clip(1.0) * _PAIR_SIGMA**2)
    both = sparse.diags_array(np.concatenate([precision, np.full(extra, _VIGNETTING_SIGMA**-2)]))
    expected = np.concatenate([precision * mean, np.zeros(extra)])[:, None].repeat(values.shape[1], axis=1)
    return fit_robustly(cells, sparse.csr_array(design), weight, values, Prior(sparse.csr_array(both), expected, 1))
