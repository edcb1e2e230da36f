"""How the overlap of two tiles is found: evidence, displacements to a part of a pixel, and the choice of a place."""

from weakref import WeakSet

import numpy as np
import pytest
from numpy.typing import NDArray

from rdstitch.arrays import FloatArray
from rdstitch.stage import SearchPlan
from rdstitch.stage.choose_places import choose_places
from rdstitch.stage.coarse_tile import coarse_tile
from rdstitch.stage.evidence import ANYWHERE, HUNDRED_TO_ONE, WRONG_PEAK, log_evidence
from rdstitch.stage.grid import TileGrid
from rdstitch.stage.overlap import Overlap
from rdstitch.stage.pair_candidates import Candidates, in_pairs
from rdstitch.stage.phase_correlation import correlate
from rdstitch.stage.refinement import refine

Image = NDArray[np.float32]
SHIFT = np.array([100.0, 3.0])  # of the second tile in the first


def _tiles(seed: int, shift: FloatArray = SHIFT, noise: float = 0.02) -> tuple[Image, Image]:
    """Two tiles of 160 x 120 pixels of one ground, by spectra: shifts by parts of a pixel are exact."""
    rng = np.random.default_rng(seed)
    v, u = np.fft.fftfreq(256)[:, None], np.fft.fftfreq(384)
    spectrum = np.fft.fft2(rng.normal(size=(256, 384))) * np.exp(-2.0 * (2.0 * np.pi) ** 2 * (u**2 + v**2))
    spectrum *= 256 * 384 / np.linalg.norm(spectrum)
    moved = spectrum * np.exp(2j * np.pi * (u * shift[0] + v * shift[1]))
    ground, moved = (np.fft.ifft2(one).real for one in (spectrum, moved))
    first, second = (part[40:160, 40:200] + rng.normal(0.0, noise, (120, 160)) for part in (ground, moved))
    return first.astype(np.float32), second.astype(np.float32)


def _overlap(shift: FloatArray = SHIFT) -> Overlap:
    return Overlap.expected(shift, np.array([[160, 120]] * 2), 5)


def test_the_correlation_is_highest_at_the_displacement_and_evidence_is_for_it_alone() -> None:
    tiles = _tiles(1)
    expected = _overlap(SHIFT + np.array([5.0, -4.0]))
    total = correlate(*tiles, expected, 10).total(np.zeros((len(expected.blocks), 2)), 10)
    assert divmod(int(total.argmax()), 21) == (10 + 4, 10 - 5)  # row and column
    coarse = [coarse_tile(tile, 1) for tile in tiles]
    assert log_evidence(coarse, _overlap(), SHIFT) > 10.0
    assert log_evidence(coarse, _overlap(), SHIFT + np.array([9.0, 0.0])) < WRONG_PEAK
    assert log_evidence([coarse[0], coarse_tile(_tiles(2)[1], 1)], _overlap(), SHIFT) < WRONG_PEAK


def test_displacements_are_found_as_exactly_as_is_said() -> None:
    white = []
    for seed in range(8):
        true = SHIFT + np.random.default_rng(seed).uniform(-0.5, 0.5, 2)
        found = refine(*_tiles(seed, true, noise=0.2), _overlap().whole, lambda points: points - SHIFT, 3.0)
        error = (found.points1 - found.points2 - true)[0]
        assert np.abs(error).max() < 0.1
        white.append(float(error @ found.information[0] @ error) / 2.0)
    assert 0.2 < np.mean(white) < 3.0


def test_of_tiles_in_any_order_about_two_rows_are_held() -> None:
    class Tile:
        pass

    places = 100.0 * np.stack(np.meshgrid(np.arange(15), np.arange(12)), axis=-1).reshape(-1, 2)
    shuffled, held = np.random.default_rng(0).permutation(places), WeakSet[Tile]()

    def read(_: int) -> Tile:
        held.add(tile := Tile())
        return tile

    pairs = TileGrid(shuffled, (120, 120)).neighbours(5.0)
    assert len(pairs) == 14 * 12 + 15 * 11
    assert max(len(held) for _ in in_pairs(read, pairs)) <= 2 * 15


@pytest.mark.parametrize("what", ["even", "noise", "too far"])
def test_what_shows_no_displacement_gives_none(what: str) -> None:
    first, second = _tiles(3)
    if what != "too far":
        rng = np.random.default_rng(0)
        first, second = (rng.normal(0.0, float(what == "noise"), (120, 160)).astype(np.float32) for _ in range(2))
    off = SHIFT + (4.0 if what == "too far" else 0.0)
    assert len(refine(first, second, _overlap().whole, lambda points: points - off, 2.0)) == 0


def test_the_stage_decides_between_places_and_a_strong_one_against_the_stage() -> None:
    """Four tiles in a row; the first pair shows its place alone, the second two that are alike, the third nothing."""
    places = np.array([[100.0 * k, 0.0] for k in range(4)])
    plan, pairs = SearchPlan.of(TileGrid(places, (120, 120)), 9.0), np.array([(0, 1), (1, 2), (2, 3)])
    right, wrong = np.array([100.0, 1.0]), np.array([100.0, 60.0])

    def chosen(*candidates: tuple[list[FloatArray], list[float]]) -> dict[int, list[float]]:
        found = [Candidates(np.array(at).reshape(-1, 2), np.array(nats), 2.0) for at, nats in candidates]
        return {number: at.tolist() for number, at in choose_places(pairs, found, plan, 0.0).items()}

    sure, nothing = ([right], [9.0]), (list[FloatArray](), list[float]())
    assert chosen(sure, ([wrong, right], [9.0, 9.0]), nothing) == {0: right.tolist(), 1: right.tolist()}
    strong = 9.0 - ANYWHERE + 2.0 * HUNDRED_TO_ONE + np.log(120.0**2)
    assert chosen(sure, ([wrong, right], [strong, 9.0]), nothing)[1] == wrong.tolist()
    assert chosen(([right, right + 6.0], [9.0, 9.0]), nothing, nothing) == {}
