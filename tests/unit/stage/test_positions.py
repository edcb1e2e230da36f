"""Nominal places from what users have."""

import json
from pathlib import Path

import numpy as np
import pytest
import tifffile

from rdstitch.errors import ArgumentError, InputError
from rdstitch.stage.grid import TileGrid
from rdstitch.stage.positions import grid_from_files, grid_from_names, grid_from_table, oriented

SIZE = (100, 80)


def test_names_give_rows_and_columns() -> None:
    names = ["s_r03c10.tif", "s_r03c11.tif", "s_r04c10.tif"]
    grid = grid_from_names(names, "r{row}c{col}", 0.1, SIZE)
    np.testing.assert_allclose(grid.places, [(0, 0), (90, 0), (0, 72)])
    assert (grid.rows.tolist(), grid.columns.tolist()) == ([0, 0, 1], [0, 1, 0])
    assert sorted(map(tuple, grid.neighbours(4.0).tolist())) == [(0, 1), (0, 2)]


@pytest.mark.parametrize(
    ("pattern", "names"), [("r{row}", ["r1"]), ("r{row}c{col}", ["r1c1", "x"]), ("r{row}c{col}", ["r1c1_a", "r1c1_b"])]
)
def test_a_pattern_that_does_not_tell_tiles_apart_is_refused(pattern: str, names: list[str]) -> None:
    with pytest.raises(ArgumentError):
        grid_from_names(names, pattern, 0.1, SIZE)


def test_a_table_in_micrometres_needs_the_size_of_a_pixel(tmp_path: Path) -> None:
    table = tmp_path / "stage.csv"
    table.write_text("Name,X_um,Y_um\nb.tif,50,5\na.tif,5,5\n", encoding="utf-8")
    grid = grid_from_table(["a.tif", "b.tif"], table, SIZE, 0.5)
    np.testing.assert_allclose(grid.places, [(0, 0), (90, 0)])
    with pytest.raises(InputError, match="--pixel-size"):
        grid_from_table(["a.tif", "b.tif"], table, SIZE, None)
    with pytest.raises(InputError, match=r"has no line for c\.tif"):
        grid_from_table(["c.tif"], table, SIZE, 0.5)


def test_ome_tiff_says_where_it_was_taken(tmp_path: Path) -> None:
    files = [tmp_path / f"{k}.ome.tif" for k in range(2)]
    for k, file in enumerate(files):
        metadata = {
            "axes": "YX",
            "PhysicalSizeX": 0.25,
            "PhysicalSizeXUnit": "µm",
            "Plane": {"PositionX": 0.0225 * k, "PositionXUnit": "mm", "PositionY": 1.0, "PositionYUnit": "mm"},
        }
        tifffile.imwrite(file, np.zeros((80, 100), np.uint16), ome=True, metadata=metadata)
    grid = grid_from_files(files, SIZE, None)
    np.testing.assert_allclose(grid.places, [(0, 0), (90, 0)])
    assert grid.pixel_size == 0.25


def test_micro_manager_says_it_beside_the_files(tmp_path: Path) -> None:
    entries = {
        f"Metadata-Pos{k}/img.tif": {
            "FileName": f"Pos{k}/img_{k}.tif",
            "XPositionUm": -10.0 - 45.0 * k,
            "YPositionUm": 3.0,
            "PixelSizeUm": 0.5,
        }
        for k in range(2)
    }
    (tmp_path / "metadata.txt").write_text(json.dumps(entries), encoding="utf-8")
    files = [tmp_path / f"img_{k}.tif" for k in range(2)]
    for file in files:
        tifffile.imwrite(file, np.zeros((80, 100), np.uint16))
    np.testing.assert_allclose(grid_from_files(files, SIZE, None).places, [(90, 0), (0, 0)])
    (tmp_path / "metadata.txt").unlink()
    with pytest.raises(InputError, match="--grid"):
        grid_from_files(files, SIZE, None)


def test_axes_of_the_stage_are_turned_only_where_the_tiles_say_so() -> None:
    grid = TileGrid(np.array([(0.0, 0.0), (90.0, 0.0), (0.0, 72.0)]), SIZE)
    mirrored = np.array([(90.0, 0.0), (0.0, 0.0), (90.0, 72.0)])
    assert oriented(grid, lambda _: 1.0) is grid
    found = oriented(grid, lambda g: 5.0 if np.allclose(g.places, mirrored) else 1.0)
    np.testing.assert_allclose(found.places, mirrored)
