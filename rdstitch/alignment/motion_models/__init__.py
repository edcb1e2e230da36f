"""How an image's pose and the camera's shared parameters make a homography: the family of motion models.

Every model gives, for each image i, the homography ``P_i`` from the plane to the image's undistorted coordinates
(half diagonals from the distortion centre), and its derivatives; the adjustment uses nothing else of a model. Two
images are related by ``H_ij = P_j P_i⁻¹``.

Those over a plane from the least to the most free, and the turn on the spot:

========== =============================================== ===================================================
model      per image                                     typical motion
========== =============================================== ===================================================
rigid      φ, tx, ty                                       robot: tilt and height stay (Valtonen Örnhag et al.)
similarity φ, tx, ty, log h                                drone that climbs and sinks
tilting    φ, tx, ty, log h, δψ, δθ                        drone in wind: small tilts of its own
pose       φ, tx, ty, log h, δψ, δθ                        kite, hand: any pose of one camera, six degrees of freedom
homography 8                                               any motion, any camera
rotation   R                                               a turn about the centre: directions instead of a plane
========== =============================================== ===================================================

A model is one class, with what it is capable of (:class:`MotionModel`): others ask whether it has metric poses, or
leads to directions, never which one it is. A new one is one more of :data:`PLANAR_MODELS`, or a class in a file of its
own with its entry in :data:`MODELS`; its name is a word of :mod:`rdstitch.choices`.
"""

from rdstitch.alignment.motion_models.base import ModelMatrices, MotionModel
from rdstitch.alignment.motion_models.homography import HOMOGRAPHY
from rdstitch.alignment.motion_models.planar import (
    LOG_HEIGHT,
    PLANAR_MODELS,
    POSE,
    PSI,
    RIGID,
    SIMILARITY,
    THETA,
    TILTING,
    YAW,
    PlanarModel,
    X,
    Y,
)
from rdstitch.alignment.motion_models.rotation import ROTATION
from rdstitch.choices import ModelName

MODELS: dict[ModelName, MotionModel] = {model.name: model for model in (*PLANAR_MODELS, HOMOGRAPHY, ROTATION)}
"""All by name, in the order in which they are tried."""

__all__ = [
    "HOMOGRAPHY",
    "LOG_HEIGHT",
    "MODELS",
    "POSE",
    "PSI",
    "RIGID",
    "ROTATION",
    "SIMILARITY",
    "THETA",
    "TILTING",
    "YAW",
    "ModelMatrices",
    "MotionModel",
    "PlanarModel",
    "X",
    "Y",
]
