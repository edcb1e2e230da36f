"""Positions of images by EXIF, or by what a user has instead: a table, the output of exiftool, or a track.

================================= ====================================================================
CSV with a header                 a name, and latitude and longitude, or x and y; as ``exiftool -csv`` too
JSON                              what ``exiftool -json`` writes
GPX                               a track, in which images have their places by their times
SRT                               subtitles of a DJI video, a track likewise
MRK                               events of a DJI receiver, by the number that the images' names end with
a coordinate system, then lines   OpenDroneMap's ``geo.txt``: NAME X Y [Z … HORIZONTAL VERTICAL ACCURACY]; or CSV
================================= ====================================================================
"""

import math
import re
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from rdstitch.arrays import FloatArray
from rdstitch.errors import ArgumentError, InputError
from rdstitch.geometry.crs import WGS84, Crs
from rdstitch.geometry.places import GpsPosition
from rdstitch.inputs.image_folders import READABLE_SUFFIXES
from rdstitch.inputs.named_system import NamedSystem
from rdstitch.inputs.rows_of_images import RowsByImage
from rdstitch.inputs.source import Source
from rdstitch.inputs.tables import NUMERAL, Row, csv_rows, is_table, json_rows, numbered_lines, numbers_before, rows_of
from rdstitch.inputs.tracks import by_events, is_list_of_events, on_track, subtitle_points, track_points
from rdstitch.results.messages import Message, ignored, shortened
from rdstitch.system.file_access import read_text

COLUMNS = {
    "name": "name filename sourcefile image imagename file label",
    "latitude": "latitude lat gpslatitude",
    "longitude": "longitude lon lng long gpslongitude",
    "altitude": "altitude alt elevation ele height z gpsaltitude",
    "x": "x easting east",
    "y": "y northing north",
    "south": "gpslatituderef",
    "west": "gpslongituderef",
    "below": "gpsaltituderef",
    "north_std": "rtkstdlat northstd horizontalaccuracy haccuracy hacc accuracy",
    "east_std": "rtkstdlon eaststd",
    "up_std": "rtkstdhgt upstd verticalaccuracy vaccuracy vacc",
}
_SIDES = (("latitude", "south"), ("longitude", "west"))
_SIDE_WORDS = {"latitude": ("n", "north", "s", "south"), "longitude": ("e", "east", "w", "west")}
_UNIT_WORDS = ["d", "deg", "degree", "degrees", "º", "m", "min", "minute", "minutes", "sec", "second", "seconds"]
_BELOW_SEA = re.compile(r"below|negative|;[13](\.0*)?$", re.IGNORECASE)  # words of exiftool, or EXIF's 1 and 3
_LISTED = ("name", "x", "y", "altitude", "yaw", "pitch", "roll", "north_std", "up_std")  # in geo.txt
_NUMBER_IN_WORD = re.compile(rf"(?:.*[,;])?{NUMERAL.pattern}")
_WANTED = ("name,latitude,longitude", "name,x,y")
# Words that follow an image's ending, or another one in the last folder.
_BEHIND_A_NAME = re.compile(
    rf"({'|'.join(map(re.escape, READABLE_SUFFIXES))}|\.[A-Za-z]\w+(?!.*[\\/]))\s(?!.*\.[A-Za-z]\w+$)", re.IGNORECASE
)
_METRES, _DEGREES = "m metres meters", "deg degrees"
UNITS = {"latitude": _DEGREES, "longitude": _DEGREES, "x": f"{_METRES} {_DEGREES}", "y": f"{_METRES} {_DEGREES}"}
UNITS |= dict.fromkeys(("altitude", "north_std", "east_std", "up_std"), _METRES)
_RECORDS = "a list of objects with SourceFile, GPSLatitude and GPSLongitude"


def positions_of(sources: Sequence[Source]) -> FloatArray:
    """Metres east and north (N, 2) of the median of the images' GPS positions; NaN where unknown."""
    return metres_around_median([source.metadata.gps for source in sources])


def metres_around_median(known: Sequence[GpsPosition | None]) -> FloatArray:
    """Metres east and north (N, 2) of the median of positions, on a conformal map; NaN where unknown."""
    degrees = [(np.nan, np.nan) if gps is None else (gps.latitude, gps.longitude) for gps in known]
    latitude, longitude = np.array(degrees, dtype=np.float64).reshape(-1, 2).T
    if not (places := np.isfinite(latitude)).any():
        return np.full((len(known), 2), np.nan)
    metres = np.full((len(known), 2), np.nan)
    metres[places] = Crs.nearest(latitude[places], longitude[places]).project(latitude[places], longitude[places])
    metres[~np.isfinite(metres).all(axis=1)] = np.nan
    return np.asarray(metres - np.nanmedian(metres, axis=0))


def with_positions(
    sources: Sequence[Source],
    file: str | Path | None,
    epsg: int | None = None,
    offset: float = 0.0,
    accuracy: float | None = None,
    report: Callable[[Message], None] = ignored,
) -> list[Source]:
    """The sources with the positions of a file, if there is one, instead of those of EXIF.

    ``epsg`` is the coordinate system of x and y where the file names none; ``offset``, s, is added to the times of the
    images to find them on a track. ``accuracy`` is the standard deviation of a horizontal coordinate, m, where they
    have none of their own; heights are half as accurate. That the file lacks images is reported.
    """
    if file is None:
        places = [source.metadata.gps for source in sources]
    else:
        places = _places(sources, file, epsg, offset)
        for place in filter(None, places):
            if not (abs(place.latitude) <= 90.0 and abs(place.longitude) <= 180.0):
                degrees = f"{place.latitude:g} and {place.longitude:g}"
                raise InputError(f"{file}: expected latitude and longitude in degrees, not {degrees}")
        if lacking := [source.name for source, place in zip(sources, places, strict=True) if place is None]:
            text = f"{file}: has no position of {len(lacking)} of {len(sources)} images ({shortened(lacking)})"
            report(Message(text, severity="note"))
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
    if text.lstrip().startswith("<"):
        places = on_track(sources, track_points(text, name), name, offset)
    elif points := subtitle_points(text):
        places = on_track(sources, points, name, offset)
    elif is_list_of_events(text):
        places = by_events(sources, text, name)
    else:
        named, below = NamedSystem.above(text)
        if text.lstrip().startswith(("[", "{")):
            rows = json_rows(text, name, COLUMNS, _RECORDS)
        elif named is None or is_table(below, name, COLUMNS, _listed_fields, UNITS):
            rows, system = csv_rows(below, name, COLUMNS, _WANTED, UNITS), named or system
        else:
            rows, system = _listed(below, name), named
        named_rows = RowsByImage(row for row in rows if coordinates_of(row) is not None)
        places = _by_rows(named_rows.of(sources), name, system)
        if not any(places):
            raise InputError(f"{file}: has no position of {sources[0].name}, nor of any other of the images")
    return places


def _listed(text: str, file: str) -> list[Row]:
    """The lines of a ``geo.txt`` below its coordinate system."""
    rows = []
    for where, line in numbered_lines(text, file):
        if not (fields := _listed_fields(line)):
            raise InputError(f"{where}: expected a name and numbers between blanks, not '{line}'")
        rows.append((where, zip(_LISTED, fields, strict=False)))
    return rows_of(rows)


def _listed_fields(line: str) -> list[str]:
    """A name, which may hold blanks, and two numbers or more, which other words may follow; empty for other lines."""
    fields, most = line.split(), len(_LISTED) - 1
    for end in range(1, len(fields)):
        rest = fields[end : end + most]
        numbers = numbers_before(rest)
        if len(numbers) > 1 and not any(map(_NUMBER_IN_WORD.match, rest[len(numbers) :])):
            name = line.rsplit(maxsplit=len(fields) - end)[0]
            return [] if _BEHIND_A_NAME.search(name) else [name, *numbers]
    return []


def _by_rows(rows: Sequence[Row | None], file: str, system: NamedSystem | None) -> list[GpsPosition | None]:
    places: list[GpsPosition | None] = []
    coordinates = [None if row is None else coordinates_of(row) for row in rows]
    degrees = iter(geographic_places([each for each in coordinates if each is not None], file, system))
    for row, each in zip(rows, coordinates, strict=True):
        if row is None or each is None:
            places.append(None)
            continue
        altitude = next(iter(row.numbers_within("altitude")), None)
        if altitude is not None and _BELOW_SEA.search(f"{row.values['altitude']};{row.values.get('below', '')}"):
            altitude = -abs(altitude)
        places.append(GpsPosition(*next(degrees), altitude, accuracy_of(row)))
    return places


class Coordinates(NamedTuple):
    """Coordinates of a place, as a row has them."""

    where: str  # the file and the line, for messages
    x: float
    y: float
    geographic: bool  # whether they are longitude and latitude, whatever system the file has


def coordinates_of(row: Row) -> Coordinates | None:
    """Coordinates in a row; None where it has no position, or no fix."""
    geographic = not row.values.keys().isdisjoint(("latitude", "longitude"))
    y, x = (_degrees(row, *c) for c in _SIDES) if geographic else (row.number("y"), row.number("x"))
    return (
        None if x is None or y is None or (geographic and x == y == 0.0) else Coordinates(row.where, x, y, geographic)
    )


def accuracy_of(row: Row) -> tuple[float, float] | None:
    """Standard deviations of one horizontal coordinate and of the altitude, m; None where the row has none."""
    along, across, up = (row.number(name) for name in ("north_std", "east_std", "up_std"))
    if not (along and along > 0.0):
        return None
    across = across if across and across > 0.0 else along
    return math.hypot(along, across) / math.sqrt(2.0), up if up and up > 0.0 else 2.0 * max(along, across)


def geographic_places(
    coordinates: Sequence[Coordinates], file: str, system: NamedSystem | None
) -> list[tuple[float, float]]:
    """Latitude and longitude of each: those that it has, else by the system of x and y."""
    degrees = np.array([(one.y, one.x) for one in coordinates]).reshape(-1, 2)
    projected = np.array(
        [not one.geographic and (system is None or system.epsg != WGS84) for one in coordinates], dtype=bool
    )
    for one, on_map in zip(coordinates, projected.tolist(), strict=True):
        if on_map and system is None:
            raise InputError(f"{one.where}: in which coordinate system x and y are is not known; give --crs")
        if not on_map and not (abs(one.y) <= 90.0 and abs(one.x) <= 180.0):
            raise InputError(f"{one.where}: expected latitude and longitude in degrees, not {one.y:g} and {one.x:g}")
    if system is not None and projected.any():
        try:
            degrees[projected] = system.geographic(degrees[projected][:, ::-1])
        except ArgumentError as error:
            raise InputError(f"{file}: {error}") from error
        if not (np.isfinite(degrees).all() and (np.abs(degrees) <= (90.0, 180.0)).all()):
            raise InputError(f"{file}: {system.text} has no such places; give the coordinate system of x and y")
    return [(latitude, longitude) for latitude, longitude in degrees.tolist()]


def _degrees(row: Row, column: str, reference: str) -> float | None:
    """Degrees, or degrees, minutes and seconds, of this or the other side (N, S, E, W); None where there are none."""
    if not (parts := row.numbers_within(column)):
        return row.number(column)
    text = row.values[column]
    value = sum(abs(part) / 60.0**k for k, part in enumerate(parts))
    words = re.findall(r"[^\W\d_]+", NUMERAL.sub(" ", text).lower())
    if "m" in words and "s" in words:
        words.remove("s")  # 33d 51m 20s N: seconds
    given = row.values.get(reference, "").lower()
    sides = {word[0] for word in (*words, given) if word in _SIDE_WORDS[column]}
    whole = all(part.is_integer() for part in parts[:-1]) and all(abs(part) < 60.0 for part in parts[1:])
    if len(parts) > 3 or not whole or len(sides) > 1 or not {*words} <= {*_SIDE_WORDS[column], *_UNIT_WORDS}:
        raise InputError(f"{row.where}: expected a {column} like 33.85, -33.85 or 33 51 S, not '{text}'")
    if not sides and "deg" in text:
        raise InputError(f"{row.where}: '{text}' does not say whether north or south, east or west; add N, S, E or W")
    return -value if math.copysign(1.0, parts[0]) < 0.0 or sides & {"s", "w"} else value
