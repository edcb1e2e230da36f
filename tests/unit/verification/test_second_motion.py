"""Which of two motions in the same images is the plane's, by what contradicts each."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from examples.worlds.correspondences import stored
from rdstitch.alignment.result import LinkFit
from rdstitch.arrays import FloatArray
from rdstitch.geometry.camera import Camera
from rdstitch.geometry.radial_homography import RadialHomography
from rdstitch.matching.two_view import PairRegistration
from rdstitch.results.registration import Registration
from rdstitch.synthetic.textures import ground
from rdstitch.verification.overlap_check import CheckedLink, ComparedImages
from rdstitch.verification.photometric_agreement import Agreement, ComparedImage, Grey, overlap_agreement
from rdstitch.verification.second_motion import (
    SecondMotion,
    explains,
    fills_at_most,
    find_second_motions,
    is_clear,
    planes_of_pairs,
    share_of,
)
from rdstitch.verification.self_similarity import Ambiguity
from tests.registrations import registration

SIZE = (400, 300)
LENS = Camera(SIZE)
PLANE = ground((1000, 400), seed=3, channels=1).region(0, 0, 1000, 400)[:, :, 0]
AHEAD = ground((500, 400), seed=4, channels=1).region(0, 0, 500, 400)[:, :, 0]
STEP, SWAY = 160, 20
"""Pixels that the plane, and what drives ahead, moves by from image to image."""


def _link(first: int, second: int, shift: float = 0.0) -> CheckedLink:
    return CheckedLink(LinkFit(first, second, 100, 90, 0.5, True), Agreement(100, 20), Ambiguity(0.4, 0.6, shift))


def _images(covered: float, count: int = 2) -> list[Grey]:
    """Images of a plane; what drives ahead covers a part of each, from the right."""
    edge = round(SIZE[0] * (1.0 - covered))
    result = []
    for k in range(count):
        pixels = PLANE[: SIZE[1], STEP * k : STEP * k + SIZE[0]].copy()
        pixels[:, edge:] = AHEAD[: SIZE[1], SWAY * k : SWAY * k + SIZE[0]][:, edge:]
        result.append(pixels)
    return result


def _shift(pixels: float) -> FloatArray:
    matrix = np.eye(3)
    matrix[0, 2] = -pixels / LENS.scale
    return matrix


def _moving(pixels: float, inliers: Any = ()) -> RadialHomography:
    return RadialHomography(_shift(pixels), LENS, LENS, np.asarray(inliers, dtype=np.bool_))


def _registered(
    monkeypatch: pytest.MonkeyPatch, images: list[Grey], places: list[float], pairs: Sequence[PairRegistration] = ()
) -> Registration:
    """Images put at these places along the plane, pixels."""

    def placed(_: object, k: int, camera: Camera, homography: FloatArray) -> ComparedImage:
        return ComparedImage(np.ascontiguousarray(images[k], dtype=np.float32), camera, homography)

    monkeypatch.setattr(ComparedImages, "placed", placed)
    homographies = np.stack([_shift(-place) for place in places])
    return registration(len(images), pairs, cameras=(LENS,) * len(places), homographies=homographies)


def _clear(given: Registration, motion: RadialHomography) -> bool:
    """Where two images were put, and something else moves."""
    second = [SecondMotion((0, 1), 20, 80, disagreement=120.0, relation=motion)]
    read, alignment = ComparedImages(given.sources, None), given.alignment
    first, last = (read.placed(k, alignment.cameras[k], alignment.homographies[k]) for k in (0, 1))
    return is_clear(read, second, [replace(_link(0, 1), agreement=overlap_agreement(first, last))])


@pytest.mark.parametrize("covered", [0.2, 0.35])
def test_what_fills_less_than_half_is_not_the_plane(monkeypatch: pytest.MonkeyPatch, covered: float) -> None:
    images = _images(covered)
    assert _clear(_registered(monkeypatch, images, [0, STEP]), _moving(SWAY))
    assert not _clear(_registered(monkeypatch, images, [0, SWAY]), _moving(STEP))


def test_what_covers_most_of_the_images_is_the_plane(monkeypatch: pytest.MonkeyPatch) -> None:
    """However little it moves; what it leaves free is an arm of the robot, say."""
    images = _images(0.6)
    assert not _clear(_registered(monkeypatch, images, [0, STEP]), _moving(SWAY))
    assert _clear(_registered(monkeypatch, images, [0, SWAY]), _moving(STEP))


def _pair(first: int, second: int, on_plane: int, ahead: int) -> PairRegistration:
    """So many matches on the plane, and so many on what drives ahead; registered by the more."""
    rng = np.random.default_rng(first)
    plane = rng.uniform((STEP + 5, 5), (230, 295), (on_plane, 2))
    other = rng.uniform((290, 5), (395, 295), (ahead, 2))
    matched = stored(np.concatenate([plane, other]), np.concatenate([plane - (STEP, 0.0), other - (SWAY, 0.0)]))
    by_plane = on_plane > ahead
    relation = _moving(STEP if by_plane else SWAY, (np.arange(on_plane + ahead) < on_plane) == by_plane)
    return PairRegistration(first, second, matched, relation)


def test_every_pair_is_moved_as_its_plane_does(monkeypatch: pytest.MonkeyPatch) -> None:
    """In one of them what drives ahead has most matches, in the other the plane has."""
    pairs = (_pair(0, 1, 40, 60), _pair(1, 2, 40, 25))
    found = planes_of_pairs(_registered(monkeypatch, _images(0.35, 3), [0, 0, 0], pairs), 3.0)
    assert found is not None
    for pair in found:
        assert pair.relation.inliers.tolist() == (np.arange(len(pair.matches)) < 40).tolist()
        moved = pair.relation.transfer([[200.0, 150.0]])
        np.testing.assert_allclose(moved, [[200.0 - STEP, 150.0]], atol=0.5)


def test_what_drives_ahead_says_nothing_of_the_lens(monkeypatch: pytest.MonkeyPatch) -> None:
    """It hardly moves, so that λ = 0 explains it; the plane behind it shows the lens."""
    lens = Camera(SIZE, distortion=-0.03)
    pairs = []
    for first in range(2):
        pair = _pair(first, first + 1, 60, 90)
        matched = pair.correspondences  # which stay in memory
        matched.points2[:60] = lens.distort(lens.undistort(matched.points1[:60]) - (STEP, 0.0))
        pairs.append(pair)
    found = planes_of_pairs(_registered(monkeypatch, _images(0.35, 3), [0, 0, 0], tuple(pairs)), 3.0)
    assert found is not None
    for pair in found:
        assert pair.relation.distortion == pytest.approx(-0.03, abs=0.005)
        assert pair.relation.inliers[:60].all()


def test_a_pair_with_nothing_but_what_drives_ahead_is_no_pair(monkeypatch: pytest.MonkeyPatch) -> None:
    found = planes_of_pairs(_registered(monkeypatch, _images(0.35), [0, 0], (_pair(0, 1, 0, 60),)), 3.0)
    assert not found[0].relation
    assert "less than half" in found[0].relation.reason


def test_where_all_pairs_show_a_plane_there_is_nothing_to_choose(monkeypatch: pytest.MonkeyPatch) -> None:
    pairs = (_pair(0, 1, 40, 0),)
    assert planes_of_pairs(_registered(monkeypatch, _images(0.0), [0, STEP], pairs), 3.0) is None
    assert planes_of_pairs(_registered(monkeypatch, _images(0.0), [0, STEP]), 3.0) is None


def test_what_is_not_seen_speaks_against_nothing() -> None:
    cells = Agreement(10, 4, 40)
    assert fills_at_most([cells]) == pytest.approx(1.0 - 6 / 40)
    assert fills_at_most([cells, cells]) == fills_at_most([cells])
    assert fills_at_most([]) == 1.0


@pytest.mark.parametrize(
    ("covered", "moves", "explained"), [(0.35, 180.0, True), (0.35, 120.0, False), (0.6, 180.0, False)]
)
def test_what_fits_where_something_smaller_moved_is_no_pattern(
    monkeypatch: pytest.MonkeyPatch, covered: float, moves: float, explained: bool
) -> None:
    """Within a twentieth of an image; a pattern fills all of it."""
    given = _registered(monkeypatch, _images(covered), [0, STEP])
    motion = SecondMotion((0, 1), 40, 60, (30.0, 40.0), moves, _moving(SWAY))
    assert explains(ComparedImages(given.sources, None), motion, _link(0, 1, 0.45)) is explained


WIDE = Camera((800, 600))
MOVED = np.array([60.0, 20.0])


def _found(
    points: FloatArray, other: FloatArray, *, second: FloatArray | None = None, used: bool = True
) -> list[SecondMotion]:
    """Of two images whose plane moves by :data:`MOVED`; matches at ``other`` move by that and ``second``."""
    off = np.array([40.0, -30.0]) if second is None else second
    points1 = np.concatenate([points, other])
    points2 = np.concatenate([points + MOVED, other + MOVED + off])
    moved = np.eye(3)
    moved[:2, 2] = -MOVED / WIDE.scale
    given = registration(2, cameras=(WIDE,) * 2, used=np.array([True, used]), homographies=np.stack([np.eye(3), moved]))
    pair = PairRegistration(0, 1, stored(points1, points2), _moving(0.0))
    return find_second_motions(given.alignment, [pair], 3.0)


def _grid(left: float, top: float, columns: int, rows: int, step: float = 50.0) -> FloatArray:
    """Points in the middle of as many cells of 50 pixels."""
    x, y = np.meshgrid(np.arange(columns), np.arange(rows))
    return np.asarray(np.stack([left + step * (x.ravel() + 0.5), top + step * (y.ravel() + 0.5)], axis=1))


def test_a_second_motion_is_found_with_its_place_and_area() -> None:
    (found,) = _found(_grid(0, 0, 16, 6), _grid(200, 350, 5, 4))
    assert (found.area, found.plane_area) == (20, 96)
    assert share_of([found]) == pytest.approx(20 / 116)
    # The share is of all pairs together.
    assert share_of([SecondMotion((0, 1), 0, 60), SecondMotion((1, 2), 30, 10)]) == 0.3
    assert share_of([]) == 0.0
    assert found.center == pytest.approx((325.0, 450.0))
    assert found.disagreement == pytest.approx(50.0, abs=0.1)


def test_area_that_the_plane_covers_too_does_not_count() -> None:
    (found,) = _found(_grid(0, 0, 16, 10), _grid(200, 350, 5, 4) + 5.0)
    assert (found.area, found.plane_area) == (5, 160)


@pytest.mark.parametrize(("size", "area"), [(0.018, 0), (0.022, 20)])
def test_what_relief_does_is_no_motion(size: float, area: int) -> None:
    """Up to two hundredths of the diagonal."""
    (found,) = _found(_grid(0, 0, 16, 6), _grid(200, 350, 5, 4), second=size * 1000.0 * np.array([0.6, 0.8]))
    assert found.area == area


def test_a_few_wrong_matches_are_no_motion() -> None:
    assert _found(_grid(0, 0, 16, 6), _grid(200, 350, 11, 1))[0].area == 0
    wrong = np.random.default_rng(0).uniform(-300.0, 300.0, (40, 2))
    assert _found(_grid(0, 0, 16, 6), _grid(0, 350, 10, 4), second=wrong)[0].area == 0


def test_images_that_are_not_used_or_do_not_agree_anywhere_are_left_alone() -> None:
    assert _found(_grid(0, 0, 16, 6), _grid(200, 350, 5, 4), used=False) == []
    assert _found(_grid(0, 0, 0, 0), _grid(200, 350, 5, 4)) == []
