"""What is known of the camera and of where the pictures were taken before they are aligned."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from rdstitch.alignment.bundle_adjustment import Priors
from rdstitch.alignment.motion_models import PSI, THETA, MotionModel, X, Y
from rdstitch.alignment.rotation_model import ROTATION
from rdstitch.arrays import FloatArray, IntArray
from rdstitch.camera import Camera

_EXACT_PRECISION = 1e12  # precision of what is known: a standard deviation of 1e-6 radians


@dataclass(frozen=True)
class CameraPriors:
    """Priors of the camera.

    Attributes
    ----------
    log_focal, log_focal_std : float
        Of the logarithm of the focal length in half diagonals.
    tilt : (float, float)
        (ψ, θ), radians.
    tilt_known : bool
    attitudes : ndarray of shape (N, 2)
        How the tilt of each picture differs from the shared one, radians; zeros where that is not known.
    attitudes_std : float or None
        Standard deviation of these, 0 for exact ones; None where they are not known.
    lens, lens_std : ndarray of shape (5,)
        λ, μ, ν and the shift of the distortion centre.
    positions : ndarray of shape (N, 2)
        Metres east and north where each picture was taken; NaN where that is not known.
    places, places_precision : ndarray of shape (N, 2) and (N,)
        What those say of the poses, and its inverse variance; see :mod:`rdstitch.alignment.position_priors`.
    """

    log_focal: float
    log_focal_std: float
    tilt: tuple[float, float]
    tilt_known: bool
    attitudes: FloatArray
    attitudes_std: float | None
    lens: FloatArray
    lens_std: FloatArray
    positions: FloatArray
    places: FloatArray | None = None
    places_precision: FloatArray | None = None

    def priors(self, model: MotionModel, count: int, tilt_spread: float, log_focal: float | None = None) -> Priors:
        """For ``count`` pictures whose tilts scatter by ``tilt_spread`` where nothing else is known of them.

        Tilts are turned into what they do in the pictures with ``log_focal``, the prior one if not given.
        """
        none = Priors.none(model, count)
        known = replace(none, lens=self.lens, lens_precision=self.lens_std**-2.0)
        if not model.shared_names:
            return known
        if model is ROTATION:
            return replace(
                known, shared=np.array([self.log_focal]), shared_precision=np.array([self.log_focal_std**-2.0])
            )
        tilt_precision = _EXACT_PRECISION if self.tilt_known else 0.0
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
        return replace(
            known,
            shared=np.array([*self.tilt, self.log_focal]),
            shared_precision=np.array([tilt_precision, tilt_precision, self.log_focal_std**-2.0]),
            poses=poses,
            poses_precision=precision,
        )

    def of(self, pictures: IntArray) -> "CameraPriors":
        """Of some of the pictures only."""
        return replace(self, attitudes=self.attitudes[pictures], positions=self.positions[pictures])


def focal_prior(cameras: Sequence[Camera]) -> tuple[float, float]:
    """Mean and standard deviation of the logarithm of the focal length in half diagonals."""
    known = [camera for camera in cameras if camera.focal is not None] or [cameras[0].with_focal()]
    ratios = [camera.focal / camera.half_diagonal for camera in known if camera.focal is not None]
    return float(np.log(np.median(ratios))), max(camera.focal_log_std for camera in known)
