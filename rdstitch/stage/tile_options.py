"""Options of putting tiles together."""

import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from rdstitch.compositing import CompositeOptions
from rdstitch.errors import ArgumentError


def measured_samples() -> CompositeOptions:
    """Composition that keeps samples: each pixel of the output is one tile's."""
    return CompositeOptions(exposure="none", seam="none", blend="none")


@dataclass(frozen=True)
class TileOptions:
    """Options of :func:`rdstitch.tiles`; the command line has the same names and defaults.

    Attributes
    ----------
    positions : path, optional
        CSV file with the columns name, x, y (pixels) or name, x_um, y_um.
    grid : str, optional
        Part of the file names with ``{row}`` and ``{col}``.
    overlap : float
        Per cent of a tile that its neighbours show too, with ``grid``.
    pixel_size : float, optional
        Micrometres.
    search : float, optional
        How far neighbours may be from where they should be to each other, pixels.
    channel : int, optional
        That is registered, from 0; the mean of all if not given.
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

    positions: str | Path | None = None
    grid: str | None = None
    overlap: float = 10.0
    pixel_size: float | None = None
    search: float | None = None
    channel: int | None = None
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
        if self.channel is not None and self.channel < 0:
            raise ArgumentError(f"channels count from 0, not from {self.channel}")
