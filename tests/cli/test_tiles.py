"""``rdstitch tiles``, run for real on rendered tiles of a stage."""

from pathlib import Path

import numpy as np
import pytest
import tifffile

from examples.worlds.stage_grid import StageGrid
from rdstitch.io.flat_field import FlatField
from rdstitch.report.stage import backlash
from tests.cli.running import SIDECAR_SCHEMA, Run, rows_of, sidecar_of

STAGE = StageGrid(rows=3, columns=3, tile=256, overlap=0.15, content=0.8, backlash=4.0, seed=5)
NAMED = ("--grid", "r{row}c{col}", "--overlap", "15")


@pytest.fixture(scope="module")
def slide(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("slide")
    STAGE.write(folder)
    return folder


def test_samples_of_the_mosaic_are_those_of_the_tiles(rdstitch: Run, slide: Path, tmp_path: Path) -> None:
    output, table = tmp_path / "slide.tif", tmp_path / "places.csv"
    rdstitch(
        "tiles", slide, *NAMED, "-o", output, "--positions-only", table, "--report", tmp_path / "r.html", "-j", "1"
    )
    mosaic = tifffile.imread(output)
    rows = rows_of(table)
    found = np.array([(float(row["x"]), float(row["y"])) for row in rows])
    off = found - STAGE.places
    assert np.linalg.norm(off - np.median(off, axis=0), axis=1).max() < 0.5
    middle = STAGE.render(4)[60:-60, 60:-60]
    x, y = np.rint(found[4]).astype(int) + 60
    near = [
        mosaic[y + dy : y + dy + middle.shape[0], x + dx : x + dx + middle.shape[1]]
        for dy in (-1, 0, 1)
        for dx in (-1, 0, 1)
    ]
    assert any(np.array_equal(part, middle) for part in near)
    page = (tmp_path / "r.html").read_text(encoding="utf-8")
    assert "backlash of rows" in page
    assert "9 of 9" in page
    content = sidecar_of(output)
    SIDECAR_SCHEMA.validate(content)
    assert content["model"] == "rigid"
    stage = content["stage"]
    assert [tile["placed_by"] for tile in stage["tiles"]] == [row["placed_by"] for row in rows] == ["overlap"] * 9
    assert [[tile["row"], tile["column"]] for tile in stage["tiles"]] == STAGE.cells.tolist()
    # Rows are taken to and fro: every other one is off by twice the backlash.
    assert backlash(np.array(stage["rows_px"]))[0] == pytest.approx(2 * STAGE.backlash, abs=2.5)
    assert np.shape(stage["columns_px"]) == (3, 2)
    np.testing.assert_allclose(stage["matrix"], np.eye(2), atol=0.02)


def test_places_from_a_mirrored_stage_are_found_too(rdstitch: Run, slide: Path, tmp_path: Path) -> None:
    lines = [f"r{r:02d}c{c:02d}.tif,{-x},{y}" for (r, c), (x, y) in zip(STAGE.cells, STAGE.nominal, strict=True)]
    stage = tmp_path / "stage.csv"
    stage.write_text("\n".join(["name,x,y", *lines]), encoding="utf-8")
    table = tmp_path / "places.csv"
    rdstitch("tiles", slide, "--positions", stage, "--positions-only", table, "-j", "1")
    rows = rows_of(table)
    assert float(rows[0]["x"]) < float(rows[2]["x"])
    assert not list(tmp_path.glob("*.json"))
    rdstitch("tiles", slide, "--positions", stage, "--positions-only", table, "--dry-run", status=2, told="--output")
    table.unlink()
    rdstitch("tiles", slide, "--positions", stage, "--positions-only", table, "--dry-run", "-o", tmp_path / "o.tif")
    assert {file.name for file in tmp_path.iterdir()} == {stage.name}


def test_a_wrong_overlap_is_found_and_named(rdstitch: Run, slide: Path, tmp_path: Path) -> None:
    output = tmp_path / "out.tif"
    rdstitch("tiles", slide, "--grid", "r{row}c{col}", "--overlap", "60", "-o", output, told="neighbours overlap by 1")
    assert tifffile.imread(output).shape[1] > 600


def test_tiles_that_show_nothing_are_refused_in_one_line(rdstitch: Run, slide: Path, tmp_path: Path) -> None:
    output, rng = tmp_path / "out.tif", np.random.default_rng(1)
    for row in range(2):
        tifffile.imwrite(tmp_path / f"r{row}c0.tif", rng.integers(90, 110, (200, 200), dtype=np.uint16))
    rdstitch("tiles", tmp_path, *NAMED, "-o", output, status=4, told="--search")
    assert not output.exists()
    rdstitch("tiles", slide, "-o", output, status=3)
    rdstitch("tiles", slide, *NAMED, status=2)


def test_most_tiles_by_the_stage_alone_are_written_with_a_status(rdstitch: Run, slide: Path, tmp_path: Path) -> None:
    folder, output, rng = tmp_path / "empty", tmp_path / "out.tif", np.random.default_rng(1)
    folder.mkdir()
    for file in slide.glob("*.tif"):
        shown = file.name in ("r00c00.tif", "r00c01.tif")
        noise = rng.integers(90, 110, (256, 256), dtype=np.uint16)
        tifffile.imwrite(folder / file.name, tifffile.imread(file) if shown else noise)
    done = rdstitch("tiles", folder, *NAMED, "--flat-field", "off", "-o", output, status=5)
    assert "not reliable: 7 of 9 tiles" in done.err
    assert not sidecar_of(output)["verdict"]["ok"]


def test_black_ground_stays(rdstitch: Run, slide: Path, tmp_path: Path) -> None:
    folder, output = tmp_path / "dark", tmp_path / "dark.tif"
    folder.mkdir()
    for file in slide.glob("*.tif"):
        tifffile.imwrite(
            folder / file.name, (1 + tifffile.imread(file).astype(np.uint32) ** 2 // 4096).astype(np.uint16)
        )
    rdstitch("tiles", folder, *NAMED, "--flat-field", "off", "-o", output)
    assert (tifffile.imread(output)[20:-20, 20:-20] > 0).all()


def test_ome_tiff_in_and_out(rdstitch: Run, tmp_path: Path) -> None:
    folder = tmp_path / "ome"
    folder.mkdir()
    for index, (x, y) in enumerate(STAGE.nominal.tolist()):
        tile = STAGE.render(index)
        metadata = {
            "axes": "CYX",
            "PhysicalSizeX": 0.5,
            "PhysicalSizeXUnit": "µm",
            "Plane": {"PositionX": [0.5 * x] * 2, "PositionY": [0.5 * y] * 2},
        }
        tifffile.imwrite(folder / f"{index}.ome.tif", np.stack([tile, tile // 2]), ome=True, metadata=metadata)
    output = tmp_path / "slide.ome.tif"
    rdstitch("tiles", folder, "--channel", "0", "--flat-field", "off", "-o", output, "-j", "1")
    with tifffile.TiffFile(output) as tiff:
        series = tiff.series[0]
        assert (series.axes, series.shape[0], len(series.levels)) == ("CYX", 2, 3)
        assert 'PhysicalSizeX="0.5"' in (tiff.ome_metadata or "")
        first, second = series.asarray()
        assert np.array_equal(second, first // 2)
        assert first.shape[0] > 600
    flat = tmp_path / "flat.tif"
    FlatField(np.full((256, 256, 1), 1.0, np.float32), np.zeros((1, 1, 1), np.float32)).write(flat)
    same = ("--flat-field", flat, "--match", "name")
    again = tmp_path / "again.ome.tif"
    rdstitch("apply", f"{output}.json", "--images", folder, "-o", again, *same, "-j", "1")
    assert again.read_bytes() == output.read_bytes()
