"""The places of tiles as a table for other programs."""

from collections.abc import Sequence

from rdstitch.stage.register import TileRegistration


def places_table(names: Sequence[str], tiled: TileRegistration) -> str:
    """CSV of name, x and y of the first pixel, row, column, what placed it, and micrometres where they are known."""
    grid, fitted = tiled.grid, tiled.adjustment
    places = fitted.places - fitted.places.min(axis=0)
    header = ["name", "x", "y", "row", "column", "placed_by"]
    if grid.pixel_size is not None:
        header += ["x_um", "y_um"]
    lines = [",".join(header)]
    for index, name in enumerate(names):
        x, y = places[index].tolist()
        by = "overlap" if tiled.linked[index] else "stage"
        quoted = f'"{name}"' if "," in name else name
        cells = [quoted, f"{x:.3f}", f"{y:.3f}", str(grid.rows[index]), str(grid.columns[index]), by]
        if grid.pixel_size is not None:
            cells += [f"{x * grid.pixel_size:.4f}", f"{y * grid.pixel_size:.4f}"]
        lines.append(",".join(cells))
    return "\n".join([*lines, ""])
