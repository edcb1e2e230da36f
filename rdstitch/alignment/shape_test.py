"""Is the shape of the whole known? Overlaps that agree to a fifth of a pixel do not say so.

Each image hangs on its neighbours only, so what bends all overlaps alike, a lens whose axis is off the middle or a
wall that is slightly curved, adds up along a row of images: homographies, tilts and heights take it up, and the far
end is off by pixels where every seam is good. So the fit is tried against what it leaves out
(:mod:`rdstitch.alignment.unmodelled`): how much smaller would the errors be, how well do the images exclude it, and
how far would the images move, up to one homography of the whole?

What is tried is a sample of what may be missing. So the fit is probed besides for what differs from image to image:
where that would make the errors smaller by more than noise does, the model is wrong even with the effects, and standard
deviations that suppose it right are too small by as much: they are multiplied by the Birge ratio (R. T. Birge, The
calculation of errors by the method of least squares, 1932).

Effects are tried as large as they usually are. Of a much larger one, such as a wall whose radius is a few times the
camera's distance, that prior would allow little: so extreme cases are tried, too. And a row of few images fits a
curved wall by a strong tilt and a focal length that next to no lens has: then the usual focal length is tried.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from rdstitch.alignment.adjustment_problem import Fit, Problem
from rdstitch.alignment.motion_models import PlanarModel
from rdstitch.alignment.result import ShapeTest
from rdstitch.alignment.shape_directions import Directions, places
from rdstitch.alignment.unmodelled import CROPPED, USUAL_FOCAL, Effect, cropping_effects, unmodelled_effects
from rdstitch.arrays import FloatArray, IntArray
from rdstitch.camera import Camera

_LARGE = 0.004
"""Of an image's diagonal: an image may be off by less; sets wrong by three pixels of 500 have 0.005 and more."""

_SHOWN_PER_EFFECT = 4.0
"""Gain of each effect, in squared standard deviations, from which on the images show that something is left out."""

UNLIKELY_FOCAL = 4.0
"""Standard deviations of what is known of a focal length beyond which it may stand for something else."""


def judge_shape(problem: Problem, fit: Fit, cameras: Sequence[Camera]) -> ShapeTest:
    """Try a fit against what it leaves out.

    Parameters
    ----------
    problem : Problem
    fit : Fit
        Of a model over a plane.
    cameras : sequence of Camera
        Of the problem's images.
    """
    effects, probes = unmodelled_effects(fit), cropping_effects(problem.count)
    found = Directions.of(problem, fit, [*effects, *probes])
    information, gradient = found.information()
    tried = len(gradient) - len(probes)
    probed = (_gain(information, gradient) - _gain(information[:tried, :tried], gradient[:tried])) / len(probes)
    information, gradient = information[:tried, :tried], gradient[:tried]
    at = *places(found, cameras, tried), problem.count
    usual = _Prediction.of(effects, information, gradient, *at, max(1.0, probed))
    extreme = _Prediction.of(effects, _with_extremes(information, effects), gradient, *at, max(1.0, probed))
    diagonals = np.array([2.0 * camera.scale for camera in cameras])
    judged, off = usual, np.hypot(usual.shifts, usual.stds)
    # Extreme cases count where the errors show them. Where the images only fail to exclude them, as along any row, no
    # image would be good enough.
    doubtful = bool(off.max() > _LARGE * diagonals[off.argmax()])
    if not doubtful and extreme.shown and (extreme.shifts > _LARGE * diagonals).any():
        doubtful, judged, off = True, extreme, extreme.shifts
    beside = beside_usual_focal(problem, fit)
    if not doubtful and abs(beside) > UNLIKELY_FOCAL * problem.camera_priors.log_focal_std:
        elsewhere = usual.moved_along(len(fit.adjusted.parameters.shared) - 1, -beside, information, *at)
        if (elsewhere.shifts > _LARGE * diagonals).any():
            doubtful, judged, off = True, elsewhere, elsewhere.shifts
    image = int(off.argmax())
    return ShapeTest(
        doubtful=doubtful,
        gain=judged.gain,
        shown=judged.shown or probed > _SHOWN_PER_EFFECT,
        image=image,
        shift=float(judged.shifts[image]),
        shift_std=float(judged.stds[image]),
        cause=CROPPED if probed > max(judged.by_effect, _SHOWN_PER_EFFECT) else judged.cause,
    )


@dataclass(frozen=True)
class _Prediction:
    """What the effects would change.

    Attributes
    ----------
    gain, by_effect : float
        By how much they lessen the cost, in squared standard deviations; the same for each of them.
    shifts, stds : ndarray of shape (N,)
        How far each image moves, and the standard deviation of that, pixels.
    cause : str
        The kind of effects that is farthest from nothing.
    """

    gain: float
    by_effect: float
    shifts: FloatArray
    stds: FloatArray
    cause: str

    @property
    def shown(self) -> bool:
        """Whether they explain more than noise does."""
        return self.by_effect > _SHOWN_PER_EFFECT

    @classmethod
    def of(
        cls,
        effects: Sequence[Effect],
        information: FloatArray,
        gradient: FloatArray,
        moved: FloatArray,
        images: IntArray,
        count: int,
        inflation: float,
    ) -> Self:
        """From the information (S, S) and gradient (S,) on the shared parameters and the effects.

        ``moved`` and ``images`` are what :func:`places` gives; variances are multiplied by ``inflation``.
        """
        kept = len(gradient) - len(effects)
        alone = information[:kept, :kept]
        covariance = np.linalg.inv(information)
        step = -covariance @ gradient
        step[:kept] += np.linalg.solve(alone, gradient[:kept])  # what the fit lacks without any effect
        covariance *= inflation
        squared = ((moved @ step) ** 2).sum(axis=1), np.einsum("pas,st,pat->p", moved, covariance, moved)
        shifts, stds = (_per_image(own, images, count) for own in squared)
        gain = _gain(information, gradient) - _gain(alone, gradient[:kept])
        cause = _cause(effects, step[kept:], np.asarray(covariance[kept:, kept:], dtype=np.float64))
        return cls(gain, gain / len(effects), shifts, stds, cause)

    def moved_along(
        self, index: int, size: float, information: FloatArray, moved: FloatArray, images: IntArray, count: int
    ) -> Self:
        """What a step of one shared parameter, the logarithm of the focal length, changes when all others follow it."""
        response = np.linalg.inv(information)[:, index]
        shifts = _per_image(((moved @ response * (size / response[index])) ** 2).sum(axis=1), images, count)
        return replace(self, by_effect=0.0, shifts=shifts, stds=np.zeros(count), cause=USUAL_FOCAL)


def _per_image(squared: FloatArray, images: IntArray, count: int) -> FloatArray:
    """Root mean square (N,) of the points (P,) of each image."""
    points = np.maximum(np.bincount(images, minlength=count), 1)
    result: FloatArray = np.sqrt(np.maximum(np.bincount(images, squared, count), 0.0) / points)
    return result


def beside_usual_focal(problem: Problem, fit: Fit) -> float:
    """By how much the logarithm of a fit's focal length exceeds what was known of it; 0 where no tilt shows one."""
    if not isinstance(fit.model, PlanarModel):
        return 0.0
    log_focal = float(fit.model.physical_parameters(fit.adjusted.parameters.shared)[0][-1])
    return log_focal - problem.camera_priors.log_focal


def _with_extremes(information: FloatArray, effects: Sequence[Effect]) -> FloatArray:
    """The information (S, S) if the effects, which come last, may be as large as in extreme cases."""
    result = information.copy()
    last = np.arange(len(information) - len(effects), len(information))
    result[last, last] += [(effect.largest or effect.std) ** -2.0 - effect.std**-2.0 for effect in effects]
    return result


def _gain(information: FloatArray, gradient: FloatArray) -> float:
    """By how much a step lessens the cost, in squared standard deviations."""
    return float(gradient @ np.linalg.solve(information, gradient))


def _cause(effects: Sequence[Effect], sizes: FloatArray, covariance: FloatArray) -> str:
    """The kind of effects that is farthest from nothing."""
    causes = [effect.cause for effect in effects]

    def significance(cause: str) -> float:
        own = [k for k, each in enumerate(causes) if each == cause]
        return float(sizes[own] @ np.linalg.solve(covariance[np.ix_(own, own)], sizes[own])) / len(own)

    return max(dict.fromkeys(causes), key=significance)
