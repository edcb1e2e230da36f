"""Tiles on a stage: what the stage does, row by row and column by column."""

import math

import numpy as np

from rdstitch.arrays import FloatArray, IntArray
from rdstitch.report.svg import counted, element, section, table
from rdstitch.results.registration import Registration
from rdstitch.stage.register_tiles import TileRegistration


def stage_section(registration: Registration) -> str:
    """Backlash, and a table for rows and one for columns; nothing where the images are no tiles."""
    tiled = registration.tiles
    if tiled is None:
        return ""
    model, grid = tiled.adjustment.stage, tiled.grid
    turn = math.degrees(math.atan2(model.matrix[1, 0] - model.matrix[0, 1], np.trace(model.matrix)))
    x, y = backlash(model.rows)
    stds = (("rows", model.row_std), ("columns", model.column_std), ("tiles", model.std))
    rows = [
        ("places", grid.source),
        ("tiles placed by overlaps", f"{int(tiled.linked.sum())} of {len(grid)}"),
        ("groups of tiles", str(len(tiled.groups))),
        ("camera against the stage", f"{turn:.3f}°, scale {math.sqrt(abs(np.linalg.det(model.matrix))):.5f}"),
        ("backlash of rows", f"{x:.2f}, {y:.2f} pixels, every other row against the rest"),
        ("scatter", ", ".join(f"{what} {std:.2f}" for what, std in stds if std is not None) + " pixels"),
    ]
    if grid.pixel_size is not None:
        rows.append(("pixel", f"{grid.pixel_size:g} µm"))
    header = ("number", "tiles by overlap", "off in x, y (pixels)", "error of its links, median (pixels)")
    return section(
        "Stage",
        f"{counted(len(grid), 'tile')}; the error of links is what overlaps disagree by after all places are adjusted.",
        table(rows),
        element("h3", "Rows"),
        table(_lines(tiled, grid.rows, model.rows), header),
        element("h3", "Columns"),
        table(_lines(tiled, grid.columns, model.columns), header),
    )


def backlash(rows: FloatArray) -> tuple[float, float]:
    """What every other row is off against the rows between, (x, y), pixels: rows (R, 2) are taken to and fro."""
    if len(rows) < 2:
        return 0.0, 0.0
    x, y = (np.median(rows[1::2], axis=0) - np.median(rows[::2], axis=0)).tolist()
    return x, y


def _lines(tiled: TileRegistration, number: IntArray, off: FloatArray) -> list[tuple[str, ...]]:
    """Cells of a table, a line for each row or column of the grid."""
    links, squared = tiled.links, (tiled.adjustment.residuals**2).sum(axis=1)
    agreeing = tiled.adjustment.weights[links.pair] > 0.25 if len(links.pair) else np.zeros(0, dtype=np.bool_)
    first, second = (number[links.tiles[links.pair, k]] for k in (0, 1))
    lines: list[tuple[str, ...]] = []
    for line in range(len(off)):
        links_of_line = agreeing & ((first == line) | (second == line))
        error = f"{math.sqrt(float(np.median(squared[links_of_line]))):.3f}" if links_of_line.any() else "none"
        here = number == line
        x, y = off[line].tolist()
        lines.append((str(line), f"{int(tiled.linked[here].sum())} of {int(here.sum())}", f"{x:.2f}, {y:.2f}", error))
    return lines
