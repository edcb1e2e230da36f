"""Priors on all that an alignment adjusts, by what is given of the camera; those of the world are of
:mod:`rdstitch.robust.priors`.
"""

import math
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Self

import numpy as np

from rdstitch.alignment.least_squares.plane_marks import ControlPoints, PlaneMarks
from rdstitch.alignment.motion_models import PSI, THETA, MotionModel, X, Y
from rdstitch.arrays import FloatArray, IntArray
from rdstitch.choices import FocalSource
from rdstitch.geometry.camera import LENS_PARAMETERS
from rdstitch.robust.priors import LENS_PRIORS, TILT_PRIOR, Prior, exact, focal_prior

_MOST_BARREL = 0.375
"""-λ of an equisolid fisheye with the focal length as the unit; that of a stereographic one is 1/4."""


@dataclass(frozen=True, eq=False)
class Priors:
    """Priors on all that is adjusted."""

    shared: tuple[Prior, ...]  # of the model's named parameters, see physical_parameters
    lens: tuple[Prior, ...]  # of LENS_PARAMETERS
    poses: FloatArray  # poses, poses_precision: (N, D): means and inverse variances; 0 where there is no prior
    poses_precision: FloatArray
    marks: PlaneMarks | None = None

    @cached_property
    def camera(self) -> tuple[Prior, ...]:
        """Priors of the named parameters and the lens."""
        return self.shared + self.lens

    @classmethod
    def none(cls, model: MotionModel, count: int) -> Self:
        """None, for ``count`` images."""
        poses = np.zeros((count, model.pose_size))
        return cls((Prior(),) * len(model.shared_names), (Prior(),) * len(LENS_PARAMETERS), poses, poses)


@dataclass(frozen=True, eq=False)
class CameraPriors:
    """Priors of the camera."""

    log_focal: float  # log_focal, log_focal_std: of the logarithm of the focal length in half diagonals
    log_focal_std: float
    focal_source: FocalSource
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
    delayed_attitudes: FloatArray | None = None  # (N, S, 2): the attitudes, if their times are late by DELAYS

    def priors(self, model: MotionModel, count: int, tilt_spread: float, log_focal: float | None = None) -> Priors:
        """Priors for ``count`` images whose tilts scatter by ``tilt_spread`` where nothing else is known of them.

        Tilts are turned into what they do in the images with ``log_focal``, the prior one if not given.
        """
        known = self.of_camera(model, count)
        if not model.has_metric_poses:
            return known
        poses, precision = np.zeros_like(known.poses), np.zeros_like(known.poses)
        free = model.free
        focal = math.exp(self.log_focal if log_focal is None else log_focal)
        for axis, column in enumerate((PSI, THETA)):
            if column in free:
                poses[:, free.index(column)] = self.attitudes[:, axis] / focal
                precision[:, free.index(column)] = (focal / max(tilt_spread, 1e-6)) ** 2.0
        if self.places is not None and self.places_precision is not None:
            columns = [free.index(column) for column in (X, Y)]
            poses[:, columns], precision[:, columns] = self.places, self.places_precision[:, None]
        return replace(known, poses=poses, poses_precision=precision, marks=self.marks)

    def with_lens(self, distortion: float) -> Self:
        """Shorten a guessed focal length to that of a fisheye with this λ, in half diagonals."""
        if self.focal_source != "guess" or distortion >= 0.0:
            return self
        return replace(self, log_focal=min(self.log_focal, math.log(_MOST_BARREL / -distortion) / 2.0))

    def of_camera(self, model: MotionModel, count: int) -> Priors:
        """Priors for ``count`` images, with none on their poses."""
        tilts = map(exact, self.tilt) if self.tilt_known else (TILT_PRIOR, TILT_PRIOR)
        focal_length = focal_prior(self.log_focal, self.log_focal_std, self.focal_source)
        of_name = dict(zip(("psi", "theta", "log_focal"), (*tilts, focal_length), strict=True))
        poses = np.zeros((count, model.pose_size))
        return Priors(tuple(of_name[name] for name in model.shared_names), LENS_PRIORS, poses, poses)

    def of(self, images: IntArray) -> "CameraPriors":
        """The priors of some of the images only."""
        return replace(
            self,
            attitudes=self.attitudes[images],
            positions=self.positions[images],
            positions_std=self.positions_std[images],
            control=self.control.within(images),
            delayed_attitudes=None if self.delayed_attitudes is None else self.delayed_attitudes[images],
        )
