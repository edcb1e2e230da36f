"""Images of a motorized stage: positions, flat field and registration."""

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import tifffile
from numpy.typing import NDArray

from examples.worlds.stage_grid import Specimen, StageGrid
from rdstitch.arrays import FloatArray
from rdstitch.errors import ArgumentError, InputError
from rdstitch.inputs.source import read_sources
from rdstitch.io.flat_field import FlatField, read_flat_field
from rdstitch.io.stored_tiles import stored_tiles
from rdstitch.io.write import write_image
from rdstitch.pipeline.composition.flat_field import with_flat_field
from rdstitch.stage import SearchPlan, TileRegistration, register_tiles
from rdstitch.stage.axes import with_measured_axes
from rdstitch.stage.coarse_tile import coarse_tile
from rdstitch.stage.estimate_flat_field import FlatFieldUnknown, Illumination, estimate_illumination
from rdstitch.stage.grid import TileGrid
from rdstitch.stage.overlap import Overlap
from rdstitch.stage.phase_correlation import correlate
from rdstitch.stage.positions import Scan, grid_from_names, grid_from_table, grid_from_tiles
from rdstitch.stage.sentences import axes_contradicted


@pytest.mark.parametrize(("side", "degrees"), [(3, 0.0), (20, 2.3), (60, 0.8), (20, -15.0)])
def test_a_stage_turned_to_the_camera_has_its_rows_and_columns(side: int, degrees: float) -> None:
    columns, rows = (each.ravel() for each in np.meshgrid(np.arange(side), np.arange(side)))
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    off = np.random.default_rng(0).normal(0.0, 8.0, (side**2, 2))
    places = np.stack([columns * 900.0, rows * 700.0], axis=1) @ np.array([[c, s], [-s, c]]) + off
    grid = TileGrid(places, (1000, 800))
    np.testing.assert_array_equal(grid.rows, rows)
    np.testing.assert_array_equal(grid.columns, columns)


@pytest.mark.parametrize("page", [0, 1])
def test_a_flat_field_is_finite_and_its_page_is_named(tmp_path: Path, page: int) -> None:
    pages = [np.ones((4, 6), np.float32), np.zeros((4, 6), np.float32)]
    pages[page][0, 0] = np.nan
    tifffile.imwrite(tmp_path / "f.tif", np.stack(pages), photometric="minisblack")
    with pytest.raises(InputError, match=f"page {page + 1} has values that are not finite"):
        read_flat_field(tmp_path / "f.tif", (6, 4), 1)


@pytest.mark.parametrize(
    ("specimen", "rows", "tile", "seed"),
    [("fluorescence", 7, 256, 1), ("brightfield", 7, 256, 1), ("fluorescence", 5, 512, 301)],
)
def test_shading_of_a_third_is_found_to_a_percent(specimen: Specimen, rows: int, tile: int, seed: int) -> None:
    stage = StageGrid(rows=rows, columns=rows, tile=tile, specimen=specimen, content=0.5, seed=seed)
    shown = estimate_illumination(stage.render, len(stage))
    assert isinstance(shown, Illumination)
    off = shown.field.gain / stage.flat_field - 1.0
    assert np.sqrt((off**2).mean()) < min(0.01, 3.0 * shown.error)
    if specimen == "fluorescence":
        (dark,) = shown.dark
        assert dark is not None
        assert dark.level == pytest.approx(100.0, abs=6.0)
    # Few tiles that show other things have none.
    few = StageGrid(rows=1, columns=2, tile=256, content=0.5, seed=3)
    assert estimate_illumination(few.render, 2) is FlatFieldUnknown.FEW_TILES


_STRIPS: tuple[Any, ...] = np.s_[:40], np.s_[:9], np.s_[:, 200:220]


@pytest.mark.parametrize(("specimen", "shown"), [("brightfield", 3), ("fluorescence", 0)])
def test_narrow_tiles_show_their_flat_field_too_or_say_that_they_do_not(specimen: Specimen, shown: int) -> None:
    """Strips of fluorescence do not show the dark level, which is half of their light."""
    stage = StageGrid(rows=7, columns=7, tile=256, specimen=specimen, content=0.5, seed=1)
    tiles = [stage.render(index) for index in range(len(stage))]
    strips = [[tile[part] for tile in tiles] for part in _STRIPS]
    found = [estimate_illumination(every.__getitem__, len(stage)) for every in strips]
    assert sum(each is not FlatFieldUnknown.UNSURE for each in found) == shown
    for part, each in zip(_STRIPS, found, strict=True):
        expected = stage.flat_field[part] / stage.flat_field[part].mean(axis=(0, 1))
        if isinstance(each, Illumination):
            assert np.sqrt(((each.field.gain / expected - 1.0) ** 2).mean()) < 2.0 * each.error


def test_what_is_read_before_the_flat_field_is_known_is_corrected_too(tmp_path: Path) -> None:
    stage = StageGrid(rows=6, columns=6, tile=192, content=0.5, seed=1)
    sources, _ = read_sources(stage.write(tmp_path), skip_bad=False)
    raw = [source.read(keep=True).pixels for source in sources]
    corrected, _ = with_flat_field(sources, "auto")
    field = corrected[0].flat_field
    for before, source in zip(raw, corrected, strict=True):
        assert np.array_equal(source.read(keep=True).pixels, field.corrected(before))


def test_the_dark_level_stays_and_files_hold_both(tmp_path: Path) -> None:
    gain = np.linspace(0.5, 1.5, 12, dtype=np.float32).reshape(3, 4, 1)
    field = FlatField(gain, np.full((1, 1, 1), 10.0, np.float32))
    light = np.full((3, 4), 200.0)
    measured = np.rint(light * gain[..., 0] + 10.0).astype(np.uint16)
    assert np.abs(field.corrected(measured).astype(int) - 210).max() <= 1
    file = tmp_path / "flat.tif"
    field.write(file)
    again = read_flat_field(file, (4, 3), 1)
    np.testing.assert_allclose(again.corrected(measured), field.corrected(measured))
    with pytest.raises(InputError, match="4 x 3"):
        read_flat_field(file, (5, 3), 1)


def test_overviews_and_masks_of_a_flat_field_are_no_dark_fields(tmp_path: Path) -> None:
    pixels, holed = np.full((600, 800), 100, np.uint8), np.full((600, 800), 255, np.uint8)
    holed[0, 0] = 0
    for alpha in (None, holed):
        write_image(tmp_path / "flat.tif", pixels, alpha)
        field = read_flat_field(tmp_path / "flat.tif", (800, 600), 1)
        assert (field.gain.shape, field.dark.tolist()) == ((600, 800, 1), [[[0.0]]])


SIZE = (100, 80)


def test_names_give_rows_and_columns() -> None:
    names = ["s_r03c10.tif", "s_r03c11.tif", "s_r04c10.tif"]
    grid = grid_from_names(names, "r{row}c{col}", 10.0, SIZE)
    np.testing.assert_allclose(grid.places, [(0, 0), (90, 0), (0, 72)])
    assert (grid.rows.tolist(), grid.columns.tolist()) == ([0, 0, 1], [0, 1, 0])
    assert sorted(map(tuple, grid.neighbours(4.0).tolist())) == [(0, 1), (0, 2)]


def test_running_numbers_go_to_and_fro_from_a_corner() -> None:
    names = [f"img_{k:03d}.tif" for k in range(5, 11)]
    grid = grid_from_names(names, "img_{number}", 0.0, (10, 10), Scan(3, "snake-rows", "bottom-left"))
    np.testing.assert_array_equal(grid.places, [(0, 10), (10, 10), (20, 10), (20, 0), (10, 0), (0, 0)])
    down = grid_from_names(names, "img_{number}", 0.0, (10, 10), Scan(3, "snake-columns", "top-right"))
    np.testing.assert_array_equal(down.places, [(20, 0), (20, 10), (10, 10), (10, 0), (0, 0), (0, 10)])
    plate = grid_from_names(["plate_A01.tif", "plate_B02.tif"], "{letter}{col}", 0.0, (10, 10))
    np.testing.assert_array_equal(plate.places, [(0, 0), (10, 10)])


def test_a_scan_without_columns_is_refused() -> None:
    with pytest.raises(ArgumentError, match="columns"):
        Scan(0)


@pytest.mark.parametrize(
    ("pattern", "names"), [("r{row}", ["r1"]), ("r{row}c{col}", ["r1c1", "x"]), ("r{row}c{col}", ["r1c1_a", "r1c1_b"])]
)
def test_a_pattern_that_does_not_tell_tiles_apart_is_refused(pattern: str, names: list[str]) -> None:
    with pytest.raises(ArgumentError):
        grid_from_names(names, pattern, 10.0, SIZE)


def test_a_table_in_micrometres_needs_the_size_of_a_pixel(tmp_path: Path) -> None:
    table = tmp_path / "stage.csv"
    table.write_text("Name,X_um,Y_um\nb.tif,50,5\na.tif,5,5\n", encoding="utf-8")
    grid = grid_from_table(["a.tif", "b.tif"], table, SIZE, 0.5)
    np.testing.assert_allclose(grid.places, [(0, 0), (90, 0)])
    with pytest.raises(InputError, match="--pixel-size"):
        grid_from_table(["a.tif", "b.tif"], table, SIZE, None)
    with pytest.raises(InputError, match=r"has no line for c\.tif"):
        grid_from_table(["c.tif"], table, SIZE, 0.5)
    table.write_text("name,x (mm),y (mm)\na.tif,0,0\n", encoding="utf-8")
    with pytest.raises(InputError, match=r"'x \(mm\)' has a unit that is not known here; give it in px or um"):
        grid_from_table(["a.tif"], table, SIZE, 0.5)


def test_ome_tiff_says_where_it_was_taken(tmp_path: Path) -> None:
    files = [tmp_path / f"{k}.ome.tif" for k in range(2)]
    for k, file in enumerate(files):
        plane = {"PositionX": 0.0225 * k, "PositionXUnit": "mm", "PositionY": 1.0, "PositionYUnit": "mm"}
        metadata = {"axes": "YX", "PhysicalSizeX": 0.25, "PhysicalSizeXUnit": "µm", "Plane": plane}
        tifffile.imwrite(file, np.zeros((80, 100), np.uint16), ome=True, metadata=metadata)
    grid = grid_from_tiles(stored_tiles(files), SIZE, None)
    np.testing.assert_allclose(grid.places, [(0, 0), (90, 0)])
    assert grid.pixel_size == 0.25


def test_micro_manager_says_it_beside_the_files(tmp_path: Path) -> None:
    place = {"YPositionUm": 3.0, "PixelSizeUm": 0.5}
    entries = {
        f"Metadata-Pos{k}/img.tif": {"FileName": f"Pos{k}/img_{k}.tif", "XPositionUm": -10.0 - 45.0 * k, **place}
        for k in range(2)
    }
    (tmp_path / "metadata.txt").write_text(json.dumps(entries), encoding="utf-8")
    files = [tmp_path / f"img_{k}.tif" for k in range(2)]
    for file in files:
        tifffile.imwrite(file, np.zeros((80, 100), np.uint16))
    np.testing.assert_allclose(grid_from_tiles(stored_tiles(files), SIZE, None).places, [(90, 0), (0, 0)])
    (tmp_path / "metadata.txt").unlink()
    with pytest.raises(InputError, match="--grid"):
        grid_from_tiles(stored_tiles(files), SIZE, None)


@pytest.mark.parametrize("matrix", [((0, 1), (1, 0)), ((1, 0), (0, -1)), ((-1, 0), (0, -1)), ((1, 0), (0.15, 1))])
def test_axes_and_overlap_are_those_that_the_tiles_show(
    matrix: tuple[tuple[float, float], tuple[float, float]],
) -> None:
    stage = StageGrid(rows=3, columns=3, tile=256, overlap=0.13, content=0.9, seed=5)
    told = stage.nominal @ np.array(matrix, float) * 0.9
    grid = TileGrid(told - told.min(axis=0), (256, 256))
    read = lambda index: coarse_tile(stage.render(index), 1)  # noqa: E731
    shown, axes = with_measured_axes(grid, read, 1, 12.8)
    assert np.abs(shown.places - stage.nominal).max() < 12.0
    (x, y), (u, v) = np.sign(np.round(matrix))
    assert [axes[k].swapped for k in (0, 1)] == [x == 0, v == 0]
    assert [axes[k].mirrored for k in (0, 1)] == [x + u < 0, y + v < 0]
    assert "neighbours overlap by 1" in axes_contradicted("--grid", axes).text
    right = TileGrid(stage.nominal, (256, 256))
    assert with_measured_axes(right, read, 1, 12.8) == (right, {})


def _array(rng: np.random.Generator) -> tuple[list[NDArray[np.float32]], FloatArray]:
    """Six tiles of an integrated circuit with nothing unique, and where they are, some pixels off."""
    y, x = np.mgrid[:640, :900].astype(np.float32)
    ground = 60.0 * np.exp(-((x % 16.0 - 8.0) ** 2 + (y % 10.0 - 5.0) ** 2) / 6.0)
    places = np.array([(270.0 * c, 220.0 * r) for r in range(2) for c in range(3)]) + rng.integers(0, 5, (6, 2)).astype(
        np.float64
    )
    tiles = [ground[int(v) : int(v) + 256, int(u) : int(u) + 320] for u, v in places]
    return [(tile + rng.normal(0.0, 3.0, tile.shape)).astype(np.float32) for tile in tiles], places


def test_tiles_of_a_pattern_without_anything_unique_stay_where_the_stage_was_sent() -> None:
    tiles, places = _array(np.random.default_rng(4))
    nominal = np.array([(270.0 * c, 220.0 * r) for r in range(2) for c in range(3)])
    grid = TileGrid(nominal, (320, 256))
    assert with_measured_axes(grid, lambda index: coarse_tile(tiles[index], 1), 1, 16.0)[1] == {}
    found = register_tiles(SearchPlan.of(grid), tiles.__getitem__)
    off = found.adjustment.places - places
    assert np.abs(off - np.median(off, axis=0)).max() < 5.0
    assert (
        np.abs(off - off[list(found.groups[0]) if found.groups else 0].mean(axis=0)).max(axis=1) < 5 * found.stds + 0.5
    ).all()


def test_a_tile_that_lies_elsewhere_is_found_there() -> None:
    stage = StageGrid(rows=3, columns=3, tile=256, overlap=0.2, content=0.9, backlash=0.0, seed=6)
    nominal = stage.nominal.copy()
    nominal[4] += (45.0, -20.0)
    tiles = [stage.render(index).astype(np.float32) for index in range(9)]
    found = register_tiles(SearchPlan.of(TileGrid(nominal, (256, 256))), tiles.__getitem__)
    off = found.adjustment.places - stage.places
    assert np.abs(off - np.median(off, axis=0)).max() < 0.5
    assert int(found.off_stage.argmax()) == 4


def test_errors_are_what_they_are_said_to_be() -> None:
    squared = []
    for seed in range(2):
        stage = StageGrid(rows=5, columns=4, tile=192, overlap=0.15, content=0.4, backlash=4.0, seed=seed)
        found = _registered(stage)
        off = found.adjustment.places - stage.places
        squared.append(((off - off[list(found.groups[0])].mean(axis=0)) / found.stds[:, None]) ** 2)
    assert 0.3 < np.mean(squared) < 2.5
    assert np.max(squared) < 25.0


def _registered(stage: StageGrid) -> TileRegistration:
    tiles = [stage.render(index).astype(np.float32) for index in range(len(stage))]
    planes = [tile if tile.ndim == 2 else tile.mean(axis=2) for tile in tiles]
    return register_tiles(SearchPlan.of(TileGrid(stage.nominal, (stage.tile, stage.tile))), planes.__getitem__)


def _pair_errors(stage: StageGrid, found: TileRegistration) -> FloatArray:
    first, second = found.links.tiles.T
    off = found.adjustment.places - stage.places
    return np.asarray(np.linalg.norm(off[second] - off[first], axis=1))


@pytest.mark.parametrize("specimen", ["fluorescence", "brightfield"])
def test_tiles_with_content_are_placed_to_a_fraction_of_a_pixel(specimen: Specimen) -> None:
    stage = StageGrid(rows=4, columns=4, tile=384, specimen=specimen, content=0.6, backlash=6.0, seed=2)
    found = _registered(stage)
    assert found.linked.sum() >= 10
    errors = _pair_errors(stage, found)
    assert np.median(errors) < 0.2
    assert errors.max() < 1.0
    # ±6 pixels of backlash are learnt from the others by a tile that shows nothing.
    off = found.adjustment.places - stage.places
    assert np.abs(off - np.median(off[found.linked], axis=0)).max() < 5.0
    assert found.adjustment.distortion == 0.0
    assert found.adjustment.distortion_std < 0.003


def test_the_lens_is_found_where_half_of_the_tiles_have_content() -> None:
    stage = StageGrid(rows=4, columns=4, tile=384, content=0.5, distortion=-0.02, seed=2)
    found = _registered(stage)
    assert found.adjustment.distortion == pytest.approx(-0.02, abs=0.003)
    assert np.median(_pair_errors(stage, found)) < 0.3
    two = StageGrid(rows=1, columns=2, tile=320, overlap=0.13, content=0.9, seed=3)
    assert _registered(two).adjustment.distortion == 0.0


def test_nothing_but_noise_leaves_all_places_as_they_were() -> None:
    noise = np.random.default_rng(1).normal(100.0, 3.0, size=(6, 200, 200)).astype(np.float32)
    places = np.array([(x, y) for y in (0.0, 180.0) for x in (0.0, 180.0, 360.0)])
    found = register_tiles(SearchPlan.of(TileGrid(places, (200, 200))), noise.__getitem__)
    assert not found.linked.any()
    np.testing.assert_allclose(found.adjustment.places, places, atol=1e-6)
    assert np.isinf(found.adjustment.distortion_std)


@pytest.mark.parametrize("seed", range(3))
def test_a_wrong_period_of_a_pattern_does_not_win_by_the_height_of_its_peak(seed: int) -> None:
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[:300, :600].astype(np.float32)
    dots = 60.0 * np.exp(-((x % 14.0 - 7.0) ** 2 + (y % 14.0 - 7.0) ** 2) / 3.0)
    clouds = cv2.GaussianBlur(rng.normal(size=x.shape).astype(np.float32), (0, 0), 10.0)
    ground = dots + 30.0 * clouds / clouds.std()
    tiles = [ground[20:276, 10:266], ground[23:279, 225:481]]
    tiles = [(tile + rng.normal(0.0, 12.0, size=tile.shape)).astype(np.float32) for tile in tiles]
    overlap = Overlap.expected(np.array([212.0, 0.0]), np.full((2, 2), 256), 5)
    surface = correlate(tiles[0], tiles[1], overlap, 30).total(np.zeros((len(overlap.blocks), 2)), 30)
    highest = np.unravel_index(int(surface.argmax()), surface.shape)
    assert np.abs(np.array(highest) - (33, 33)).max() > 5
    grid = TileGrid(np.array([[0.0, 0.0], [212.0, 0.0]]), (256, 256))
    found = register_tiles(SearchPlan.of(grid, 30.0), tiles.__getitem__, distortion=0.0).adjustment
    np.testing.assert_allclose(found.places[1] - found.places[0], (215.0, 3.0), atol=0.3)
    assert found.distortion_std == 0.0  # 0 was given, as any other λ may be
