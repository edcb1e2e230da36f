"""Where images were taken, by a table, exiftool or a track, instead of by EXIF; and ground control points.

================================= ====================================================================
CSV with a header                 a name, and latitude and longitude, or x and y; as ``exiftool -csv`` too
JSON                              what ``exiftool -json`` writes
GPX                               a track, in which images have their places by their times
a coordinate system, then lines   OpenDroneMap's ``geo.txt``: NAME X Y [Z …]
================================= ====================================================================
"""

import math
import re
from collections.abc import Iterable, Sequence
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from rdstitch.arrays import FloatArray
from rdstitch.errors import InputError
from rdstitch.geometry.crs import WGS84, Crs, epsg_of
from rdstitch.inputs.measurements import timestamps_of
from rdstitch.inputs.source import Source
from rdstitch.inputs.tables import Row, by_image, csv_rows, json_rows, listed_rows
from rdstitch.io.metadata import GpsPosition, GroundControl
from rdstitch.system.file_access import canonical_text, read_text
from rdstitch.system.records import parse_xml

_COLUMNS = {
    "name": "name filename sourcefile image imagename file label",
    "latitude": "latitude lat gpslatitude",
    "longitude": "longitude lon lng long gpslongitude",
    "altitude": "altitude alt elevation ele height z gpsaltitude",
    "x": "x easting east",
    "y": "y northing north",
    "south": "gpslatituderef",
    "west": "gpslongituderef",
}
_GEOGRAPHIC = (("longitude", "west"), ("latitude", "south"))
_WANTED = ("name,latitude,longitude", "name,x,y")
_UNITS = ("deg", "degrees", "m", "metres", "meters")
_RECORDS = "a list of objects with SourceFile, GPSLatitude and GPSLongitude"


def with_positions(
    sources: Sequence[Source], file: str | Path | None, epsg: int | None = None, offset: float = 0.0
) -> list[Source]:
    """The sources with the positions of a file, if there is one, instead of those of EXIF."""
    if file is None:
        return list(sources)
    text, name = read_text(file), str(file)
    lines = text.split("\n", 1)
    if text.lstrip().startswith("<"):
        places = _on_track(sources, text, name, offset)
    else:
        if text.lstrip().startswith(("[", "{")):
            rows = json_rows(text, name, _COLUMNS, _RECORDS)
        elif (system := epsg_of(lines[0])) is not None:
            rows, epsg = listed_rows("".join(lines[1:]).splitlines(), name, ("name", "x", "y", "altitude"), 2), system
        else:
            rows = csv_rows(text, name, _COLUMNS, _WANTED, _UNITS)
        table = _table(rows, name, epsg)
        places = [table.get(source.name) for source in sources]
        if not any(places):
            raise InputError(f"{file}: has no position of {sources[0].name}, nor of any other of the images")
    return [
        replace(source, metadata=replace(source.metadata, gps=place))
        for source, place in zip(sources, places, strict=True)
    ]


def _table(rows: Iterable[Row], file: str, epsg: int | None) -> dict[str, GpsPosition]:
    """The positions by the names of the images; what has no position, or no fix, is not in it."""
    table: dict[str, GpsPosition] = {}
    projected: dict[str, tuple[float, float, float | None]] = {}
    placed = []
    for row in rows:
        geographic = not row.values.keys().isdisjoint(("latitude", "longitude"))
        x, y = (_degrees(row, *c) for c in _GEOGRAPHIC) if geographic else (row.number("x"), row.number("y"))
        if x is not None and y is not None and not (geographic and x == y == 0.0):
            placed.append((row, x, y, geographic))
    by_image(row for row, *_ in placed)
    for row, x, y, geographic in placed:
        altitude = next(iter(row.numbers_within("altitude")), None)
        if altitude is not None and "below" in row.values["altitude"].lower():
            altitude = -altitude
        if geographic or epsg == WGS84:
            if not (abs(y) <= 90.0 and abs(x) <= 180.0):
                raise InputError(f"{row.where}: expected latitude and longitude in degrees, not {y:g} and {x:g}")
            table[row.image] = GpsPosition(y, x, altitude)
        elif epsg is None:
            raise InputError(f"{row.where}: in which coordinate system x and y are is not known; give --crs")
        else:
            projected[row.image] = x, y, altitude
    if projected:
        assert epsg is not None
        values = np.array([(x, y) for x, y, _ in projected.values()])
        for (name, (_, _, altitude)), place in zip(projected.items(), _geographic(epsg, values, file), strict=True):
            table[name] = GpsPosition(*place, altitude)
    return table


def _geographic(epsg: int, places: FloatArray, file: str) -> list[tuple[float, float]]:
    """Latitude and longitude of eastings and northings (N, 2)."""
    found = np.asarray(Crs(epsg).geographic(places))
    if not (np.isfinite(found).all() and (np.abs(found) <= (90.0, 180.0)).all()):
        raise InputError(f"{file}: EPSG:{epsg} has no such places; give the coordinate system of x and y")
    return [(latitude, longitude) for latitude, longitude in found.tolist()]


def _degrees(row: Row, column: str, reference: str) -> float | None:
    """Degrees, or degrees, minutes and seconds, of this or the other side (N, S, E, W); None where there are none."""
    if not (parts := row.numbers_within(column)):
        return None
    text = row.values[column]
    value = sum(abs(part) / 60.0**k for k, part in enumerate(parts[:3]))
    side = re.search(r"\b([NSEW])\w*\s*$", f"{text} {row.values.get(reference, '')}", re.IGNORECASE)
    return -value if text.startswith("-") or (side is not None and side[1] in "SsWw") else value


def _on_track(sources: Sequence[Source], text: str, file: str, offset: float) -> list[GpsPosition | None]:
    """Where the images are on a track, straight from point to point."""
    points = []
    for item in parse_xml(text, file).iter():
        time = item.findtext("time")
        if item.tag not in ("trkpt", "rtept", "wpt") or time is None:
            continue
        try:
            moment = datetime.fromisoformat(time.strip())
            values = (float(item.get("lat", "")), float(item.get("lon", "")), float(item.findtext("ele") or "nan"))
        except ValueError as error:
            raise InputError(f"{file}: a point of the track at {time!r} cannot be read: {error}") from error
        points.append(((moment if moment.tzinfo else moment.replace(tzinfo=UTC)).timestamp(), *values))
    if not points:
        raise InputError(f"{file}: has no points with a time; give a GPX track")
    seconds, latitude, longitude, altitude = np.array(sorted(points)).T
    times = timestamps_of(sources) + offset
    if not ((times >= seconds[0]) & (times <= seconds[-1])).any():
        taken = f"from {_moment(np.nanmin(times))} to {_moment(np.nanmax(times))}" if np.isfinite(times).any() else ""
        raise InputError(
            f"{file}: the track goes from {_moment(seconds[0])} to {_moment(seconds[-1])} UTC, the images "
            f"{f'were taken {taken}; give --positions-offset' if taken else 'have no time'}"
        )
    known = (latitude, np.unwrap(longitude, period=360.0), altitude)
    rows = np.stack([np.interp(times, seconds, values, left=np.nan, right=np.nan) for values in known], axis=1)
    return [
        None if math.isnan(y) else GpsPosition(y, (x + 180.0) % 360.0 - 180.0, None if math.isnan(z) else z)
        for y, x, z in rows.tolist()
    ]


def _moment(seconds: float) -> str:
    return str(np.datetime64(int(seconds), "s"))


def with_ground_control(sources: Sequence[Source], file: str | Path | None) -> list[Source]:
    """The sources with the ground control points that they show by OpenDroneMap's ``gcp_list.txt``, if there is one.

    Its first line names the coordinate system, each other one is ``X Y Z PX PY IMAGE [NAME]``: pixels of the upright
    image, the centre of the top-left one at (0, 0).
    """
    if file is None:
        return list(sources)
    system, *lines = read_text(file).splitlines() or [""]
    epsg = epsg_of(system)
    if epsg is None:
        raise InputError(f"{file}: line 1: expected a coordinate system like EPSG:32632 or WGS84 UTM 32N")
    sizes = {source.name: source.metadata.size for source in sources}
    shown: list[tuple[str, str, FloatArray]] = []
    for number, line in enumerate(lines, start=2):
        fields = line.split()
        if not fields or fields[0].startswith("#"):
            continue
        try:
            values, rest = np.array([float(field) for field in fields[:5]]), canonical_text(line.split(maxsplit=5)[5])
        except (ValueError, IndexError):
            raise InputError(f"{file}: line {number}: expected X Y Z PX PY IMAGE [NAME]") from None
        # Names may hold blanks: the longest one that is an image's.
        ends = [blank.start() for blank in re.finditer(r"\s+|$", rest)]
        image = next((rest[:end] for end in reversed(ends) if rest[:end] in sizes), None)
        if image is not None:
            if not ((values[3:] >= -0.5) & (values[3:] < np.array(sizes[image]) - 0.5)).all():
                size = "{} x {}".format(*sizes[image])
                raise InputError(f"{file}: line {number}: is not within the {size} pixels of {image}")
            shown.append((image, rest[len(image) :].strip() or " ".join(fields[:2]), values))
    if not shown:
        raise InputError(f"{file}: has no ground control point in any of the images")
    xy = np.array([values[:2] for _, _, values in shown])
    places = [(y, x) for x, y in xy.tolist()] if epsg == WGS84 else _geographic(epsg, xy, str(file))
    control: dict[str, list[GroundControl]] = {}
    for (image, name, values), place in zip(shown, places, strict=True):
        pixel = (float(values[3]), float(values[4]))
        control.setdefault(image, []).append(GroundControl(name, GpsPosition(*place), epsg, pixel))
    return [replace(source, control=tuple(control.get(source.name, ()))) for source in sources]
