"""Priors of the world: what lenses, cameras and views there are, before any image has been measured.

Each is a mixture of normal distributions, of a narrow core where most of the world lies, and of a wide tail, so that
measurements overrule it. They enter every adjustment and the comparison of hypotheses; what the user gives replaces
them.

======================= ============================ ==========================================================
parameter               core; tail (weight)          source
======================= ============================ ==========================================================
λ                       0 ± 0.04; -0.35 ± 0.12 (0.1) phones, compact and system cameras stay within 0.06, action
                                                     cameras and fisheyes reach -0.6; the pincushion of long
                                                     lenses stays below 0.05
μ, ν, distortion centre 0 ± 0.1, 0.03, 0.03          fisheye projections as series; tolerances of assembly
log f, guessed          1.2 ± 30 %; 1.5 ± 70 % (0.1) half diagonals: phones, drones and compact cameras; from
                                                     fisheyes to long lenses
log f, from EXIF        ± 5 %; as guessed (0.1)      rounded to a millimetre, mostly right; wrong by any factor
                                                     where a program has resized the image
log f, given            ± 1 %                        the user, or a camera file
tilt of a plane         0 ± 20°; 0 ± 45° (0.2)       what is laid flat is looked at from above; robots look ahead
======================= ============================ ==========================================================
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Self

import numpy as np

from rdstitch.alignment.motion_models import PSI, THETA, MotionModel, X, Y
from rdstitch.alignment.plane_marks import ControlPoints, PlaneMarks
from rdstitch.arrays import FloatArray, IntArray
from rdstitch.geometry.camera import LENS_PARAMETERS, LENS_STD, Camera

_EXACT_STD = 1e-6


@dataclass(frozen=True)
class Prior:
    """A mixture of normal distributions of one parameter; of none, it says nothing."""

    parts: tuple[tuple[float, float, float], ...] = ()  # weight, mean and standard deviation of each, the core first

    def cost(self, value: float) -> float:
        """Return -2 log of the density, relative to that of the core alone at its middle."""
        if not self.parts:
            return 0.0
        logs = self._logs(value)
        highest = max(logs)
        return -2.0 * (highest + math.log(sum(math.exp(log - highest) for log in logs)))

    def slope(self, value: float) -> float:
        """Return half the derivative of the cost."""
        return sum(share * (value - mean) / std**2 for share, (_, mean, std) in self._shares(value))

    def curvature(self, value: float) -> float:
        """Return half the second derivative of the cost where the shares of the parts stay as they are: positive."""
        return sum(share / std**2 for share, (_, _, std) in self._shares(value))

    @cached_property
    def _heights(self) -> list[float]:
        """Logarithm of each part's density at its middle, relative to that of the core."""
        weight, _, core = self.parts[0]
        return [math.log(w / weight * core / std) for w, _, std in self.parts]

    def _logs(self, value: float) -> list[float]:
        return [
            height - ((value - mean) / std) ** 2 / 2.0
            for height, (_, mean, std) in zip(self._heights, self.parts, strict=True)
        ]

    def _shares(self, value: float) -> list[tuple[float, tuple[float, float, float]]]:
        """How likely the value comes from each part, with the part."""
        if not self.parts:
            return []
        logs = self._logs(value)
        highest = max(logs)
        densities = [math.exp(log - highest) for log in logs]
        total = sum(densities)
        return [(density / total, part) for density, part in zip(densities, self.parts, strict=True)]


def costs(priors: Sequence[Prior], values: FloatArray) -> float:
    """Return the cost of some parameters (K,)."""
    return sum(prior.cost(value) for prior, value in zip(priors, values.tolist(), strict=True))


def slopes(priors: Sequence[Prior], values: FloatArray) -> FloatArray:
    """Return the slopes (K,) at some parameters (K,)."""
    return np.array([prior.slope(value) for prior, value in zip(priors, values.tolist(), strict=True)])


def curvatures(priors: Sequence[Prior], values: FloatArray) -> FloatArray:
    """Return the curvatures (K,) at some parameters (K,)."""
    return np.array([prior.curvature(value) for prior, value in zip(priors, values.tolist(), strict=True)])


def exact(value: float) -> Prior:
    """Return the prior of what is known exactly."""
    return Prior(((1.0, value, _EXACT_STD),))


def focal_prior(log_focal: float, std: float, source: str) -> Prior:
    """Return the prior on log f, f in half diagonals, by where a focal length comes from."""
    if source not in ("exif", "guess"):
        return Prior(((1.0, log_focal, std),))
    return Prior(((0.9, log_focal, std), (0.1, math.log(1.5), 0.7)))


LENS = (
    Prior(((0.9, 0.0, 0.04), (0.1, -0.35, 0.12))),
    *(Prior(((1.0, 0.0, std),)) for std in LENS_STD[1:].tolist()),
)
"""Priors on :data:`rdstitch.geometry.camera.LENS_PARAMETERS`."""

TILT = Prior(((0.8, 0.0, math.radians(20.0)), (0.2, 0.0, math.radians(45.0))))


@dataclass(frozen=True)
class Priors:
    """Priors on all that is adjusted."""

    shared: tuple[Prior, ...]  # of the model's named parameters, see physical_parameters
    lens: tuple[Prior, ...]  # of LENS_PARAMETERS
    poses: FloatArray  # poses, poses_precision: (N, D): means and inverse variances; 0 where there is no prior
    poses_precision: FloatArray
    marks: PlaneMarks | None = None

    @classmethod
    def none(cls, model: MotionModel, count: int) -> Self:
        """None, for ``count`` images."""
        poses = np.zeros((count, model.pose_size))
        return cls((Prior(),) * len(model.shared_names), (Prior(),) * len(LENS_PARAMETERS), poses, poses)


@dataclass(frozen=True)
class CameraPriors:
    """Priors of the camera."""

    log_focal: float  # log_focal, log_focal_std: of the logarithm of the focal length in half diagonals
    log_focal_std: float
    focal_source: str  # where it comes from, a key of FOCAL_LOG_STD
    tilt: tuple[float, float]  # (ψ, θ), radians
    tilt_known: bool
    # (N, 2): how the tilt of each image differs from the shared one, radians; zeros where that is not known
    attitudes: FloatArray
    attitudes_std: float | None  # standard deviation of these, 0 for exact ones; None where they are not known
    positions: FloatArray  # (N, 2): metres east and north where each image was taken; NaN where that is not known
    positions_std: FloatArray  # (N,): of one coordinate of these, m; NaN where that is not known
    control: ControlPoints
    # places, places_precision, marks: (N, 2) and (N,): what positions say of the poses, and its inverse variance, and
    # what control points say; see map_priors
    places: FloatArray | None = None
    places_precision: FloatArray | None = None
    marks: PlaneMarks | None = None
    fix_frame: bool = True  # the frame is the reference image's, not that of places and marks

    def priors(self, model: MotionModel, count: int, tilt_spread: float, log_focal: float | None = None) -> Priors:
        """For ``count`` images whose tilts scatter by ``tilt_spread`` where nothing else is known of them.

        Tilts are turned into what they do in the images with ``log_focal``, the prior one if not given.
        """
        none = Priors.none(model, count)
        tilts = map(exact, self.tilt) if self.tilt_known else (TILT, TILT)
        focal_length = focal_prior(self.log_focal, self.log_focal_std, self.focal_source)
        of_name = dict(zip(("psi", "theta", "log_focal"), (*tilts, focal_length), strict=True))
        shared = tuple(of_name[name] for name in model.shared_names)
        known = replace(none, shared=shared, lens=LENS)
        if "psi" not in model.shared_names:
            return known
        poses, precision = np.zeros_like(none.poses), np.zeros_like(none.poses)
        free = list(getattr(model, "free", ()))
        focal = math.exp(self.log_focal if log_focal is None else log_focal)
        for axis, column in enumerate((PSI, THETA)):
            if column in free:
                poses[:, free.index(column)] = self.attitudes[:, axis] / focal
                precision[:, free.index(column)] = (focal / max(tilt_spread, 1e-6)) ** 2.0
        if self.places is not None and self.places_precision is not None:
            columns = [free.index(column) for column in (X, Y)]
            poses[:, columns], precision[:, columns] = self.places, self.places_precision[:, None]
        return replace(known, poses=poses, poses_precision=precision, marks=self.marks)

    def of(self, images: IntArray) -> "CameraPriors":
        """Of some of the images only."""
        return replace(
            self,
            attitudes=self.attitudes[images],
            positions=self.positions[images],
            positions_std=self.positions_std[images],
            control=self.control.within(images),
        )


def known_focal(cameras: Sequence[Camera]) -> tuple[float, float, str]:
    """Mean and standard deviation of the logarithm of the focal length in half diagonals, and where it comes from."""
    known = [camera for camera in cameras if camera.focal is not None] or [cameras[0].with_focal()]
    ratios = [camera.focal / camera.scale for camera in known if camera.focal is not None]
    vaguest = max(known, key=lambda camera: camera.focal_log_std)
    return float(np.log(np.median(ratios))), vaguest.focal_log_std, vaguest.focal_source or "guess"
