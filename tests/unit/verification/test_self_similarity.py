"""Whether images could agree at other places too, and what is unique in them."""

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rdstitch.alignment.result import LinkFit
from rdstitch.geometry.camera import Camera
from rdstitch.inputs.frame import Frame
from rdstitch.inputs.source import Source
from rdstitch.io.metadata import Metadata
from rdstitch.io.read import DecodedImage
from rdstitch.synthetic.textures import ground
from rdstitch.verification import overlap_check
from rdstitch.verification.photometric_agreement import ComparedImage
from rdstitch.verification.self_similarity import (
    Ambiguity,
    _between_pixels,
    draw,
    drawing_scale,
    find_ambiguity,
    placement_ambiguity,
)
from rdstitch.verification.unique_places import UniqueShift, departures, unique_shifts
from tests.registrations import registration

SIZE = (256, 192)
LENS = Camera(SIZE)
PLANE = ground((700, 600), seed=5, channels=1).region(0, 0, 700, 600)[:, :, 0]


def _placed(
    plane: np.ndarray, left: int, top: int, *, put: tuple[float, float] = (0.0, 0.0), scale: float = 1.0
) -> ComparedImage:
    matrix = np.diag([scale, scale, 1.0])
    matrix[:2, 2] = scale * (np.array([left, top]) + put) / LENS.scale
    return ComparedImage(np.ascontiguousarray(plane[top : top + 192, left : left + 256], np.float32), LENS, matrix)


def _ambiguity(first: ComparedImage, second: ComparedImage) -> Ambiguity:
    scale = drawing_scale(second.camera, second.homography)
    return placement_ambiguity(draw(first, scale), draw(second, scale))


def test_ground_fits_where_it_is_and_nowhere_else_whatever_its_brightness() -> None:
    lit = PLANE + np.linspace(0.0, 1.0, 700, dtype=np.float32) ** 2
    for plane, most in ((PLANE, 0.45), (lit, 1.0)):
        found = _ambiguity(_placed(PLANE, 100, 100), _placed(plane, 180, 140))
        assert found.here > 0.9
        assert found.elsewhere < most
        assert not found.ambiguous


@pytest.mark.parametrize("scale", [0.01, 1.0, 300.0])
def test_a_repeated_pattern_fits_a_period_away(scale: float) -> None:
    tiles = np.tile(PLANE[:40, :50], (15, 14))
    found = _ambiguity(_placed(tiles, 100, 100, scale=scale), _placed(tiles, 163, 128, scale=scale))
    assert found.here > 0.9
    assert found.elsewhere > 0.9
    assert found.ambiguous
    periods = [math.hypot(50 * i, 40 * j) / 256 for i in range(-2, 3) for j in range(-2, 3)]
    assert min(abs(found.shift - period) for period in periods) < 0.006


@pytest.mark.parametrize("place", [(5.0, 4.0), (5.5, 4.4), (5.2, 4.5)])
def test_a_period_is_no_whole_number_of_pixels(place: tuple[float, float]) -> None:
    """Without what lies between pixels a repeated pattern seemed to leave more elsewhere than here."""
    row, column = np.indices((11, 10)).astype(np.float32)
    peak = np.exp(-((row - place[0]) ** 2 + (column - place[1]) ** 2) / (2.0 * 3.0**2)).astype(np.float32)
    at = np.unravel_index(int(peak.argmax()), peak.shape)
    assert _between_pixels(peak, *at) == pytest.approx(1.0, abs=0.002)


def test_a_registration_may_be_off_by_three_pixels() -> None:
    for off, here in ((2.5, True), (6.0, False)):
        found = _ambiguity(_placed(PLANE, 100, 100, put=(off, 0.0)), _placed(PLANE, 180, 140))
        assert (found.here > 0.8) is here
        assert (found.here < 0.6) is not here
    # A wrong place is ambiguous.
    found = _ambiguity(_placed(PLANE, 100, 100, put=(25.0, 0.0)), _placed(PLANE, 150, 120))
    assert found.ambiguous
    assert found.shift == pytest.approx(25.0 / 256, abs=0.006)


def test_images_that_do_not_touch_say_nothing() -> None:
    assert _ambiguity(_placed(PLANE, 0, 0), _placed(PLANE, 400, 300)) == Ambiguity(0.0, 0.0, 0.0)
    behind = ComparedImage(np.zeros((192, 256), np.float32), LENS, np.diag([1.0, 1.0, -1.0]))
    drawn = draw(behind, 100.0)
    assert drawn.pixels.shape == (1, 1)
    assert np.isnan(drawn.pixels).all()


@pytest.mark.parametrize(
    ("here", "elsewhere", "ambiguous"),
    [
        (0.9, 0.82, True),
        (0.9, 0.80, False),
        (0.3, 0.51, True),
        (0.3, 0.49, False),
        (0.0, 0.0, False),
        (0.99, 0.93, False),  # a mown meadow
        (0.99, 0.985, True),  # tiles
    ],
)
def test_as_good_is_nine_tenths_and_alike_and_leaves_as_little(here: float, elsewhere: float, ambiguous: bool) -> None:
    assert Ambiguity(here, elsewhere, 0.2).ambiguous is ambiguous


PERIOD = (50, 40)
TILES = np.tile(ground((50, 40), seed=5, channels=1).region(0, 0, 50, 40)[:, :, 0], (20, 20)).astype(np.float32)
NOTHING = np.zeros((0, 2), dtype=int)
TWO = np.array([[243, 171], [270, 232]])  # (x, y) of stains, in the overlap of both images


def _image(stains: np.ndarray, left: int, top: int, put: tuple[int, int] = (0, 0), seed: int = 0) -> ComparedImage:
    """A view of stained tiles, with noise of its own, put elsewhere on the plane by so many pixels."""
    plane = TILES.copy()
    for x, y in stains:
        plane[y - 3 : y + 4, x - 3 : x + 4] = 0.05
    clean = plane[top : top + SIZE[1], left : left + SIZE[0]]
    seen = clean + np.random.default_rng(seed).normal(0.0, 0.005, clean.shape)
    matrix = np.eye(3)
    matrix[:2, 2] = (np.array([left, top]) + put) / LENS.scale
    return ComparedImage(seen.astype(np.float32), LENS, matrix)


def _pixels(image: ComparedImage) -> np.ndarray:
    return draw(image, drawing_scale(image.camera, image.homography, SIZE[0]), SIZE[0]).pixels


def test_only_what_is_unique_departs_from_the_pattern() -> None:
    found = departures(_pixels(_image(TWO, 150, 100)))
    for x, y in TWO - (150, 100):
        assert found[y, x] < -10.0
    clean = np.abs(np.nan_to_num(found))
    for x, y in TWO - (150, 100):
        clean[y - 12 : y + 13, x - 12 : x + 13] = 0.0  # and what its brightness takes with it
    assert clean.max() < 5.0


def test_ground_without_a_pattern_has_none() -> None:
    plane = ground(SIZE, seed=5, channels=1).region(0, 0, *SIZE)[:, :, 0].astype(np.float32)
    assert departures(_pixels(ComparedImage(plane, LENS, np.eye(3)))) is None


@pytest.mark.parametrize("periods", [(0, 0), (1, 0), (-1, 1)])
def test_stains_say_by_how_many_periods_an_image_is_off(periods: tuple[int, int]) -> None:
    put = periods[0] * PERIOD[0], periods[1] * PERIOD[1]
    placed = {0: _image(TWO, 150, 100, put), 4: _image(TWO, 213, 128, seed=1)}
    found = unique_shifts(placed, [(0, 4)])[0, 4]
    assert found.shift * LENS.scale == pytest.approx([-put[0], -put[1]], abs=1.0)
    assert found.correlation > 0.9
    assert found.matched_elsewhere < found.matched / 3.0


def test_few_images_of_a_pattern_are_held_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """Three images, of which two may be held: pair by pair the stains are found as well."""
    placed = [_image(TWO, left, top, seed=k) for k, (left, top) in enumerate([(150, 100), (213, 128), (110, 120)])]
    frames = [
        Frame(Path(f"{k}.png"), image=DecodedImage(np.rint(255.0 * each.grey).astype(np.uint8), None, Metadata(SIZE)))
        for k, each in enumerate(placed)
    ]
    links = tuple(LinkFit(i, j, 100, 90, 0.5) for i, j in ((0, 1), (1, 2), (0, 2)))
    given = registration(
        [Source(frame.path, Metadata(SIZE), LENS, frame=frame) for frame in frames],
        cameras=(LENS,) * 3,
        homographies=np.stack([each.homography for each in placed]),
        links=links,
    )
    held: list[int] = []

    def counted(placed: Mapping[int, ComparedImage], *others: Any) -> dict[tuple[int, int], UniqueShift]:
        held.append(len(placed))
        return unique_shifts(placed, *others)

    def unique() -> list[bool]:
        checked = overlap_check.check_overlaps(given, overlap_check.ComparedImages(given.sources, given.stretch))
        assert all(link.ambiguity.ambiguous for link in checked)
        return [link.decided_by_unique_content for link in checked]

    monkeypatch.setattr(overlap_check, "unique_shifts", counted)
    at_once = unique()
    monkeypatch.setattr(overlap_check, "IMAGES_AT_ONCE", 2)
    assert unique() == at_once
    assert held == [3, 2, 2, 2]
    assert sum(at_once) > 1


def test_one_stain_is_enough_none_or_one_in_one_image_is_not_and_dust_on_the_lens_is_no_evidence() -> None:
    dust = np.array([[90, 70], [133, 111]])
    for first, second, count in (
        (_image(TWO[:1], 150, 100, (50, 0)), _image(TWO[:1], 213, 128, seed=1), 1),
        (_image(NOTHING, 150, 100, (50, 0)), _image(NOTHING, 213, 128, seed=1), 0),
        (_image(TWO[:1], 150, 100), _image(TWO[1:], 213, 128, seed=1), 0),
        (_image(np.add(dust, (150, 100)), 150, 100), _image(np.add(dust, (200, 140)), 200, 140, seed=1), 0),
    ):
        assert len(unique_shifts({0: first, 1: second}, [(0, 1)])) == count


@pytest.mark.parametrize("level", [0.0, 0.6, 1.0])
def test_frames_coincide_elsewhere_and_are_no_pattern(level: float) -> None:
    framed = []
    for left, top in ((100, 100), (250, 190)):
        image = _placed(PLANE, left, top)
        grey = (image.grey - PLANE.min()) / np.ptp(PLANE)
        grey[:10], grey[-7:], grey[:, :9] = level, level, level
        framed.append(ComparedImage.of(DecodedImage(grey, None, Metadata(SIZE)), LENS, image.homography))
    assert not find_ambiguity(*framed).ambiguous
    assert np.isnan(framed[0].grey[:, :9]).all()
    assert np.isfinite(framed[0].grey[12:180, 12:240]).all()
