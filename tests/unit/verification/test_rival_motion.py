"""A motion other than the plane's: how it is found, and what is said of it, by the area that it covers."""

import math
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from rdstitch.arrays import FloatArray
from rdstitch.camera import Camera
from rdstitch.radial_homography import RadialHomography
from rdstitch.verification.competing_motions import Contest
from rdstitch.verification.photometric_agreement import Agreement
from rdstitch.verification.rival_motion import (
    RivalMotion,
    find_rival_motions,
    is_apart,
    rival_messages,
    rival_share,
)

PATHS = ("folder/a.png", "folder/b.png")


def _rival(area: int, plane: int) -> RivalMotion:
    return RivalMotion(0, 1, area, plane, (30.0, 40.0), 120.0)


@pytest.mark.parametrize(
    ("area", "agreement", "severity"),
    [
        (9, 0.9, None),
        (9, 0.2, None),
        (11, 0.9, "warning"),
        (11, math.nan, "warning"),
        (11, 0.39, "failure"),
        (44, 0.41, "warning"),
        (46, 0.54, "failure"),
        (46, math.nan, "failure"),
        (46, 0.56, "warning"),  # more than half of what is shared looks alike, whatever has more matches
    ],
)
def test_area_and_agreement_decide(area: int, agreement: float, severity: str | None) -> None:
    messages = rival_messages(PATHS, [_rival(area, 100 - area)], agreement)
    assert [message.severity for message in messages] == ([] if severity is None else [severity])


@pytest.mark.parametrize(
    ("area", "agreement", "fills", "rival", "severity"),
    [
        (46, 0.2, 0.7, 0.3, "warning"),  # it holds wherever the rival does not, which is the smaller one
        (46, 0.2, 0.7, 0.6, "failure"),
        (46, 0.6, 0.7, 0.6, "warning"),
        (20, 0.6, 0.4, 0.3, "failure"),  # most of the images contradict it, however much of the overlaps looks alike
        (5, 0.45, 0.4, 1.0, "failure"),
    ],
)
def test_what_fills_less_than_half_of_the_images_fails(
    area: int, agreement: float, fills: float, rival: float, severity: str
) -> None:
    compared = Contest(fills, rival, {(0, 1): Agreement(100, 90)}, frozenset())
    (message,) = rival_messages(PATHS, [_rival(area, 100 - area)], agreement, compared)
    assert message.severity == severity


def test_the_place_is_named() -> None:
    (message,) = rival_messages(PATHS, [_rival(10, 90), _rival(30, 70)], 0.8)
    assert message.images == PATHS
    for part in ("20%", "(30, 40) of a.png", "b.png", "120 pixels"):
        assert part in message.text


@pytest.mark.parametrize(("area", "off", "apart"), [(9, 90.0, False), (20, 51.0, True), (20, 49.0, False)])
def test_tree_tops_are_not_apart(area: int, off: float, apart: bool) -> None:
    """A twentieth of the diagonal of an image."""
    relation = RadialHomography(np.eye(3), LENS, LENS, np.ones(20, dtype=np.bool_))
    rival = replace(_rival(area, 100 - area), disagreement=off, relation=relation)
    assert is_apart([rival, _rival(1, 0)]) is apart


def test_a_rival_does_not_spoil_the_lens() -> None:
    (message,) = rival_messages(PATHS, [_rival(60, 40)], 0.1, lens_only=True)
    assert message.severity == "warning"


def test_the_share_is_of_all_pairs_together() -> None:
    assert rival_share([_rival(0, 60), _rival(30, 10)]) == 0.3
    assert rival_share([]) == 0.0


LENS = Camera((800, 600))
MOVED = np.array([60.0, 20.0])


def _found(
    points: FloatArray, other: FloatArray, *, rival: FloatArray | None = None, used: bool = True
) -> list[RivalMotion]:
    """Of two images whose plane moves by :data:`MOVED`; matches at ``other`` move by that and ``rival``."""

    def transfer(i: int, j: int, points: FloatArray) -> FloatArray:
        return np.asarray(points + MOVED)

    off = np.array([40.0, -30.0]) if rival is None else rival
    points1 = np.concatenate([points, other])
    points2 = np.concatenate([points + MOVED, other + MOVED + off])
    alignment: Any = SimpleNamespace(cameras=[LENS] * 2, used=np.array([True, used]), transfer=transfer)
    matched = SimpleNamespace(points1=points1, points2=points2, ratio=np.full(len(points1), 0.5))
    pair: Any = SimpleNamespace(image1=0, image2=1, correspondences=matched)
    return find_rival_motions(alignment, [pair], 3.0)


def _grid(left: float, top: float, columns: int, rows: int, step: float = 50.0) -> FloatArray:
    """Points in the middle of as many cells of 50 pixels."""
    x, y = np.meshgrid(np.arange(columns), np.arange(rows))
    return np.asarray(np.stack([left + step * (x.ravel() + 0.5), top + step * (y.ravel() + 0.5)], axis=1))


def test_a_second_motion_is_found_with_its_place_and_area() -> None:
    (found,) = _found(_grid(0, 0, 16, 6), _grid(200, 350, 5, 4))
    assert (found.area, found.plane_area) == (20, 96)
    assert found.share == pytest.approx(20 / 116)
    assert found.center == pytest.approx((325.0, 450.0))
    assert found.disagreement == pytest.approx(50.0, abs=0.1)


def test_area_that_the_plane_covers_too_does_not_count() -> None:
    (found,) = _found(_grid(0, 0, 16, 10), _grid(200, 350, 5, 4) + 5.0)
    assert (found.area, found.plane_area) == (5, 160)


@pytest.mark.parametrize(("size", "area"), [(0.018, 0), (0.022, 20)])
def test_what_relief_does_is_no_motion(size: float, area: int) -> None:
    """Up to two hundredths of the diagonal."""
    (found,) = _found(_grid(0, 0, 16, 6), _grid(200, 350, 5, 4), rival=size * 1000.0 * np.array([0.6, 0.8]))
    assert found.area == area


def test_a_few_wrong_matches_are_no_motion() -> None:
    assert _found(_grid(0, 0, 16, 6), _grid(200, 350, 11, 1))[0].area == 0
    wrong = np.random.default_rng(0).uniform(-300.0, 300.0, (40, 2))
    assert _found(_grid(0, 0, 16, 6), _grid(0, 350, 10, 4), rival=wrong)[0].area == 0


def test_images_that_are_not_used_or_do_not_agree_anywhere_are_left_alone() -> None:
    assert _found(_grid(0, 0, 16, 6), _grid(200, 350, 5, 4), used=False) == []
    assert _found(_grid(0, 0, 0, 0), _grid(200, 350, 5, 4)) == []
