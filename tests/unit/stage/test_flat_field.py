"""The flat field of tiles against the truth, whatever they show."""

from pathlib import Path

import numpy as np
import pytest

from rdstitch.errors import InputError
from rdstitch.inputs.source import read_sources
from rdstitch.io.flat_field import FlatField, read_flat_field
from rdstitch.pipeline.read_inputs import with_flat_field
from rdstitch.stage.flat_field import estimate_illumination
from tests.stage_grid import Specimen, StageGrid


@pytest.mark.parametrize(
    ("specimen", "rows", "tile", "seed"),
    [("fluorescence", 7, 256, 1), ("brightfield", 7, 256, 1), ("fluorescence", 5, 512, 301)],
)
def test_shading_of_a_third_is_found_to_a_percent(specimen: Specimen, rows: int, tile: int, seed: int) -> None:
    stage = StageGrid(rows=rows, columns=rows, tile=tile, specimen=specimen, content=0.5, seed=seed)
    shown = estimate_illumination(stage.render, len(stage))
    off = shown.field.gain / stage.flat_field - 1.0
    assert np.sqrt((off**2).mean()) < 0.01
    if specimen == "fluorescence":
        assert shown.dark[0] == pytest.approx(100.0, abs=6.0)


def test_few_tiles_that_show_other_things_have_no_flat_field() -> None:
    stage = StageGrid(rows=1, columns=2, tile=256, content=0.5, seed=3)
    assert estimate_illumination(stage.render, 2).field is None


def test_what_is_read_before_the_flat_field_is_known_is_corrected_too(tmp_path: Path) -> None:
    stage = StageGrid(rows=3, columns=4, tile=256, content=0.5, seed=1)
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
