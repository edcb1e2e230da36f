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

import csv
import math
import re
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path, PureWindowsPath

import numpy as np

from rdstitch.arrays import FloatArray
from rdstitch.errors import ArgumentError, InputError
from rdstitch.geometry.crs import WGS84, Crs, NamedSystem
from rdstitch.inputs.measurements import timestamps_of
from rdstitch.inputs.source import Source
from rdstitch.io.metadata import GpsPosition, GroundControl
from rdstitch.system.file_access import canonical_text, read_text
from rdstitch.system.records import parse_json, parse_xml

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
_SIDES = (("latitude", "south"), ("longitude", "west"))
_LISTED = ("name", "x", "y", "altitude", "yaw", "pitch", "roll", "north_std", "up_std")  # in geo.txt
_MEANING = {alias: column for column, aliases in _COLUMNS.items() for alias in aliases.split()}
_NUMBER = re.compile(r"[-+]?\d+(?:[.,]\d+)?(?:[eE][-+]?\d+)?")
_DELIMITERS = ",;\t"

_Rows = Iterable[tuple[str, Mapping[str, str]]]
"""Of each image: where in the file it is, and its values by the keys of :data:`_COLUMNS`."""


def with_positions(
    sources: Sequence[Source], file: str | Path | None, epsg: int | None = None, offset: float = 0.0
) -> list[Source]:
    """The sources with the positions of a file, if there is one, instead of those of EXIF."""
    if file is None:
        return list(sources)
    text, name = read_text(file), str(file)
    system = None if epsg is None else NamedSystem(f"EPSG:{epsg}", epsg)
    lines = text.split("\n", 1)
    if text.lstrip().startswith("<"):
        places = _on_track(sources, _track_points(text, name), name, offset)
    elif points := _subtitle_points(text):
        places = _on_track(sources, points, name, offset)
    elif _EVENT.match(text):
        places = _by_events(sources, text, name)
    else:
        if text.lstrip().startswith(("[", "{")):
            rows = _json_rows(text, name)
        elif (named := NamedSystem.named_by(lines[0])) is not None:
            rows, system = _listed_rows(lines[1:]), named
        else:
            rows = _csv_rows(text, name)
        table = _table(rows, name, system)
        called = _same_names(sources, table)
        places = [table.get(called[source.name]) for source in sources]
        if not any(places):
            raise InputError(f"{file}: has no position of {sources[0].name}, nor of any other of the images")
    return [
        replace(source, metadata=replace(source.metadata, gps=place))
        for source, place in zip(sources, places, strict=True)
    ]


def _csv_rows(text: str, file: str) -> _Rows:
    lines = text.splitlines()
    header = lines[0].lstrip("# ") if lines else ""
    delimiter = max(_DELIMITERS, key=header.count)
    table = csv.DictReader([header, *lines[1:]], delimiter=delimiter, skipinitialspace=True)
    columns = {_meaning(column) for column in table.fieldnames or ()}
    if "name" not in columns or not ({"latitude", "longitude"} <= columns or {"x", "y"} <= columns):
        raise InputError(f"{file}: its first line names no columns like name,lat,lon or name,x,y")
    try:
        yield from ((f"line {table.line_num}", _known(row)) for row in table)
    except csv.Error as error:
        raise InputError(f"{file}: is not a CSV file: {error}") from error


def _json_rows(text: str, file: str) -> _Rows:
    content = parse_json(text, file)
    if not isinstance(content, list) or not all(isinstance(item, dict) for item in content):
        raise InputError(f"{file}: expected a list of objects with SourceFile, GPSLatitude and GPSLongitude")
    return ((f"[{number}]", _known(item)) for number, item in enumerate(content))


def _listed_rows(lines: Iterable[str]) -> _Rows:
    for number, line in enumerate("\n".join(lines).splitlines(), start=2):
        if fields := line.split():
            yield f"line {number}", dict(zip(_LISTED, fields, strict=False))


def _meaning(column: object) -> str | None:
    """Which of :data:`_COLUMNS` a column is, without its group (``EXIF:``) and unit."""
    plain = re.sub(r"[\[(].*", "", str(column).rpartition(":")[2])
    return _MEANING.get(re.sub(r"[^a-z]", "", plain.lower()))


def _known(row: Mapping[str, object]) -> dict[str, str]:
    """The values that mean something; of several the last, which in exiftool's output is the one with a sign."""
    named = ((_meaning(key), str(value or "").strip()) for key, value in row.items())
    return {key: value for key, value in named if key and value}


def _table(rows: _Rows, file: str, system: NamedSystem | None) -> dict[str, GpsPosition]:
    """The positions by the names of the images; what has no position, or no fix, is not in it."""
    table: dict[str, GpsPosition] = {}
    projected: dict[str, tuple[float, float]] = {}
    for where, row in rows:
        name = canonical_text(PureWindowsPath(row.get("name", "")).name)
        geographic = row.keys() & {"latitude", "longitude"}
        first, second = ("latitude", "longitude") if geographic else ("y", "x")
        y, x = (_number(row, *part) for part in ((first, "south"), (second, "west")))
        if x is None or y is None or (geographic and x == y == 0.0):
            continue
        if not name or name in table:
            raise InputError(f"{file}: {where}: {f'{name} is here twice; remove one' if name else 'has no name'}")
        altitude = _number(row, "altitude")
        if altitude is not None and "below" in row["altitude"].lower():
            altitude = -altitude
        if geographic or (system is not None and system.epsg == WGS84):
            if not (abs(y) <= 90.0 and abs(x) <= 180.0):
                raise InputError(f"{file}: {where}: expected latitude and longitude in degrees, not {y:g} and {x:g}")
            if geographic and any("deg" in row[key] and _side(row, key, ref) is None for key, ref in _SIDES):
                raise InputError(
                    f"{file}: {where}: does not say whether north or south, east or west; add N, S, E or W"
                )
        elif system is None:
            raise InputError(f"{file}: {where}: in which coordinate system x and y are is not known; give --crs")
        else:
            projected[name] = x, y
        table[name] = GpsPosition(y, x, altitude, _accuracy(row))
    if projected:
        assert system is not None
        places = _geographic(system, np.array(list(projected.values())), file)
        for name, (latitude, longitude) in zip(projected, places, strict=True):
            table[name] = replace(table[name], latitude=latitude, longitude=longitude)
    return table


def _accuracy(row: Mapping[str, str]) -> tuple[float, float] | None:
    """Standard deviations of one horizontal coordinate and of the altitude, m; None where the row has none."""
    along, across, up = (_number(row, name) for name in ("north_std", "east_std", "up_std"))
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


def _number(row: Mapping[str, str], key: str, reference: str = "") -> float | None:
    """A number, or degrees, minutes and seconds, of this or the other side (N, S, E, W); None where there is none."""
    text = row.get(key, "")
    parts = [float(part.replace(",", ".")) for part in _NUMBER.findall(text)]
    if not parts or not all(map(math.isfinite, parts)):
        return None
    if not reference or key in "xy":
        return parts[0]
    value = sum(abs(part) / 60.0**k for k, part in enumerate(parts[:3]))
    return -value if text.startswith("-") or _side(row, key, reference) in ("S", "W") else value


def _side(row: Mapping[str, str], key: str, reference: str) -> str | None:
    """N, S, E or W of a coordinate; None where it is not said."""
    side = re.search(r"\b([NSEW])\w*\s*$", f"{row.get(key, '')} {row.get(reference, '')}", re.IGNORECASE)
    return None if side is None else side[1].upper()


def _same_names(sources: Sequence[Source], listed: Iterable[str]) -> dict[str, str]:
    """What a list calls each image: its name, or that in other case where only one image and one line are called so."""
    names, lines = Counter(s.name.casefold() for s in sources), {name.casefold(): name for name in set(listed)}
    known = set(listed)
    found = {}
    for source in sources:
        alike = lines.get(source.name.casefold(), source.name)
        found[source.name] = alike if source.name not in known and names[alike.casefold()] == 1 else source.name
    return found


def _by_events(sources: Sequence[Source], text: str, file: str) -> list[GpsPosition | None]:
    """Positions of DJI's ``.MRK``: events by their number, which the names of images end with.

    They are those of the middle of the sensor; the offsets of the antenna are in them.
    """
    events: dict[int, GpsPosition] = {}
    for line in text.splitlines():
        if match := _EVENT.match(line):
            number, latitude, longitude, height, *std = (float(value) for value in match.groups())
            accuracy = (math.hypot(std[0], std[1]) / math.sqrt(2.0), std[2])
            events[int(number)] = GpsPosition(latitude, longitude, height, accuracy if min(std) > 0.0 else None)
    if not events:
        raise InputError(f"{file}: has no events of a DJI .MRK file")
    numbers = [_SEQUENCE.search(Path(source.name).stem) for source in sources]
    places = [None if number is None else events.get(int(number[1])) for number in numbers]
    if sum(place is not None for place in places) * 2 < len(places):
        raise InputError(
            f"{file}: has events {min(events)} to {max(events)}, which the numbers at the end of the names, as of "
            f"{sources[0].name}, are not; give a CSV file with name,lat,lon"
        )
    return places


_EVENT = re.compile(
    r"\s*(\d+)\s+[\d.]+\s+\[\d+\].*?(-?[\d.]+),\s*Lat\s+(-?[\d.]+),\s*Lon\s+(-?[\d.]+),\s*Ellh\s+([\d.]+),\s*([\d.]+),"
    r"\s*([\d.]+)"
)
_SEQUENCE = re.compile(r"_(\d{4})(?:_[A-Z]+)?$", re.IGNORECASE)
_SUBTITLE = re.compile(r"(\d+):(\d\d):(\d\d)[,.](\d{1,3})\s*-->")
_IN_SUBTITLE = re.compile(
    r"lat\w*\s*:\s*(?P<lat>-?[\d.]+).*?lon\w*\s*:\s*(?P<lon>-?[\d.]+)(?:.*?abs_alt\s*:\s*(?P<alt>-?[\d.]+))?"
    r"|GPS\s*\((?P<lon2>-?[\d.]+),\s*(?P<lat2>-?[\d.]+)",
    re.IGNORECASE | re.DOTALL,
)


def _subtitle_points(text: str) -> list[tuple[float, float, float, float]]:
    """Seconds since the video began, latitude, longitude and altitude in the subtitles of a DJI video."""
    starts = list(_SUBTITLE.finditer(text))
    points = []
    for start, end in zip(starts, [*(s.start() for s in starts[1:]), len(text)], strict=False):
        if place := _IN_SUBTITLE.search(text, start.end(), end):
            hours, minutes, seconds, milliseconds = (float(part) for part in start.groups())
            latitude, longitude = (float(place[k] or place[f"{k}2"]) for k in ("lat", "lon"))
            if latitude or longitude:  # 0, 0 is what is written without a fix
                time = 3600.0 * hours + 60.0 * minutes + seconds + milliseconds / 1000.0
                points.append((time, latitude, longitude, float(place["alt"] or "nan")))
    return points


def _track_points(text: str, file: str) -> list[tuple[float, float, float, float]]:
    """Seconds since 1970, latitude, longitude and altitude of the points of a GPX track."""
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
    return points


def _on_track(
    sources: Sequence[Source], points: Sequence[tuple[float, float, float, float]], file: str, offset: float
) -> list[GpsPosition | None]:
    """Where the images are on a track, straight from point to point."""
    if not points:
        raise InputError(f"{file}: has no points with a time; give a GPX track or the subtitles (.SRT) of the video")
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


def with_ground_control(sources: Sequence[Source], file: str | Path | None, *, check: bool = False) -> list[Source]:
    """The sources with the ground control points that they show by OpenDroneMap's ``gcp_list.txt``, if there is one.

    Its first line names the coordinate system, each other one is ``X Y Z PX PY IMAGE [NAME]``: pixels of the upright
    image, the centre of the top-left one at (0, 0). Points to ``check`` come besides those that the sources have.
    """
    if file is None:
        return list(sources)
    first, *lines = read_text(file).splitlines() or [""]
    system = NamedSystem.named_by(first)
    if system is None:
        raise InputError(f"{file}: line 1: expected a coordinate system like EPSG:32632 or WGS84 UTM 32N")
    sizes = {source.name: source.metadata.size for source in sources}
    shown: list[tuple[str, str, FloatArray]] = []
    for number, line in enumerate(lines, start=2):
        fields = line.split(maxsplit=5)
        if not fields or fields[0].startswith("#"):
            continue
        try:
            values, rest = np.array([float(field) for field in fields[:5]]), canonical_text(fields[5].strip())
        except (ValueError, IndexError):
            raise InputError(f"{file}: line {number}: expected X Y Z PX PY IMAGE [NAME]") from None
        image, point = _image_and_point(rest, sizes)
        if image is None:
            continue
        if not ((values[3:] >= -0.5) & (values[3:] < np.array(sizes[image]) - 0.5)).all():
            size = "{} x {}".format(*sizes[image])
            raise InputError(f"{file}: line {number}: is not within the {size} pixels of {image}")
        shown.append((image, point or " ".join(fields[:2]), values))
    if not shown:
        raise InputError(f"{file}: has no ground control point in any of the images")
    places = _geographic(system, np.array([values[:2] for _, _, values in shown]), str(file))
    on_map = system.epsg is not None and system.epsg != WGS84 and Crs.in_metres(system.epsg) is not None
    epsg = system.epsg if on_map and system.epsg is not None else WGS84
    control: dict[str, list[GroundControl]] = {}
    for (image, name, values), place in zip(shown, places, strict=True):
        pixel = (float(values[3]), float(values[4]))
        control.setdefault(image, []).append(GroundControl(name, GpsPosition(*place), epsg, pixel, check=check))
    return [replace(source, control=(*source.control, *control.get(source.name, ()))) for source in sources]


def _image_and_point(text: str, names: Iterable[str]) -> tuple[str | None, str]:
    """The image that the rest of a line begins with, which may have spaces and other case, and the point's name."""
    for same in (str, str.casefold):
        begun = [name for name in names if f"{same(text)} ".startswith(f"{same(name)} ")]
        if begun:
            image = max(begun, key=len)
            return image, text[len(image) :].strip()
    return None, ""
