"""How the output is turned between registration and canvas: options, and the rotations that they stand for.

A panorama is turned by a rotation of its directions. A plane is turned by a homography of the plane, which is that of a
camera in the place of the reference image that looks at it from elsewhere.
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from rdstitch.arrays import FloatArray
from rdstitch.errors import ArgumentError
from rdstitch.scipy_parts import linalg


@dataclass(frozen=True)
class UprightOptions:
    """How the output is turned.

    Attributes
    ----------
    yaw, pitch, roll : float
        Degrees by which the view of a panorama is turned to the right, then up, then clockwise, before it is
        projected: what is ``yaw`` degrees to the right and ``pitch`` degrees up comes straight ahead.

    Raises
    ------
    ArgumentError
        When a value is out of range.
    """

    yaw: float = 0.0
    pitch: float = 0.0
    roll: float = 0.0

    def __post_init__(self) -> None:
        for name in ("yaw", "pitch", "roll"):
            if not math.isfinite(getattr(self, name)):
                raise ArgumentError(f"{name} must be an angle in degrees, not {getattr(self, name)}")

    @property
    def view(self) -> FloatArray | None:
        """Rotation (3, 3) by yaw, pitch and roll; None where they are 0."""
        yaw, pitch, roll = np.radians([self.yaw, self.pitch, self.roll])
        if not (yaw or pitch or roll):
            return None
        return (rotation((0.0, yaw, 0.0)) @ rotation((pitch, 0.0, 0.0)) @ rotation((0.0, 0.0, roll))).T


def rotation(vector: ArrayLike) -> FloatArray:
    """Rotation (3, 3) about an axis (3,), by its length in radians."""
    matrix: FloatArray = linalg.expm(np.cross(np.asarray(vector, dtype=np.float64), np.eye(3)).T)
    return matrix
