"""Numbers in a picture's XMP block."""

import math
import re
from typing import Any

from PIL import Image

_MAX_LENGTH = 2**20  # characters; drones write 2,000 to 20,000
_MAX_NUMBER_LENGTH = 64  # characters of a number, and of the space around it


def xmp_text(image: Image.Image) -> str:
    """The XMP block as text, as far as it can be one of a camera; empty where there is none."""
    block = image.info.get("xmp") or image.info.get("XML:com.adobe.xmp") or b""
    return (block.decode("utf-8", "replace") if isinstance(block, bytes) else str(block))[:_MAX_LENGTH]


def xmp_number(xmp: str, name: str) -> float | None:
    """Finite number of a property, written as attribute or as element; None where there is none.

    Parameters
    ----------
    xmp : str
    name : str
        With the customary prefix of its namespace, or without for any.
    """
    # A search rather than an XML parser: drones write XMP that no parser accepts.
    # Repetitions are bounded, so that it takes time in proportion to the text, whatever that is.
    gap, value = rf"\s{{0,{_MAX_NUMBER_LENGTH}}}", rf"{{0,{_MAX_NUMBER_LENGTH}}}"
    found = re.search(rf"""[<:\s]{name}{gap}(?:={gap}["']([^"'<]{value})|>([^<]{value})<)""", xmp)
    return None if found is None else finite((found.group(1) or found.group(2) or "").strip())


def finite(value: Any) -> float | None:
    """A positive or negative finite number, else None; EXIF rationals may be 0/0."""
    try:
        number = float(value)
    except (TypeError, ValueError, ZeroDivisionError, OverflowError):
        return None
    return number if math.isfinite(number) else None
