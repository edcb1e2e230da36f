"""Options of putting tiles together."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar, Literal

from rdstitch.choices import Origin, ScanOrder, ZPlane
from rdstitch.errors import ArgumentError
from rdstitch.options.composite_options import CompositeOptions
from rdstitch.options.option import Contradiction, Range, documented, option, reads, writes
from rdstitch.options.shared_options import FlatField, RunOptions

if TYPE_CHECKING:
    from numpy.typing import ArrayLike


def measured_samples() -> CompositeOptions:
    """Composition that keeps samples: each pixel of the output is one tile's."""
    return CompositeOptions(exposure="none", seam="none", blend="none")


@documented
@dataclass(frozen=True, eq=False)
class TileOptions(RunOptions):
    """Options of :func:`rdstitch.tiles`; the command line has the same names and defaults.

    Besides a file, ``positions`` may be, of each tile in the order given, an array (N, 2) of x and y in pixels, or a
    dict or data frame with x, y or x_um, y_um. By default (``composite``) each sample of the image is one of a tile.
    """

    contradictions: ClassVar[tuple[Contradiction, ...]] = (
        Contradiction(
            ("positions",), ("grid",), "positions and grid both say where the tiles are; leave one of them out"
        ),
    )
    positions: "str | Path | ArrayLike | Mapping[str, ArrayLike] | None" = reads(
        "CSV with name,x,y (pixels) or name,x_um,y_um, or Fiji's TileConfiguration.txt; otherwise what OME-TIFF "
        "or Micro-Manager say."
    )
    grid: str | None = option(
        None,
        "Part of the file names, with {row} and {col} for numbers and * for anything, such as 'r{row}c{col}'; "
        "'{letter}{col}' for A01; 'img_{number}' for running numbers.",
        "PATTERN",
    )
    columns: int | None = option(None, "With {number}: tiles in a row.", within=Range(least=1))
    order: ScanOrder = option("rows", "With {number}: how tiles follow each other; snake: to and fro.")
    origin: Origin = option("top-left", "With --grid: where the first tile is.", needs=("grid",))
    overlap: float = option(
        10.0,
        "With --grid: overlap of neighbouring tiles.",
        "PERCENT",
        within=Range(least=0.0, below=100.0),
        needs=("grid",),
    )
    pixel_size: float | None = option(
        None, "Pixel size, micrometres, if no file states it.", "UM", within=Range(above=0.0)
    )
    search: float | None = option(
        None,
        "Search radius around the nominal offset of neighbours; otherwise 5 % of a tile's side.",
        "PX",
        within=Range(above=0.0),
    )
    channel: int | None = option(
        None, "Register this channel, from 0; otherwise the mean of all. All are composed.", within=Range(least=0)
    )
    z: ZPlane | None = option(
        None, "Plane of z stacks, from 0; otherwise the brightest sample of all planes.", "max|N", within=Range(least=0)
    )
    time: int | None = option(None, "Time of a series, from 0; otherwise the first.", within=Range(least=0))
    flat_field: FlatField = "auto"
    save_flat_field: str | Path | None = writes("Write flat field and dark field to this TIFF file.")
    distortion: float | Literal["auto"] | None = option(
        None,
        "Known λ (half-diagonal frame), or auto: estimate it; otherwise 0 unless all overlaps show it.",
        "L|auto",
        "--lambda",
        within=Range(above=-1.0, below=1.0),
    )
    composite: CompositeOptions = field(default_factory=measured_samples)

    def __post_init__(self) -> None:
        super().__post_init__()
        if (self.columns, self.order) != (None, "rows") and "{number}" not in (self.grid or ""):
            raise ArgumentError("columns and order say how running numbers are laid out: they go with {number} in grid")
