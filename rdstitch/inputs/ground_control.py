"""Ground control points, by OpenDroneMap's list or a table."""

import re
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

from rdstitch.errors import InputError
from rdstitch.geometry.crs import WGS84, Crs
from rdstitch.geometry.places import GpsPosition, GroundControl, contradicting_places
from rdstitch.inputs.named_system import NamedSystem
from rdstitch.inputs.positions import (
    COLUMNS,
    UNITS,
    Coordinates,
    accuracy_of,
    coordinates_of,
    geographic_places,
    metres_around_median,
)
from rdstitch.inputs.rows_of_images import ImagesByName
from rdstitch.inputs.source import Source
from rdstitch.inputs.tables import Row, csv_rows, is_table, numbered_lines, numbers_before, rows_of
from rdstitch.results.messages import Message, ignored, shortened
from rdstitch.system.file_access import read_text

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
_CONTROL_WANTED = ("x,y,px,py,image", "longitude,latitude,px,py,image")
_CONTROL_LISTED = ("x", "y", "z", "px", "py", "name")


def with_ground_control(
    sources: Sequence[Source],
    file: str | Path | None,
    epsg: int | None = None,
    *,
    check: bool = False,
    report: Callable[[Message], None] = ignored,
) -> list[Source]:
    """The sources with the ground control points that they show by a list, if there is one.

    Its first line names the coordinate system, else it is ``epsg``; then lines as OpenDroneMap's, ``X Y Z PX PY IMAGE
    [NAME]``, or CSV with a header: pixels of the upright image, the centre of the top-left one at (0, 0). Points to
    ``check`` come besides those that the sources have. Lines of other images are reported.
    """
    if file is None:
        return list(sources)
    system, body = NamedSystem.above(read_text(file))
    system = system or (None if epsg is None else NamedSystem(f"EPSG:{epsg}", epsg))
    if is_table(body, str(file), _CONTROL, _is_listed, UNITS):
        rows = csv_rows(body, str(file), _CONTROL, _CONTROL_WANTED, UNITS)
    elif system is None:
        raise InputError(
            f"{file}: line 1: expected a coordinate system like EPSG:32632 or WGS84 UTM 32N; or give --crs"
        )
    else:
        rows = _opendronemap(body, str(file))
    marks, of_others = _marks(rows, sources)
    if not marks:
        raise InputError(f"{file}: has no ground control point in any of the images")
    if of_others:
        text = f"{file}: {len(of_others)} of {len(rows)} lines are of none of the images ({shortened(of_others)})"
        report(Message(text, severity="note"))
    places = [GpsPosition(*degrees) for degrees in geographic_places([mark.place for mark in marks], str(file), system)]
    metres = metres_around_median(places).tolist()
    contradiction = contradicting_places([mark.point for mark in marks], metres, [mark.std for mark in marks])
    if contradiction is not None:
        first, second, distance = marks[contradiction[0]], marks[contradiction[1]], contradiction[2]
        raise InputError(
            f"{second.place.where}: {second.point} is {distance:.3g} m from where it is by {first.place.where}; "
            "give it one place, or other points another name"
        )
    epsg = None if system is None else system.epsg
    crs = None if epsg in (None, WGS84) else Crs.in_metres(epsg)
    control = list(sources)
    for mark, place in zip(marks, places, strict=True):
        code = WGS84 if crs is None or mark.place.geographic else crs.epsg
        one = GroundControl(mark.point, place, code, mark.pixel, mark.std, check=check)
        control[mark.image] = replace(control[mark.image], control=(*control[mark.image].control, one))
    return control


class _Mark(NamedTuple):
    image: int  # its index
    point: str
    place: Coordinates
    pixel: tuple[float, float]
    std: float | None  # of a coordinate of the place, m


def _marks(rows: Sequence[Row], sources: Sequence[Source]) -> tuple[list[_Mark], list[str]]:
    """The marks in the images, and the names in rows of other images."""
    marks, of_others, names = list[_Mark](), list[str](), ImagesByName(sources)
    for row in rows:
        images, point = _images_and_point(row, names)
        if not images:
            of_others.append(row.image)
        for image in images:
            pixel, place = (row.needed("px"), row.needed("py")), coordinates_of(row)
            if place is None:
                raise InputError(f"{row.where}: has no coordinates")
            width, height = sources[image].metadata.size
            if not (-0.5 <= pixel[0] < width - 0.5 and -0.5 <= pixel[1] < height - 0.5):
                where = f"the {width} x {height} pixels of {sources[image].name}"
                raise InputError(f"{row.where}: is not within {where}")
            accuracy = accuracy_of(row)
            named = point or f"{place.x:.12g} {place.y:.12g}"
            marks.append(_Mark(image, named, place, pixel, accuracy and accuracy[0]))
    return marks, of_others


def _is_listed(line: str) -> bool:
    return len(numbers_before(line.split(maxsplit=5)[:5])) == 5


def _opendronemap(text: str, file: str) -> list[Row]:
    """The lines of a ``gcp_list.txt`` below its coordinate system; what follows the numbers is an image and a point."""
    rows = []
    for where, line in numbered_lines(text, file):
        fields = line.split(maxsplit=5)
        if len(fields) < 6:
            raise InputError(f"{where}: expected X Y Z PX PY IMAGE [NAME], or a heading like {_CONTROL_WANTED[0]}")
        rows.append((where, zip(_CONTROL_LISTED, fields, strict=True)))
    return rows_of(rows)


def _images_and_point(row: Row, names: ImagesByName) -> tuple[list[int], str]:
    """Indices of the image that a row names, which may have spaces, and the point's name, which may follow it."""
    text = row.values.get("name") or row.image
    for end in sorted((space.start() for space in re.finditer(r"\s+|$", text)), reverse=True):
        if images := names.find(text[:end], row.where)[0]:
            return images, text[end:].strip() or row.values.get("point", "")
    return [], ""
