"""Positions of images by what moved the camera: a GPX track, a video's subtitles, a receiver's list of events."""

import math
import re
from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import NamedTuple

import numpy as np

from rdstitch.errors import InputError
from rdstitch.geometry.places import GpsPosition
from rdstitch.inputs.source import Source
from rdstitch.inputs.time_gaps import in_gap
from rdstitch.inputs.times import timestamps_of
from rdstitch.system.records import parse_xml

_NUMBER = r"(?<![\d.])-?\d+(?:\.\d+)?(?![\d.])"
_EVENT = re.compile(
    rf"\s*(\d+)\s+[\d.]+\s+\[\d+\].*?({_NUMBER}),\s*Lat\s+({_NUMBER}),\s*Lon\s+({_NUMBER}),\s*Ellh\s+({_NUMBER}),"
    rf"\s*({_NUMBER}),\s*({_NUMBER})"
)
_SEQUENCE = re.compile(r"_(\d{4})(?:_[A-Z]+)?$", re.IGNORECASE)
_SUBTITLE = re.compile(r"(\d+):(\d\d):(\d\d)[,.](\d{1,3})\s*-->")
_IN_SUBTITLE = re.compile(
    rf"lat\w*\s*:\s*(?P<lat>{_NUMBER}).*?lon\w*\s*:\s*(?P<lon>{_NUMBER})(?:.*?abs_alt\s*:\s*(?P<alt>{_NUMBER}))?"
    rf"|GPS\s*\((?P<lon2>{_NUMBER}),\s*(?P<lat2>{_NUMBER})",
    re.IGNORECASE | re.DOTALL,
)


def by_events(sources: Sequence[Source], text: str, file: str) -> list[GpsPosition | None]:
    """Positions of DJI's ``.MRK``: events by their number, which the names of images end with.

    They are those of the middle of the sensor; the offsets of the antenna are in them.
    """
    events: dict[int, GpsPosition] = {}
    for line in text.splitlines():
        if match := _EVENT.match(line):
            number, latitude, longitude, height, *std = (float(value) for value in match.groups())
            accuracy = (math.hypot(std[0], std[1]) / math.sqrt(2.0), std[2])
            if latitude or longitude:  # 0, 0 is what is written without a fix
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


class TrackPoint(NamedTuple):
    """A place by time, of the camera or of what carries it."""

    seconds: float  # since 1970, or since the video began: as the times of the images
    latitude: float  # latitude, longitude: degrees
    longitude: float
    altitude: float  # m; NaN where not known


def subtitle_points(text: str) -> list[TrackPoint]:
    """Places in the subtitles of a DJI video, by seconds since it began."""
    starts = list(_SUBTITLE.finditer(text))
    points = []
    for start, end in zip(starts, [*(s.start() for s in starts[1:]), len(text)], strict=False):
        if place := _IN_SUBTITLE.search(text, start.end(), end):
            hours, minutes, seconds, milliseconds = (float(part) for part in start.groups())
            latitude, longitude = (float(place[k] or place[f"{k}2"]) for k in ("lat", "lon"))
            if latitude or longitude:  # 0, 0 is what is written without a fix
                time = 3600.0 * hours + 60.0 * minutes + seconds + milliseconds / 1000.0
                points.append(TrackPoint(time, latitude, longitude, float(place["alt"] or "nan")))
    return points


def track_points(text: str, file: str) -> list[TrackPoint]:
    """Places of a GPX track, else of a route, else of waypoints, by seconds since 1970."""
    timed = [item for item in parse_xml(text, file).iter() if item.findtext("time") is not None]
    by_kind = ([item for item in timed if item.tag == kind] for kind in ("trkpt", "rtept", "wpt"))
    points = []
    for item in next(filter(None, by_kind), []):
        time = item.findtext("time", "")
        try:
            moment = datetime.fromisoformat(time.strip())
            values = (float(item.get("lat", "")), float(item.get("lon", "")), float(item.findtext("ele") or "nan"))
        except ValueError as error:
            raise InputError(f"{file}: a point of the track at {time!r} cannot be read: {error}") from error
        seconds = (moment if moment.tzinfo else moment.replace(tzinfo=UTC)).timestamp()
        points.append(TrackPoint(seconds, *values))
    return points


def on_track(
    sources: Sequence[Source], points: Sequence[TrackPoint], file: str, offset: float
) -> list[GpsPosition | None]:
    """Positions of the images on a track, straight from point to point; None beyond its ends, and in its gaps.

    ``offset``, s, is added to the times of the images.
    """
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
    rows[in_gap(seconds, times)] = np.nan
    return [
        None if math.isnan(y) else GpsPosition(y, (x + 180.0) % 360.0 - 180.0, None if math.isnan(z) else z)
        for y, x, z in rows.tolist()
    ]


def _moment(seconds: float) -> str:
    return str(np.datetime64(int(seconds), "s"))


def is_list_of_events(text: str) -> bool:
    """Check for DJI's ``.MRK``."""
    return _EVENT.match(text) is not None
