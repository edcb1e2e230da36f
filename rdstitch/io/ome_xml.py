"""What OME-XML says of a file: channels on pages of their own, the size of a pixel, the place on the stage."""

from dataclasses import dataclass
from xml.etree import ElementTree

MICROMETRES = {"nm": 1e-3, "µm": 1.0, "um": 1.0, "μm": 1.0, "micron": 1.0, "mm": 1e3, "cm": 1e4, "m": 1e6}
"""What units of length count."""


@dataclass(frozen=True)
class OmeImage:
    """What OME-XML says of the only or first image of a file."""

    channels: int  # pages that are channels of one plane; 1 where there are several planes or times
    pixel_size: float | None  # micrometres
    position: tuple[float, float] | None  # of the first plane
    unit: float | None  # micrometres that the position counts; None for pixels ("reference frame")


def read_ome(text: str | None) -> OmeImage | None:
    """What the OME-XML of a file says; None where it is none."""
    try:
        elements = list(ElementTree.fromstring(text or "").iter())
    except ElementTree.ParseError:
        return None
    found = [element for element in elements if element.tag.rpartition("}")[2] == "Pixels"]
    if not found:
        return None
    pixels = found[0]
    planes = [e for e in pixels.iter() if e.tag.rpartition("}")[2] == "Plane"]
    plane = next((e for e in planes if {"PositionX", "PositionY"} <= e.attrib.keys()), None)
    counts = [int(pixels.get(f"Size{axis}", 1)) for axis in "CZT"]
    samples = [int(e.get("SamplesPerPixel", 1)) for e in pixels.iter() if e.tag.rpartition("}")[2] == "Channel"]
    apart = len(found) == 1 and counts[1:] == [1, 1] and all(count == 1 for count in samples)
    size, scale = pixels.get("PhysicalSizeX"), MICROMETRES.get(pixels.get("PhysicalSizeXUnit", "µm"))
    return OmeImage(
        counts[0] if apart else 1,
        float(size) * scale if size and scale else None,
        None if plane is None else (float(plane.attrib["PositionX"]), float(plane.attrib["PositionY"])),
        # What programs write that do not know the unit counts pixels.
        None if plane is None else MICROMETRES.get(plane.get("PositionXUnit", "µm")),
    )
