"""OME-XML: what microscopes' files say of their planes and pixels."""

import math
from dataclasses import dataclass
from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from rdstitch.errors import InputError
from rdstitch.system.records import parse_xml

MICROMETRES = {"nm": 1e-3, "µm": 1.0, "um": 1.0, "μm": 1.0, "micron": 1.0, "mm": 1e3, "cm": 1e4, "m": 1e6}
"""What units of length count."""

_MAX_PLANES = 2**16  # of another file of a set, which is not opened
_COUNTED = "CZT"  # axes beside those of a plane


@dataclass(frozen=True)
class Page:
    """A plane of a file."""

    file: Path
    number: int


@dataclass(frozen=True)
class OmeImage:
    """What OME-XML says of the only or first image of a file."""

    channels: int  # pages that are channels of one plane; 1 where there are several planes or times
    pixel_size: float | None  # micrometres


def read_ome(text: str | None) -> OmeImage | None:
    """What the OME-XML of a file says; None where it is none."""
    root = ome_tree(text)
    images = [] if root is None else list(root.iter("Pixels"))
    if not images:
        return None
    counts = [int(images[0].get(f"Size{axis}", 1)) for axis in _COUNTED]
    samples = [int(channel.get("SamplesPerPixel", 1)) for channel in images[0].iter("Channel")]
    separate = len(images) == 1 and counts[1:] == [1, 1] and all(count == 1 for count in samples)
    return OmeImage(counts[0] if separate else 1, ome_pixel_size(images[0]))


def ome_tree(text: str | None) -> ElementTree.Element | None:
    """The tree of OME-XML without name spaces; None where it is none."""
    try:
        return parse_xml(text or "", "OME-XML")
    except InputError:
        return None


def ome_pixel_size(pixels: ElementTree.Element) -> float | None:
    """Micrometres; None where it is not said, or in no unit of length."""
    size, scale = pixels.get("PhysicalSizeX"), MICROMETRES.get(pixels.get("PhysicalSizeXUnit", "µm"))
    return float(size) * scale if size and scale else None


def ome_planes(
    file: Path, pages: int, pixels: ElementTree.Element, uuid: str | None
) -> dict[tuple[int, int, int], Page]:
    """Where the planes of an image are, of ``file`` no more than it has pages.

    The file is known by its name, or by its UUID where that is not there.
    """
    samples = [int(channel.get("SamplesPerPixel", 1)) for channel in pixels.iter("Channel")]
    counts = {axis: int(pixels.get(f"Size{axis}", 1)) for axis in _COUNTED}
    counts["C"] = len(samples) or counts["C"]
    order = [axis for axis in pixels.get("DimensionOrder", "XYCZT")[2:] if axis in _COUNTED]
    total = math.prod(counts.values())
    planes = {}
    for data in list(pixels.iter("TiffData")) or [ElementTree.Element("TiffData")]:
        identity = data.find("UUID")
        holder = file
        if identity is not None:
            name = identity.get("FileName")
            mine = (identity.text or "").strip() == uuid if uuid is not None else name == file.name
            holder = file if mine or name is None else file.parent / name
        first = np.ravel_multi_index(
            [int(data.get(f"First{axis}", 0)) for axis in reversed(order)], [counts[axis] for axis in reversed(order)]
        )
        page = int(data.get("IFD", 0))
        count = int(data.get("PlaneCount", total if data.get("IFD") is None else 1))
        for k in range(min(count, total - int(first), pages - page if holder == file else _MAX_PLANES)):
            index = np.unravel_index(int(first) + k, [counts[axis] for axis in reversed(order)])
            at = dict(zip(reversed(order), (int(i) for i in index), strict=True))
            planes[at["C"], at["Z"], at["T"]] = Page(holder, page + k)
    return planes
