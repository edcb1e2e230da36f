"""Priors of cameras and scenes: mixtures of normal distributions.

A narrow core is where most of the world lies; a wide tail lets measurements overrule it. What the user gives replaces
both.

======================= ============================ ==========================================================
parameter               core; tail (weight)          source
======================= ============================ ==========================================================
λ                       0 ± 0.04; -0.35 ± 0.12 (0.1) phones, compact and system cameras stay within 0.06, action
                                                     cameras and fisheyes reach -0.6; the pincushion of long
                                                     lenses stays below 0.05
μ, ν, distortion centre 0 ± 0.1, 0.03, 0.03          fisheye projections as series; tolerances of assembly
log f, guessed          1.2 ± 30 %; 1.5 ± 70 % (0.1) half diagonals: phones, drones and compact cameras; from
                                                     fisheyes to long lenses. Of strong barrel distortion what a
                                                     fisheye of such λ has instead of 1.2
log f, from EXIF        ± 5 %; as guessed (0.1)      rounded to a millimetre, mostly right; wrong by any factor
                                                     where a program has resized the image
log f, given            ± 1 %, or as stated; live,   the user, or a camera file; of another lens, another zoom or
                        any ± 20 % (0.02)            another size of image
tilt of a plane         0 ± 20°; 0 ± 45° (0.2)       what is laid flat is looked at from above; robots look ahead
======================= ============================ ==========================================================
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from rdstitch.arrays import FloatArray
from rdstitch.choices import FocalSource
from rdstitch.geometry.camera import Camera
from rdstitch.numerics.robust_loss import normal_std

TWENTY_TO_ONE = 6.0
"""What odds cost that are said beforehand: a richer lens is rarer, ``pano`` is for turns and ``mosaic`` for planes."""

_EXACT_STD = 1e-6

_MODE_STEPS = 50  # from a part of a mixture to the least cost near it


@dataclass(frozen=True)
class Prior:
    """A mixture of normal distributions of one parameter; of none, it says nothing."""

    parts: tuple[tuple[float, float, float], ...] = ()  # weight, mean and standard deviation of each, the core first

    def slope(self, value: float) -> float:
        """Half the derivative of the cost."""
        return float(prior_slopes((self,), np.array([value]))[0][0])

    def curvature(self, value: float) -> float:
        """Half the second derivative of the cost where the weights of the parts stay as they are: positive."""
        return float(prior_slopes((self,), np.array([value]))[1][0])

    def combined(self, value: float, std: float) -> float:
        """Where a measurement and the prior put the parameter: where their cost is least about its likeliest part."""
        if not self.parts or std == 0.0:
            return value
        weight, mean, scatter = np.array(self.parts).T
        spread = np.hypot(scatter, std)
        part = int(np.argmax(np.log(weight / spread) - ((value - mean) / spread) ** 2 / 2.0))
        mode = float(value + (mean[part] - value) * (std / spread[part]) ** 2)
        for _ in range(_MODE_STEPS):
            mode -= (self.slope(mode) + (mode - value) / std**2) / (self.curvature(mode) + std**-2)
        return mode


def prior_costs(priors: tuple[Prior, ...], values: FloatArray) -> FloatArray:
    """The costs of K parameters (..., K): -2 log of the densities, relative to those of the cores at their middles."""
    return np.asarray(-2.0 * np.logaddexp.reduce(_logs(priors, values), axis=-1))


def prior_slopes(priors: tuple[Prior, ...], values: FloatArray) -> tuple[FloatArray, FloatArray]:
    """The slopes and curvatures of the costs of K parameters (..., K)."""
    logs, (_, mean, precision) = _logs(priors, values), _stacked(priors)
    curvatures = precision * np.exp(logs - np.logaddexp.reduce(logs, axis=-1, keepdims=True))
    slopes = curvatures * (values[..., None] - mean)
    return slopes.sum(axis=-1), curvatures.sum(axis=-1)


def _logs(priors: tuple[Prior, ...], values: FloatArray) -> FloatArray:
    """Logarithms of the densities of each part (..., K, J), relative to that of the core at its middle."""
    height, mean, precision = _stacked(priors)
    return height - precision * (values[..., None] - mean) ** 2 / 2.0


@lru_cache(maxsize=64)
def _stacked(priors: tuple[Prior, ...]) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Height, mean and inverse variance of each part, (K, J): where there is none, -inf; of no parts, a level one."""
    stacked = np.zeros((3, len(priors), max([1, *(len(prior.parts) for prior in priors)])))
    for row, prior in enumerate(priors):
        stacked[0, row, max(len(prior.parts), 1) :] = -np.inf
        for column, (weight, mean, std) in enumerate(prior.parts):
            height = math.log(weight / prior.parts[0][0] * prior.parts[0][2] / std)
            stacked[:, row, column] = height, mean, std**-2.0
    return stacked[0], stacked[1], stacked[2]


def exact(value: float) -> Prior:
    """The prior of what is known exactly."""
    return Prior(((1.0, value, _EXACT_STD),))


def focal_prior(log_focal: float, std: float, source: FocalSource) -> Prior:
    """The prior on log f, f in half diagonals, by where a focal length comes from."""
    if source not in ("exif", "guess"):
        return Prior(((1.0, log_focal, std),))
    return Prior(((0.9, log_focal, std), (0.1, math.log(1.5), 0.7)))


def known_focal(cameras: Sequence[Camera]) -> tuple[float, float, FocalSource]:
    """Median and standard deviation of the logarithm of the focal length in half diagonals, and where it comes from.

    The cameras are of one lens: where most differ, as those of a zoom do, it is as uncertain as they scatter.
    """
    known = [camera for camera in cameras if camera.focal is not None] or [cameras[0].with_guessed_focal()]
    ratios = np.log([camera.focal / camera.scale for camera in known if camera.focal is not None])
    middle = float(np.median(ratios))
    scatter = normal_std(ratios - middle)
    vaguest = max(known, key=lambda camera: camera.focal_log_std)
    return middle, max(vaguest.focal_log_std, scatter), vaguest.focal_source or "guess"


LENS_PRIORS = (
    Prior(((0.9, 0.0, 0.04), (0.1, -0.35, 0.12))),
    *(Prior(((1.0, 0.0, std),)) for std in (0.1, 0.03, 0.03, 0.03)),
)
"""Priors on :data:`rdstitch.geometry.camera.LENS_PARAMETERS`. The series falls: an equisolid fisheye of 140° has
λ = -0.50, μ = -0.05 and ν = -0.03, an equidistant one a third of that ν."""

WRONG_GIVEN_FOCAL = 0.02, 0.2
"""How often a given focal length is that of something else, and by how much its logarithm is off then."""

TILT_PRIOR = Prior(((0.8, 0.0, math.radians(20.0)), (0.2, 0.0, math.radians(45.0))))
