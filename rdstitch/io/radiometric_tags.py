"""What multispectral cameras write of light: the level of darkness, and the irradiance by their sunshine sensor."""

import base64
import re
import struct
from dataclasses import dataclass
from typing import Any

import numpy as np

from rdstitch.io.attitude import finite

_IRRADIANCE = ("HorizontalIrradiance", "Irradiance", "SpectralIrradiance")  # MicaSense, DJI: the best first
_BAND = re.compile(r"[<:\s](?:BandName|CentralWavelength|IrradianceExposureTime)\b")
# Parrot Sequoia: time stamp, two channels, number of the gain, milliseconds, yaw, pitch, roll.
_RECORD = struct.Struct("<QHHHHfff")
_GAINS = (1.0, 25.0, 428.0, 9876.0)  # of its sensor, ams TSL2591


@dataclass(frozen=True)
class Radiometry:
    """What turns the samples of an image into measurements of light."""

    black: float = 0.0  # the sample of no light, share of the full range
    irradiance: float | None = None  # up to a factor that all images of the camera share
    source: str = ""  # the tag that says it


def read_radiometry(xmp: str, black_level: Any, bit_depth: int) -> Radiometry | None:
    """Darkness and irradiance by XMP and TIFF's BlackLevel; None for what is no band of a multispectral camera."""
    levels = black_level if isinstance(black_level, tuple) else (black_level,)
    known = [level for level in map(finite, levels) if level is not None and level >= 0.0]
    if not known and _BAND.search(xmp) is None:
        return None
    black = float(np.mean(known)) / (2.0**bit_depth - 1.0) if known else 0.0
    for name in _IRRADIANCE:
        match = re.search(rf"""[<:\s]{name}(?:\s*=\s*["']|>\s*(?:<rdf:Seq>\s*<rdf:li>)?)\s*([0-9.eE+-]{{1,40}})""", xmp)
        value = None if match is None else finite(match[1])
        if value is not None and value > 0.0:
            return Radiometry(black, value, name)
    sunshine = re.search(r"""[<:\s]IrradianceList\s*(?:=\s*["']|>)([^"'<]*)""", xmp)
    value = None if sunshine is None else _of_list(re.sub(r"&#x?[0-9A-Fa-f]+;|\s", "", sunshine[1]))
    return Radiometry(black, value, "" if value is None else "IrradianceList")


def _of_list(text: str) -> float | None:
    """Median of a Sequoia's readings since its last image, counts a millisecond at the least gain."""
    try:
        data = base64.b64decode(text, validate=True)
    except ValueError:
        return None
    readings = [
        count / (_GAINS[gain] * milliseconds)
        for _, count, _, gain, milliseconds, *_ in _RECORD.iter_unpack(data[: len(data) // _RECORD.size * _RECORD.size])
        if 0 < count < 2**16 - 1 and gain < len(_GAINS) and milliseconds
    ]
    return float(np.median(readings)) if readings else None
