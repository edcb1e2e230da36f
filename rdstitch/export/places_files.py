"""The places of tiles as files: a table, and Fiji's list of tiles."""

import csv
import io
from collections.abc import Sequence

from rdstitch.arrays import FloatArray
from rdstitch.stage.register_tiles import TileRegistration


def places_table(names: Sequence[str], tiled: TileRegistration) -> str:
    """CSV of name, x and y of the first pixel, row, column, what placed it, and micrometres where they are known."""
    grid, places = tiled.grid, tiled.adjustment.places
    places = places - places.min(axis=0)
    text = io.StringIO()
    table = csv.writer(text, lineterminator="\n")
    micrometres = [] if grid.pixel_size is None else ["x_um", "y_um"]
    table.writerow(["name", "x", "y", "std", "row", "column", "placed_by", *micrometres])
    rows, columns = grid.rows, grid.columns
    for k, (name, place, std) in enumerate(zip(names, places.tolist(), tiled.stds, strict=True)):
        line = [name, *(f"{value:.3f}" for value in (*place, std)), rows[k], columns[k]]
        by = "overlap" if tiled.linked[k] else "stage"
        table.writerow([*line, by, *(f"{value * grid.pixel_size:.4f}" for value in place if grid.pixel_size)])
    return text.getvalue()


def fiji_list(names: Sequence[str], places: FloatArray) -> str:
    """The places as Fiji's list of tiles."""
    heading = ("# Define the number of dimensions we are working on", "dim = 2", "", "# Define the image coordinates")
    lines = [f"{name}; ; ({x:.3f}, {y:.3f})" for name, (x, y) in zip(names, places.tolist(), strict=True)]
    return "\n".join([*heading, *lines, ""])
