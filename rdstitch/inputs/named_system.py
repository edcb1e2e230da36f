"""Coordinate systems as lines of text files name them."""

import re
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from rdstitch.arrays import FloatArray
from rdstitch.errors import ArgumentError
from rdstitch.geometry.crs import WGS84, Crs, epsg_of, load_pyproj, transformed

_PLAIN_TERMS = {"datum": ("WGS84",), "ellps": ("WGS84",), "units": ("m",), "no_defs": ("",), "type": ("crs",)}
"""Terms of PROJ that leave a system one on WGS 84 in metres."""


@dataclass(frozen=True)
class NamedSystem:
    """The coordinate system that a line of a list names, as EPSG's code, WGS 84's UTM zone, or PROJ's definition."""

    text: str
    epsg: int | None  # where it is one in metres or degrees of WGS 84 whose code is known

    @classmethod
    def named_by(cls, text: str) -> "NamedSystem | None":
        """The system; None where the text names none."""
        text = text.strip()
        if code := re.fullmatch(r"(EPSG:(\d{1,5}))(\+\d{1,5})?", text, re.IGNORECASE):  # and the system of heights
            return cls(code[1].upper(), int(code[2]))
        if code := re.fullmatch(r"WGS ?84[ /]*UTM(?: zone)? (\d{1,2}) ?([NS])", text, re.IGNORECASE):
            zone = int(code[1])
            return cls(text, epsg_of(zone if code[2] in "nN" else -zone)) if 1 <= zone <= 60 else None
        terms = dict(re.findall(r"\+(\w+)(?:=(\S+))?", text))
        if "proj" not in terms and "init" not in terms:
            return None
        return cls(text, _code_of(terms))

    @classmethod
    def above(cls, text: str) -> "tuple[NamedSystem | None, str]":
        """The system that the first line names that is no comment, and the lines below; these keep their numbers."""
        lines = text.splitlines()
        first = next((n for n, line in enumerate(lines) if not re.match(r"\s*(#|$)", line)), 0)
        system = cls.named_by(lines[first]) if lines else None
        return (None, text) if system is None else (system, "\n".join([""] * (first + 1) + lines[first + 1 :]))

    def geographic(self, places: ArrayLike) -> FloatArray:
        """Latitude and longitude (N, 2) on WGS 84, degrees, of coordinates (N, 2) in the system's order x, y."""
        points = np.asarray(places, dtype=np.float64).reshape(-1, 2)
        if self.epsg == WGS84:
            return points[:, ::-1]
        if self.epsg is not None and (crs := Crs.in_metres(self.epsg)) is not None:
            return crs.geographic(points)
        pyproj = load_pyproj(self.text)
        try:
            return transformed(self.text, f"EPSG:{WGS84}", *points.T)[:, ::-1]
        except pyproj.exceptions.ProjError as error:
            reason = str(error).partition(":")[0]
            raise ArgumentError(f"{self.text}: PROJ does not know this coordinate system ({reason})") from error


def _code_of(terms: Mapping[str, str]) -> int | None:
    """Code of what PROJ's terms define, where that is UTM or degrees on WGS 84 and nothing else."""
    others = {name: value for name, value in terms.items() if name not in ("proj", "zone", "south")}
    if any(value not in _PLAIN_TERMS.get(name, ()) for name, value in others.items()):
        return None
    if terms["proj"] in ("longlat", "latlong"):
        return WGS84
    zone = terms.get("zone", "")
    if terms["proj"] == "utm" and zone.isdecimal() and 1 <= int(zone) <= 60:
        return epsg_of(-int(zone) if "south" in terms else int(zone))
    return None
