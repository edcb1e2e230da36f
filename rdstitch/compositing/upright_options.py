"""How the output is turned between registration and canvas."""

import math
from dataclasses import dataclass, fields
from typing import Literal

import cv2
import numpy as np
from numpy.typing import ArrayLike

from rdstitch.arrays import FloatArray
from rdstitch.errors import ArgumentError

Segment = tuple[float, float, float, float]
Corners = tuple[float, float, float, float, float, float, float, float]


@dataclass(frozen=True)
class UprightOptions:
    """How the output is turned."""

    # yaw, pitch, roll: degrees by which the view of a panorama is turned to the right, then up, then clockwise, before
    # it is projected: what is ``yaw`` degrees to the right and ``pitch`` degrees up comes straight ahead
    yaw: float = 0.0
    pitch: float = 0.0
    roll: float = 0.0
    # x and y of four corners, pixels of the reference image as it is read, clockwise, that become an upright rectangle
    # with its aspect ratio; the first becomes the top left
    rectangle: Corners | None = None
    # make edges horizontal and vertical that are so in the scene: those found in the images, or lines by x and y of
    # both ends, pixels of the reference image as it is read
    straighten: Literal["off", "auto"] | tuple[Segment, ...] = "off"
    level: bool = False  # make vertical what gravity says, if the images have it, else what is so in most images

    def __post_init__(self) -> None:
        for name in ("yaw", "pitch", "roll"):
            if not math.isfinite(getattr(self, name)):
                raise ArgumentError(f"{name} must be an angle in degrees, not {getattr(self, name)}")
        if (self.rectangle is not None) + (self.straighten != "off") + self.level > 1:
            raise ArgumentError("rectangle, straighten and level each turn the output; give one of them")
        if isinstance(self.straighten, str):
            if self.straighten not in ("off", "auto"):
                raise ArgumentError(f"straighten is off, auto, or lines, not '{self.straighten}'")
        elif any(line[:2] == line[2:] for line in self.straighten):
            raise ArgumentError("straighten: a line needs two different ends")

    @property
    def view(self) -> FloatArray | None:
        """Rotation (3, 3) by yaw, pitch and roll; None where they are 0."""
        yaw, pitch, roll = np.radians([self.yaw, self.pitch, self.roll])
        if not (yaw or pitch or roll):
            return None
        return (rotation((0.0, yaw, 0.0)) @ rotation((pitch, 0.0, 0.0)) @ rotation((0.0, 0.0, roll))).T

    @property
    def measured(self) -> bool:
        """Whether places in the reference image are given."""
        return self.rectangle is not None or not isinstance(self.straighten, str)

    @property
    def upright(self) -> bool:
        """Whether something in the scene shall be upright, whatever else the frame of the output would be."""
        return self.measured or self.straighten == "auto" or self.level

    def same_turn(self, other: "UprightOptions") -> bool:
        """Whether other options turn the output alike."""
        return all(getattr(self, f.name) == getattr(other, f.name) for f in fields(UprightOptions))


def rotation(vector: ArrayLike) -> FloatArray:
    """Rotation (3, 3) about an axis (3,), by its length in radians."""
    return np.asarray(cv2.Rodrigues(np.asarray(vector, dtype=np.float64))[0], dtype=np.float64)
