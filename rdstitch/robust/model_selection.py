"""Which model of the family describes a pair: the least free one that explains the data."""

from dataclasses import dataclass

import numpy as np

from rdstitch.arrays import FloatArray
from rdstitch.division_model import OBSERVABLE_STD
from rdstitch.robust.local_optimization import Linearized, Refined, refine
from rdstitch.robust.measurements import Measurements
from rdstitch.robust.pair_models import HomographyModel, PairModel
from rdstitch.robust.verification import numbered_cells

_LEAST_NOISE = 0.02  # px; below, noise-free data would reject every model over rounding
_RAYLEIGH_MEDIAN = 1.1774  # median length of a two-dimensional normal vector of standard deviation 1
_LOSS_WIDTH = 4.0  # scale of the loss in standard deviations of the noise

_SINGULAR = 1e-13  # eigenvalue of the correlation matrix of the parameters
_CELLS_PER_HALF_DIAGONAL = 5.0
_NEAR = 3.0  # errors, in thresholds, beyond which a correspondence has no say in the choice


@dataclass(frozen=True)
class Selection:
    """The chosen model, fitted.

    Attributes
    ----------
    fit : Refined
    noise : float
        Standard deviation of the transfer errors, per axis, px.
    covariance : ndarray of shape (P, P)
        Of λ (first, where it was estimated) and the model's parameters.
    distortion_std : float
        Standard deviation of λ; 0 where it was given, inf where it is not observable (λ is then 0 in ``fit``).
    reason : str
    """

    fit: Refined
    noise: float
    covariance: FloatArray
    distortion_std: float
    reason: str


def select_model(
    models: list[PairModel],
    homography: FloatArray,
    distortion: float,
    data: Measurements,
    threshold: float,
    *,
    fixed_distortion: bool,
) -> Selection:
    """Fit every model and choose by the Bayesian information criterion.

    The noise is that of the freest model, so that a lesser model is held against what the pictures allow and not
    against its own misfit.

    Parameters
    ----------
    models : list of PairModel
        From least to most free; the last one is a :class:`HomographyModel`.
    homography, distortion
        Where to start.
    data : Measurements
    threshold : float
        Largest transfer error of an inlier, px.
    fixed_distortion : bool
        Whether λ is known.
    """
    free = refine(
        HomographyModel(),
        homography,
        distortion,
        data,
        threshold,
        fixed_distortion=fixed_distortion,
        iterations=8,
    )
    noise = noise_of(free.errors, threshold)
    inliers = max(1, int(np.sum(free.errors < threshold)))
    near = data.subset(free.errors < _NEAR * threshold)

    def fit(model: PairModel, start: Refined, distortion: float, fixed: bool, iterations: int = 15) -> Refined:
        points = near if iterations else data
        return refine(
            model,
            start.homography,
            distortion,
            points,
            loss_width(noise, threshold),
            fixed_distortion=fixed,
            noise=noise,
            iterations=iterations,
        )

    fits = [fit(model, free, free.distortion, fixed_distortion) for model in models]
    criteria = [f.cost / noise**2 + len(f.information) * np.log(2 * inliers) for f in fits]
    chosen = fits[int(np.argmin(criteria))]
    reason = _explain(fits, chosen, threshold)
    noise = noise_of(chosen.errors, threshold)
    chosen = fit(chosen.model, chosen, chosen.distortion, fixed_distortion, iterations=0)
    covariance = covariance_of(chosen, noise, data)
    std = 0.0 if fixed_distortion else float(np.sqrt(covariance[0, 0]))
    if std < OBSERVABLE_STD:
        return Selection(chosen, noise, covariance, std, reason)
    straight = fit(chosen.model, chosen, 0.0, True)
    straight = fit(chosen.model, straight, 0.0, True, iterations=0)
    reason += f"; λ is not observable (standard deviation {std:.2g}) and was set to 0"
    return Selection(straight, noise, covariance_of(straight, noise, data), np.inf, reason)


def noise_of(errors: FloatArray, threshold: float) -> float:
    """Standard deviation per axis, px, from the median error of those below the threshold."""
    inside = errors[errors < threshold]
    return _LEAST_NOISE if not len(inside) else max(float(np.median(inside)) / _RAYLEIGH_MEDIAN, _LEAST_NOISE)


def loss_width(noise: float, threshold: float) -> float:
    """Scale of the loss, px, for errors of this standard deviation per axis."""
    return min(threshold, _LOSS_WIDTH * noise)


def covariance_of(fit: Refined | Linearized, noise: float, data: Measurements) -> FloatArray:
    """Covariance that holds also where neighbouring errors are alike, as parallax and lens misfit make them.

    ``A⁻¹ (Σ_c g_c g_c') A⁻¹`` over the cells c of a grid, ``A`` the normal matrix and ``g_c`` the gradient of the
    correspondences in a cell (White's estimator with clusters), but in no direction less than ``noise² A⁻¹``, what
    independent errors give. Infinite where a parameter is not determined.
    """
    scale = np.sqrt(np.diag(fit.information))
    size = len(scale)
    if not (scale > 0.0).all():
        return np.full((size, size), np.inf)
    values, vectors = np.linalg.eigh(fit.information / np.outer(scale, scale))
    if values[0] < _SINGULAR:
        return np.full((size, size), np.inf)
    # In the basis where noise² A⁻¹ is the identity, the larger of the two is a matter of eigenvalues.
    root = (vectors / np.sqrt(values)) / scale[:, None]
    cells = np.unique(numbered_cells(data.x1 * _CELLS_PER_HALF_DIAGONAL), return_inverse=True)[1]
    influence = np.zeros((int(cells.max()) + 1, size))
    np.add.at(influence, cells, fit.influence @ root)
    spread, directions = np.linalg.eigh(influence.T @ influence / noise**2)
    root = root @ directions * np.sqrt(np.maximum(spread, 1.0))
    return np.asarray(noise**2 * root @ root.T)


def _explain(fits: list[Refined], chosen: Refined, threshold: float) -> str:
    """One clause on why this model and not another."""
    listed = ", ".join(f"{f.model.name} {rms_of(f.errors, threshold):.2f} px" for f in fits)
    why = "no model with less freedom" if chosen is fits[-1] else "the least free model that"
    return f"{chosen.model.name}: {why} explains the data (rms {listed})"


def rms_of(errors: FloatArray, threshold: float) -> float:
    """Root mean square of the errors below the threshold, px; NaN where there are none."""
    inside = errors[errors < threshold]
    return float(np.sqrt(np.mean(inside**2))) if len(inside) else np.nan
