"""Ground control points, by OpenDroneMap's list or a table."""

import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from rdstitch.errors import InputError
from rdstitch.geometry.crs import WGS84, Crs
from rdstitch.geometry.places import GpsPosition, GroundControl
from rdstitch.inputs.named_system import NamedSystem
from rdstitch.inputs.positions import COLUMNS, UNITS, accuracy_of, geographic_places
from rdstitch.inputs.source import Source
from rdstitch.inputs.tables import Row, csv_rows
from rdstitch.system.file_access import canonical_text, read_text

_ACCURACIES = {name: aliases for name, aliases in COLUMNS.items() if name.endswith("std")}
_CONTROL = {
    "name": "image imagename filename file photo",
    "point": "name gcpname gcp point label marker",
    "latitude": COLUMNS["latitude"],
    "longitude": COLUMNS["longitude"],
    "x": "x easting east geox xeasting",
    "y": "y northing north geoy ynorthing",
    "px": "px imx pixelx column u",
    "py": "py imy pixely row v",
    **_ACCURACIES,
}
_CONTROL_WANTED = ("x,y,px,py,name", "longitude,latitude,px,py,name")
_CONTROL_LISTED = ("x", "y", "z", "px", "py", "name")


def with_ground_control(
    sources: Sequence[Source], file: str | Path | None, epsg: int | None = None, *, check: bool = False
) -> list[Source]:
    """The sources with the ground control points that they show by a list, if there is one.

    Its first line names the coordinate system, else it is ``epsg``; then lines as OpenDroneMap's, ``X Y Z PX PY IMAGE
    [NAME]``, or CSV with a header: pixels of the upright image, the centre of the top-left one at (0, 0). Points to
    ``check`` come besides those that the sources have.
    """
    if file is None:
        return list(sources)
    text = read_text(file)
    first, _, rest = text.partition("\n")
    system = NamedSystem.named_by(first)
    body = f"\n{rest}" if system else text  # lines keep their numbers
    rows: Iterable[Row]
    header = next((line for line in body.splitlines() if line.strip()), "")
    if re.match(r"\W*[A-Za-z_ ./()]+[,;\t]", header):
        listed = csv_rows(body, str(file), _CONTROL, _CONTROL_WANTED, UNITS)
        rows = [replace(row, values={**row.values, "name": row.image}) for row in listed]
        epsg = WGS84 if any("latitude" in row.values for row in listed) else epsg
    else:
        rows = _opendronemap(body, str(file))
    system = system or (None if epsg is None else NamedSystem(f"EPSG:{epsg}", epsg))
    if system is None:
        raise InputError(
            f"{file}: line 1: expected a coordinate system like EPSG:32632 or WGS84 UTM 32N; or give --crs"
        )
    marks = _marks(rows, {source.name: source.metadata.size for source in sources})
    if not marks:
        raise InputError(f"{file}: has no ground control point in any of the images")
    places = geographic_places(system, np.array([mark.place for mark in marks]), str(file))
    on_map = system.epsg is not None and system.epsg != WGS84 and Crs.in_metres(system.epsg) is not None
    code = system.epsg if on_map and system.epsg is not None else WGS84
    control: dict[str, list[GroundControl]] = {}
    for mark, degrees in zip(marks, places, strict=True):
        one = GroundControl(mark.point, GpsPosition(*degrees), code, mark.pixel, mark.std, check=check)
        control.setdefault(mark.image, []).append(one)
    return [replace(source, control=(*source.control, *control.get(source.name, ()))) for source in sources]


class _Mark(NamedTuple):
    """A point in an image."""

    image: str
    point: str
    place: tuple[float, float]  # x, y in the system of the list
    pixel: tuple[float, float]
    std: float | None  # of a coordinate of the place, m


def _marks(rows: Iterable[Row], sizes: Mapping[str, tuple[int, int]]) -> list[_Mark]:
    """The points in images of these names and sizes."""
    marks = []
    for row in rows:
        image, point = _image_and_point(" ".join(filter(None, map(row.values.get, ("name", "point")))), sizes)
        if image is None:
            continue
        x, y = (row.needed(names[names[0] not in row.values]) for names in (("longitude", "x"), ("latitude", "y")))
        pixel = row.needed("px"), row.needed("py")
        if not all(-0.5 <= at < side - 0.5 for at, side in zip(pixel, sizes[image], strict=True)):
            raise InputError(f"{row.where}: is not within the {'{} x {}'.format(*sizes[image])} pixels of {image}")
        accuracy = accuracy_of(row)
        marks.append(_Mark(image, point or f"{x:.12g} {y:.12g}", (x, y), pixel, accuracy and accuracy[0]))
    return marks


def _opendronemap(text: str, file: str) -> Iterator[Row]:
    """The lines of a ``gcp_list.txt`` below its coordinate system; what follows the numbers is an image and a point."""
    for number, line in enumerate(text.splitlines(), start=1):
        fields = line.split(maxsplit=5)
        if not fields or fields[0].startswith("#"):
            continue
        row = Row(f"{file}: line {number}", dict(zip(_CONTROL_LISTED, fields, strict=False)), ".")
        if len(fields) < 6:
            raise InputError(f"{row.where}: expected X Y Z PX PY IMAGE [NAME]")
        yield replace(row, values={**row.values, "name": canonical_text(fields[5].strip())})


def _image_and_point(text: str, names: Iterable[str]) -> tuple[str | None, str]:
    """The image that the rest of a line begins with, which may have spaces and other case, and the point's name."""
    for same in (str, str.casefold):
        begun = [name for name in names if f"{same(text)} ".startswith(f"{same(name)} ")]
        if begun:
            image = max(begun, key=len)
            return image, text[len(image) :].strip()
    return None, ""
