"""Options of putting tiles together."""

import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal, get_args

from rdstitch.compositing import CompositeOptions
from rdstitch.errors import ArgumentError
from rdstitch.io.stored_tiles import ZPlane
from rdstitch.stage.positions import Origin, Positions, ScanOrder


def measured_samples() -> CompositeOptions:
    """Composition that keeps samples: each pixel of the output is one tile's."""
    return CompositeOptions(exposure="none", seam="none", blend="none")


@dataclass(frozen=True, eq=False)
class TileOptions:
    """Options of :func:`rdstitch.tiles`; the command line has the same names and defaults.

    Attributes
    ----------
    positions : path, array, or table, optional
        CSV file with the columns name, x, y (pixels) or name, x_um, y_um; Fiji's TileConfiguration.txt; or, of each
        tile in the order given, an array (N, 2) of x and y in pixels, or a dict or data frame with x, y or x_um, y_um.
    grid : str, optional
        Part of the file names with ``{row}`` and ``{col}``, ``{letter}`` and ``{col}``, or ``{number}``.
    columns : int, optional
        Tiles in a row, with ``{number}``.
    order : str
        With ``{number}``: "rows", one after the other; "columns"; "snake-rows", to and fro; "snake-columns".
    origin : str
        Corner of the first tile, with ``grid``: "top-left", "top-right", "bottom-left" or "bottom-right".
    overlap : float
        Per cent of a tile that its neighbours show too, with ``grid``.
    pixel_size : float, optional
        Micrometres.
    search : float, optional
        How far neighbours may be from where they should be to each other, pixels.
    channel : int, optional
        That is registered, from 0; the mean of all if not given.
    z : int or "max", optional
        Plane of a stack, from 0; otherwise the brightest sample of all.
    time : int, optional
        Of a time series, from 0; otherwise the first.
    flat_field : str or path
        "auto": from the tiles themselves; "off"; or an image file, whose second page, if it has one, is the dark field.
    save_flat_field : path, optional
        TIFF file to write the flat field and the dark field to.
    distortion : float or "auto", optional
        λ where it is known; "auto": estimated. Otherwise 0, unless pairs along rows and along columns show the same.
    composite : CompositeOptions
        How the image is composed; by default each of its samples is one of a tile.
    overwrite : bool
        Replace existing files.
    strict : bool
        Fail where a tile cannot be read.
    dry_run : bool
        Only say what composing would take.
    workers : int
        Threads; 0 is one for each usable core.
    topic : str, optional
        Of a ROS bag, the topic of its images.
    """

    positions: Positions | None = None
    grid: str | None = None
    columns: int | None = None
    order: ScanOrder = "rows"
    origin: Origin = "top-left"
    overlap: float = 10.0
    pixel_size: float | None = None
    search: float | None = None
    channel: int | None = None
    z: ZPlane | None = None
    time: int | None = None
    flat_field: str | Path = "auto"
    save_flat_field: str | Path | None = None
    distortion: float | Literal["auto"] | None = None
    composite: CompositeOptions = field(default_factory=measured_samples)
    overwrite: bool = False
    strict: bool = False
    dry_run: bool = False
    workers: int = 0
    topic: str | None = None

    def __post_init__(self) -> None:
        if self.positions is not None and self.grid is not None:
            raise ArgumentError("positions and grid both say where the tiles are; leave one of them out")
        for name in ("pixel_size", "search"):
            value = getattr(self, name)
            if value is not None and not 0.0 < value < math.inf:
                raise ArgumentError(f"{name} must be positive, not {value}")
        for name in ("channel", "z", "time"):
            value = getattr(self, name)
            if isinstance(value, int) and value < 0:
                raise ArgumentError(f"{name} counts from 0, not from {value}")
        for name, choices in (("order", get_args(ScanOrder)), ("origin", get_args(Origin))):
            if getattr(self, name) not in choices:
                raise ArgumentError(f"{name} must be one of {', '.join(choices)}, not {getattr(self, name)!r}")
