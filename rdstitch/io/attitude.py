"""The camera's attitude as drones write it into XMP, each maker in a convention of its own.

All of them give yaw, pitch and roll of a body, ``Rz(yaw) Ry(pitch) Rx(roll)`` from its axes (ahead, right, below) to
north, east, down. What differs is where the camera looks in it:

============= ===================================== ============================================ =================
convention    properties                            the camera looks                             straight down
============= ===================================== ============================================ =================
dji-gimbal    GimbalYawDegree, GimbalPitchDegree, … ahead                                        pitch -90
parrot-camera CameraYawDegree, CameraPitchDegree, … ahead                                        pitch -90
pix4d-camera  Camera:Yaw, Camera:Pitch, Camera:Roll below, the top of its image points ahead   pitch 0, roll 0
============= ===================================== ============================================ =================

The last, defined by Pix4D, is what senseFly and Parrot's Sequoia write. What tells the attitude of the drone alone, or
of a light sensor on it (``FlightPitchDegree``, ``DLS:Pitch``), is not the camera's and not read.
"""

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

_MAX_LENGTH = 2**20  # characters; drones write 2,000 to 20,000
_MAX_NUMBER_LENGTH = 64  # characters of a number, and of the space around it


class Convention(NamedTuple):
    """What a maker's numbers mean."""

    properties: tuple[str, str, str]  # of XMP: yaw, pitch, roll
    looks: Literal["ahead", "below"]  # the axis of the body along which the camera looks


CONVENTIONS = {
    "dji-gimbal": Convention(("GimbalYawDegree", "GimbalPitchDegree", "GimbalRollDegree"), "ahead"),
    "parrot-camera": Convention(("CameraYawDegree", "CameraPitchDegree", "CameraRollDegree"), "ahead"),
    "pix4d-camera": Convention(("Camera:Yaw", "Camera:Pitch", "Camera:Roll"), "below"),
}


def xmp_text(info: Mapping[Any, Any]) -> str:
    """The XMP block in an image's info, as far as it can be one of a camera; empty where there is none."""
    block = info.get("xmp") or info.get("XML:com.adobe.xmp") or b""
    return (block.decode("utf-8", "replace") if isinstance(block, bytes) else str(block))[:_MAX_LENGTH]


def xmp_number(xmp: str, name: str) -> float | None:
    """Finite number of a property, written as attribute or as element; None where there is none."""
    # A search rather than an XML parser: drones write XMP that no parser accepts.
    # Repetitions are bounded, so that it takes time in proportion to the text, whatever that is.
    gap, value = rf"\s{{0,{_MAX_NUMBER_LENGTH}}}", rf"{{0,{_MAX_NUMBER_LENGTH}}}"
    match = re.search(rf"""[<:\s]{name}{gap}(?:={gap}["']([^"'<]{value})|>([^<]{value})<)""", xmp)
    return None if match is None else finite((match.group(1) or match.group(2) or "").strip())


def finite(value: Any) -> float | None:
    """A positive or negative finite number, else None; EXIF rationals may be 0/0."""
    try:
        number = float(value)
    except (TypeError, ValueError, ZeroDivisionError, OverflowError):
        return None
    return number if math.isfinite(number) else None


@dataclass(frozen=True)
class Attitude:
    """Attitude as the drone wrote it, degrees."""

    yaw: float
    pitch: float
    roll: float
    convention: Convention

    @property
    def nadir(self) -> tuple[float, float, float]:
        """Unit vector straight down, in the camera's axes: right, towards the bottom of its image, ahead."""
        pitch, roll = math.radians(self.pitch), math.radians(self.roll)
        # Down in the body's axes: the last row of Rz(yaw) Ry(pitch) Rx(roll), in which yaw is no matter.
        ahead = -math.sin(pitch)
        right, below = math.cos(pitch) * math.sin(roll), math.cos(pitch) * math.cos(roll)
        return (right, -ahead, below) if self.convention.looks == "below" else (right, below, ahead)


def read_attitude(xmp: str) -> Attitude | None:
    """The camera's attitude in an XMP block, or None where it is absent, incomplete or no number."""
    for convention in CONVENTIONS.values():
        yaw, pitch, roll = (xmp_number(xmp, name) for name in convention.properties)
        if yaw is not None and pitch is not None and roll is not None:
            return Attitude(yaw, pitch, roll, convention)
    return None
