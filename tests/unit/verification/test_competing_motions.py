"""Which of two motions in the same images is the plane's, by what contradicts each."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from rdstitch.arrays import FloatArray
from rdstitch.camera import Camera
from rdstitch.matching.two_view import PairRegistration
from rdstitch.radial_homography import RadialHomography
from rdstitch.synthetic.textures import ground
from rdstitch.verification import competing_motions
from rdstitch.verification.competing_motions import Cells, Contest, _Held, contest, fills_at_most, planes_of_pairs
from rdstitch.verification.photometric_agreement import Agreement, ComparedImage, Grey

SIZE = (400, 300)
LENS = Camera(SIZE)
PLANE = ground((1000, 400), seed=3, channels=1).region(0, 0, 1000, 400)[:, :, 0]
AHEAD = ground((500, 400), seed=4, channels=1).region(0, 0, 500, 400)[:, :, 0]
STEP, SWAY = 160, 20
"""Pixels that the plane, and what drives ahead, moves by from image to image."""


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
    """As a homography from image 1 to image 2."""
    matrix = np.eye(3)
    matrix[0, 2] = -pixels / LENS.half_diagonal
    return matrix


def _moving(pixels: float, inliers: Any = ()) -> RadialHomography:
    return RadialHomography(_shift(pixels), LENS, LENS, np.asarray(inliers, dtype=np.bool_))


def _registration(monkeypatch: pytest.MonkeyPatch, images: list[Grey], places: list[float], pairs: Any = ()) -> Any:
    """Images put at these places along the plane, pixels."""

    def placed(source: int, camera: Camera, homography: FloatArray, stretch: object) -> ComparedImage:
        return ComparedImage(np.ascontiguousarray(images[source], dtype=np.float32), camera, homography)

    monkeypatch.setattr(competing_motions, "placed_image", placed)
    homographies = np.stack([_shift(-place) for place in places])
    alignment = SimpleNamespace(
        cameras=[LENS] * len(places), homographies=homographies, distortion=0.0, distortion_std=0.0
    )
    return SimpleNamespace(sources=range(len(images)), alignment=alignment, stretch=None, pairs=pairs)


@pytest.mark.parametrize("covered", [0.2, 0.35])
def test_what_fills_less_than_half_is_not_the_plane(monkeypatch: pytest.MonkeyPatch, covered: float) -> None:
    images = _images(covered)
    right = _registration(monkeypatch, images, [0, STEP])
    found = contest(right, [(0, 1)], {(0, 1): _moving(SWAY)})
    assert (found.won, found.lost, found.doubtful) == (True, False, frozenset())
    assert found.rival_fills_at_most == pytest.approx(covered, abs=0.08)
    assert found.held > 0.8
    wrong = contest(_registration(monkeypatch, images, [0, SWAY]), [(0, 1)], {(0, 1): _moving(STEP)})
    assert (wrong.won, wrong.lost, wrong.doubtful) == (False, True, frozenset({(0, 1)}))


def test_what_covers_most_of_the_images_is_the_plane(monkeypatch: pytest.MonkeyPatch) -> None:
    """However little it moves; what it leaves free is an arm of the robot, say."""
    images = _images(0.6)
    assert not contest(_registration(monkeypatch, images, [0, STEP]), [(0, 1)], {(0, 1): _moving(SWAY)}).won
    assert contest(_registration(monkeypatch, images, [0, SWAY]), [(0, 1)], {(0, 1): _moving(STEP)}).won


def test_a_pair_held_by_what_drives_ahead_is_found_by_its_neighbours(monkeypatch: pytest.MonkeyPatch) -> None:
    """Put beside each other so that they overlap little, the two are not seen to contradict each other much."""
    images = _images(0.4, 3)
    images[2] = images[2].copy()
    edge = round(0.6 * SIZE[0])
    images[2][:, edge:] = AHEAD[: SIZE[1], 100 : 100 + SIZE[0]][:, edge:]
    registration = _registration(monkeypatch, images, [0, STEP, STEP + 80])
    rivals = {(0, 1): _moving(SWAY)}
    assert (1, 2) in contest(registration, [(0, 1), (1, 2)], rivals).doubtful
    # The same at its right place.
    registration = _registration(monkeypatch, images, [0, STEP, 2 * STEP])
    assert contest(registration, [(0, 1), (1, 2)], rivals).doubtful == frozenset()


class _Matched:
    """Matches; also as they lie on disk."""

    def __init__(self, points1: FloatArray, points2: FloatArray) -> None:
        self.points1, self.points2, self.ratio = points1, points2, np.full(len(points1), 0.5)

    def __len__(self) -> int:
        return len(self.points1)

    def load(self) -> "_Matched":
        return self

    def take(self, chosen: Any) -> "_Matched":
        return _Matched(self.points1[chosen], self.points2[chosen])


def _pair(first: int, second: int, on_plane: int, ahead: int) -> PairRegistration:
    """So many matches on the plane, and so many on what drives ahead; registered by the more."""
    rng = np.random.default_rng(first)
    plane = rng.uniform((STEP + 5, 5), (230, 295), (on_plane, 2))
    other = rng.uniform((290, 5), (395, 295), (ahead, 2))
    matched: Any = _Matched(np.concatenate([plane, other]), np.concatenate([plane - (STEP, 0.0), other - (SWAY, 0.0)]))
    by_plane = on_plane > ahead
    relation = _moving(STEP if by_plane else SWAY, (np.arange(on_plane + ahead) < on_plane) == by_plane)
    return PairRegistration(first, second, matched, relation)


def test_every_pair_is_moved_as_its_plane_does(monkeypatch: pytest.MonkeyPatch) -> None:
    """In one of them what drives ahead has most matches, in the other the plane has."""
    pairs = (_pair(0, 1, 40, 60), _pair(1, 2, 40, 25))
    found = planes_of_pairs(_registration(monkeypatch, _images(0.35, 3), [0, 0, 0], pairs), 3.0)
    assert found is not None
    for pair in found:
        assert pair.relation.inliers.tolist() == (np.arange(len(pair.matches)) < 40).tolist()
        moved = pair.relation.transfer([[200.0, 150.0]])
        np.testing.assert_allclose(moved, [[200.0 - STEP, 150.0]], atol=0.5)


def test_a_pair_with_nothing_but_what_drives_ahead_is_no_pair(monkeypatch: pytest.MonkeyPatch) -> None:
    found = planes_of_pairs(_registration(monkeypatch, _images(0.35), [0, 0], (_pair(0, 1, 0, 60),)), 3.0)
    assert found is not None
    assert not found[0].relation
    assert "less than half" in found[0].relation.reason


def test_where_all_pairs_show_a_plane_there_is_nothing_to_choose(monkeypatch: pytest.MonkeyPatch) -> None:
    pairs = (_pair(0, 1, 40, 0),)
    assert planes_of_pairs(_registration(monkeypatch, _images(0.0), [0, STEP], pairs), 3.0) is None
    assert planes_of_pairs(_registration(monkeypatch, _images(0.0), [0, STEP]), 3.0) is None


def test_what_is_not_seen_speaks_against_nothing() -> None:
    cells = Cells(np.zeros((10, 2)), np.arange(10) < 4, 40, np.zeros((10, 2)))
    assert fills_at_most([cells]) == pytest.approx(1.0 - 6 / 40)
    assert fills_at_most([cells, cells]) == fills_at_most([cells])
    assert fills_at_most([]) == 1.0


def test_two_of_the_five_cells_around_a_place_hold_it() -> None:
    places = np.array([[0.0, 0.0], [20.0, 0.0], [0.0, 20.0], [20.0, 20.0], [40.0, 0.0], [400.0, 0.0]])
    away = places + 1000.0
    tried = np.array([[10.0, 10.0]])
    for holding, outside in ((2, 0), (1, 1)):
        held = _Held([((0, 1), Cells(away, np.arange(6) < holding, 6, places))])
        cells = Cells(tried, np.array([True]), 1, tried)
        assert held.outside((0, 2), cells) == Agreement(outside, outside)
        assert held.outside((3, 2), cells) == Agreement(1, 1)  # images that nothing is known of
    far = Cells(tried + 300.0, np.array([True]), 1, tried + 300.0)
    assert held.outside((0, 1), far) == Agreement(1, 1)


@pytest.mark.parametrize(
    ("fills", "rival", "agreement", "won", "lost"),
    [
        (0.6, 0.4, Agreement(100, 40), True, False),
        (0.6, 0.4, Agreement(100, 25), False, False),
        (0.6, 0.55, Agreement(100, 90), False, False),
        (0.45, 0.4, Agreement(100, 90), False, True),
    ],
)
def test_the_plane_holds_and_its_rival_fills_little(
    fills: float, rival: float, agreement: Agreement, won: bool, lost: bool
) -> None:
    found = Contest(fills, rival, {(0, 1): agreement}, frozenset())
    assert (found.won, found.lost) == (won, lost)
