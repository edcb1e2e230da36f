"""Where images were taken, by a table, exiftool or a track, instead of by EXIF; and ground control points.

================================= ====================================================================
CSV with a header                 a name, and latitude and longitude, or x and y; as ``exiftool -csv`` too
JSON                              what ``exiftool -json`` writes
GPX                               a track, in which images have their places by their times
SRT                               subtitles of a DJI video, a track likewise
MRK                               events of a DJI receiver, by the number that the images' names end with
a coordinate system, then lines   OpenDroneMap's ``geo.txt``: NAME X Y [Z … HORIZONTAL VERTICAL ACCURACY]
================================= ====================================================================
"""

import math
import re
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from rdstitch.arrays import FloatArray
from rdstitch.errors import ArgumentError, InputError
from rdstitch.geometry.crs import WGS84, Crs, NamedSystem
from rdstitch.geometry.places import GpsPosition, GroundControl
from rdstitch.inputs.source import Source
from rdstitch.inputs.tables import Row, by_image, csv_rows, json_rows, listed_rows
from rdstitch.inputs.tracks import by_events, is_list_of_events, on_track, subtitle_points, track_points
from rdstitch.system.file_access import canonical_text, read_text

_COLUMNS = {
    "name": "name filename sourcefile image imagename file label",
    "latitude": "latitude lat gpslatitude",
    "longitude": "longitude lon lng long gpslongitude",
    "altitude": "altitude alt elevation ele height z gpsaltitude",
    "x": "x easting east",
    "y": "y northing north",
    "south": "gpslatituderef",
    "west": "gpslongituderef",
    "north_std": "rtkstdlat northstd horizontalaccuracy haccuracy hacc accuracy",
    "east_std": "rtkstdlon eaststd",
    "up_std": "rtkstdhgt upstd verticalaccuracy vaccuracy vacc",
}
_ACCURACIES = {name: aliases for name, aliases in _COLUMNS.items() if name.endswith("std")}
_CONTROL = {
    "name": "image imagename filename file photo",
    "point": "name gcpname gcp point label marker",
    "latitude": _COLUMNS["latitude"],
    "longitude": _COLUMNS["longitude"],
    "x": "x easting east geox xeasting",
    "y": "y northing north geoy ynorthing",
    "px": "px imx pixelx column u",
    "py": "py imy pixely row v",
    **_ACCURACIES,
}
_CONTROL_WANTED = ("x,y,px,py,name", "longitude,latitude,px,py,name")
_CONTROL_LISTED = ("x", "y", "z", "px", "py", "name")
_SIDES = (("latitude", "south"), ("longitude", "west"))
_LISTED = ("name", "x", "y", "altitude", "yaw", "pitch", "roll", "north_std", "up_std")  # in geo.txt
_WANTED = ("name,latitude,longitude", "name,x,y")
_UNITS = ("deg", "degrees", "m", "metres", "meters")
_RECORDS = "a list of objects with SourceFile, GPSLatitude and GPSLongitude"


def with_positions(
    sources: Sequence[Source],
    file: str | Path | None,
    epsg: int | None = None,
    offset: float = 0.0,
    accuracy: float | None = None,
) -> list[Source]:
    """The sources with the positions of a file, if there is one, instead of those of EXIF.

    ``accuracy`` is the standard deviation of a horizontal coordinate, m, where they have none of their own; heights are
    half as accurate.
    """
    places = [source.metadata.gps for source in sources] if file is None else _places(sources, file, epsg, offset)
    for place in places if file is not None else ():
        if place is not None and not (abs(place.latitude) <= 90.0 and abs(place.longitude) <= 180.0):
            degrees = f"{place.latitude:g} and {place.longitude:g}"
            raise InputError(f"{file}: expected latitude and longitude in degrees, not {degrees}")
    if accuracy is not None:
        std = (accuracy, 2.0 * accuracy)
        places = [place and (replace(place, std=std) if place.std is None else place) for place in places]
    return [
        source if place is source.metadata.gps else replace(source, metadata=replace(source.metadata, gps=place))
        for source, place in zip(sources, places, strict=True)
    ]


def _places(sources: Sequence[Source], file: str | Path, epsg: int | None, offset: float) -> list[GpsPosition | None]:
    text, name = read_text(file), str(file)
    system = None if epsg is None else NamedSystem(f"EPSG:{epsg}", epsg)
    lines = text.split("\n", 1)
    if text.lstrip().startswith("<"):
        places = on_track(sources, track_points(text, name), name, offset)
    elif points := subtitle_points(text):
        places = on_track(sources, points, name, offset)
    elif is_list_of_events(text):
        places = by_events(sources, text, name)
    else:
        if text.lstrip().startswith(("[", "{")):
            rows = json_rows(text, name, _COLUMNS, _RECORDS)
        elif (named := NamedSystem.named_by(lines[0])) is not None:
            rows, system = listed_rows("".join(lines[1:]).splitlines(), name, _LISTED, 2), named
        else:
            rows = csv_rows(text, name, _COLUMNS, _WANTED, _UNITS)
        table = _table(rows, name, system)
        called = _same_names(sources, table)
        places = [table.get(called[source.name]) for source in sources]
        if not any(places):
            raise InputError(f"{file}: has no position of {sources[0].name}, nor of any other of the images")
    return places


def _table(rows: Iterable[Row], file: str, system: NamedSystem | None) -> dict[str, GpsPosition]:
    """The positions by the names of the images; what has no position, or no fix, is not in it."""
    table: dict[str, GpsPosition] = {}
    projected: dict[str, tuple[float, float]] = {}
    placed = []
    for row in rows:
        geographic = not row.values.keys().isdisjoint(("latitude", "longitude"))
        y, x = (_degrees(row, *c) for c in _SIDES) if geographic else (row.number("y"), row.number("x"))
        if x is not None and y is not None and not (geographic and x == y == 0.0):
            placed.append((row, x, y, geographic))
    by_image(row for row, *_ in placed)
    for row, x, y, geographic in placed:
        altitude = next(iter(row.numbers_within("altitude")), None)
        if altitude is not None and "below" in row.values["altitude"].lower():
            altitude = -altitude
        if geographic or (system is not None and system.epsg == WGS84):
            if not (abs(y) <= 90.0 and abs(x) <= 180.0):
                raise InputError(f"{row.where}: expected latitude and longitude in degrees, not {y:g} and {x:g}")
        elif system is None:
            raise InputError(f"{row.where}: in which coordinate system x and y are is not known; give --crs")
        else:
            projected[row.image] = x, y
        table[row.image] = GpsPosition(y, x, altitude, _accuracy(row))
    if projected:
        assert system is not None
        places = _geographic(system, np.array(list(projected.values())), file)
        for name, (latitude, longitude) in zip(projected, places, strict=True):
            table[name] = replace(table[name], latitude=latitude, longitude=longitude)
    return table


def _accuracy(row: Row) -> tuple[float, float] | None:
    """Standard deviations of one horizontal coordinate and of the altitude, m; None where the row has none."""
    along, across, up = (row.number(name) for name in ("north_std", "east_std", "up_std"))
    if not (along and along > 0.0):
        return None
    across = across if across and across > 0.0 else along
    return math.hypot(along, across) / math.sqrt(2.0), up if up and up > 0.0 else 2.0 * max(along, across)


def _geographic(system: NamedSystem, places: FloatArray, file: str) -> list[tuple[float, float]]:
    """Latitude and longitude of eastings and northings (N, 2)."""
    try:
        found = system.geographic(places)
    except ArgumentError as error:
        raise InputError(f"{file}: {error}") from error
    if not (np.isfinite(found).all() and (np.abs(found) <= (90.0, 180.0)).all()):
        raise InputError(f"{file}: {system.text} has no such places; give the coordinate system of x and y")
    return [(latitude, longitude) for latitude, longitude in found.tolist()]


def _degrees(row: Row, column: str, reference: str) -> float | None:
    """Degrees, or degrees, minutes and seconds, of this or the other side (N, S, E, W); None where there are none."""
    if not (parts := row.numbers_within(column)):
        return None
    text = row.values[column]
    value = sum(abs(part) / 60.0**k for k, part in enumerate(parts[:3]))
    side = re.search(r"(?:\b|(?<=[\d.'\"°]))([NSEW])\w*\s*$", f"{text} {row.values.get(reference, '')}", re.IGNORECASE)
    if side is None and "deg" in text:
        raise InputError(f"{row.where}: '{text}' does not say whether north or south, east or west; add N, S, E or W")
    return -value if text.startswith("-") or (side is not None and side[1] in "SsWw") else value


def _same_names(sources: Sequence[Source], listed: Iterable[str]) -> dict[str, str]:
    """What a list calls each image: its name, or that in other case where only one image and one line are called so."""
    names, lines = Counter(s.name.casefold() for s in sources), {name.casefold(): name for name in set(listed)}
    known = set(listed)
    found = {}
    for source in sources:
        alike = lines.get(source.name.casefold(), source.name)
        found[source.name] = alike if source.name not in known and names[alike.casefold()] == 1 else source.name
    return found


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
        listed = csv_rows(body, str(file), _CONTROL, _CONTROL_WANTED, _UNITS)
        rows = [replace(row, values={**row.values, "name": row.image}) for row in listed]
        epsg = WGS84 if any("latitude" in row.values for row in listed) else epsg
    else:
        rows = _opendronemap(body, str(file))
    system = system or (None if epsg is None else NamedSystem(f"EPSG:{epsg}", epsg))
    if system is None:
        raise InputError(
            f"{file}: line 1: expected a coordinate system like EPSG:32632 or WGS84 UTM 32N; or give --crs"
        )
    sizes = {source.name: source.metadata.size for source in sources}
    shown: list[tuple[str, str, tuple[float, float], tuple[float, float], float | None]] = []
    for row in rows:
        image, point = _image_and_point(" ".join(filter(None, map(row.values.get, ("name", "point")))), sizes)
        if image is None:
            continue
        x, y = (row.needed(names[names[0] not in row.values]) for names in (("longitude", "x"), ("latitude", "y")))
        pixel = row.needed("px"), row.needed("py")
        if not all(-0.5 <= at < side - 0.5 for at, side in zip(pixel, sizes[image], strict=True)):
            raise InputError(f"{row.where}: is not within the {'{} x {}'.format(*sizes[image])} pixels of {image}")
        accuracy = _accuracy(row)
        shown.append((image, point or f"{x:.12g} {y:.12g}", (x, y), pixel, accuracy and accuracy[0]))
    if not shown:
        raise InputError(f"{file}: has no ground control point in any of the images")
    places = _geographic(system, np.array([place for _, _, place, _, _ in shown]), str(file))
    on_map = system.epsg is not None and system.epsg != WGS84 and Crs.in_metres(system.epsg) is not None
    code = system.epsg if on_map and system.epsg is not None else WGS84
    control: dict[str, list[GroundControl]] = {}
    for (image, name, _, pixel, std), degrees in zip(shown, places, strict=True):
        one = GroundControl(name, GpsPosition(*degrees), code, pixel, std, check=check)
        control.setdefault(image, []).append(one)
    return [replace(source, control=(*source.control, *control.get(source.name, ()))) for source in sources]


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
