"""All places of tiles on a stage against the truth."""

import cv2
import numpy as np
import pytest

from rdstitch.arrays import FloatArray
from rdstitch.stage import TileGrid, TileRegistration, register_tiles
from rdstitch.stage.correlation import correlate
from rdstitch.stage.overlap import Overlap
from tests.stage_grid import Specimen, StageGrid


def _registered(stage: StageGrid) -> TileRegistration:
    tiles = [stage.render(index).astype(np.float32) for index in range(len(stage))]
    planes = [tile if tile.ndim == 2 else tile.mean(axis=2) for tile in tiles]
    return register_tiles(TileGrid(stage.nominal, (stage.tile, stage.tile)), planes.__getitem__)


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


def test_nothing_but_noise_leaves_all_places_as_they_were() -> None:
    noise = np.random.default_rng(1).normal(100.0, 3.0, size=(6, 200, 200)).astype(np.float32)
    places = np.array([(x, y) for y in (0.0, 180.0) for x in (0.0, 180.0, 360.0)])
    found = register_tiles(TileGrid(places, (200, 200)), noise.__getitem__)
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
    overlap = Overlap.expected(0, 1, np.array([212.0, 0.0]), (256, 256), 5)
    surface = correlate(tiles[0], tiles[1], overlap, 30).total(np.zeros((len(overlap.blocks), 2)), 30)
    highest = np.unravel_index(int(surface.argmax()), surface.shape)
    assert np.abs(np.array(highest) - (33, 33)).max() > 5
    grid = TileGrid(np.array([[0.0, 0.0], [212.0, 0.0]]), (256, 256))
    places = register_tiles(grid, tiles.__getitem__, search=30.0, distortion=0.0).adjustment.places
    np.testing.assert_allclose(places[1] - places[0], (215.0, 3.0), atol=0.3)
