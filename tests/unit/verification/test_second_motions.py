"""Of two motions in the same images, which is that of the plane?"""

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from threading import Barrier
from time import sleep

import numpy as np
import pytest

from examples.worlds.correspondences import stored
from rdstitch.arrays import FloatArray
from rdstitch.geometry.camera import Camera
from rdstitch.geometry.radial_homography import RadialHomography
from rdstitch.inputs.source import Source
from rdstitch.io.metadata import Metadata
from rdstitch.io.read import DecodedImage
from rdstitch.matching.two_view import PairRegistration
from rdstitch.results.registration import Registration
from rdstitch.synthetic.textures import ground
from rdstitch.verification import second_motions
from rdstitch.verification.overlap_check import ComparedImages
from rdstitch.verification.photometric_agreement import Agreement, ComparedImage, Grey, overlap_agreement
from rdstitch.verification.second_motions import bottleneck_fraction, max_plane_fraction, planes_of_pairs
from tests.registrations import registration, source

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
    matrix = np.eye(3)
    matrix[0, 2] = -pixels / LENS.scale
    return matrix


def _registered(
    monkeypatch: pytest.MonkeyPatch, images: list[Grey], places: list[float], pairs: Sequence[PairRegistration] = ()
) -> Registration:
    """Images put at these places along the plane, pixels."""

    def placed(_: object, k: int, camera: Camera, homography: FloatArray) -> ComparedImage:
        return ComparedImage(np.ascontiguousarray(images[k], dtype=np.float32), camera, homography)

    monkeypatch.setattr(ComparedImages, "placed", placed)
    homographies = np.stack([_shift(-place) for place in places])
    return registration(len(images), pairs, cameras=(LENS,) * len(places), homographies=homographies)


def _pair(first: int, second: int, on_plane: int, ahead: int) -> PairRegistration:
    """So many matches on the plane, and so many on what drives ahead; registered by the more."""
    rng = np.random.default_rng(first)
    plane = rng.uniform((STEP + 5, 5), (230, 295), (on_plane, 2))
    other = rng.uniform((290, 5), (395, 295), (ahead, 2))
    matched = stored(np.concatenate([plane, other]), np.concatenate([plane - (STEP, 0.0), other - (SWAY, 0.0)]))
    by_plane = on_plane > ahead
    inliers = (np.arange(on_plane + ahead) < on_plane) == by_plane
    relation = RadialHomography(_shift(STEP if by_plane else SWAY), LENS, LENS, inliers)
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


def test_pairs_are_compared_by_threads_and_each_image_is_read_once(monkeypatch: pytest.MonkeyPatch) -> None:
    together, reads = Barrier(2), list[str]()

    def compared(first: ComparedImage, second: ComparedImage) -> Agreement:
        together.wait(10.0)
        return overlap_agreement(first, second)

    def read(own: Source, *_: object, **__: object) -> DecodedImage:
        reads.append(own.name)
        sleep(0.02)
        return DecodedImage(np.zeros(SIZE[::-1], np.uint8), None, Metadata(SIZE))

    monkeypatch.setattr(Source, "read", read)
    images = ComparedImages([source("a.png"), source("b.png")], None, 8)
    with ThreadPoolExecutor(8) as pool:
        list(pool.map(lambda k: images.placed(k % 2, LENS, np.eye(3)), range(16)))
    assert sorted(reads) == ["a.png", "b.png"]
    monkeypatch.setattr(second_motions, "overlap_agreement", compared)
    pairs = (_pair(0, 1, 40, 60), _pair(1, 2, 40, 25))
    assert planes_of_pairs(_registered(monkeypatch, _images(0.35, 3), [0, 0, 0], pairs), 3.0, threads=2) is not None


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
    cells = Agreement(10, 0, 40, 0.4)
    assert max_plane_fraction([cells]) == pytest.approx(1.0 - 6 / 40)
    assert max_plane_fraction([cells, cells]) == max_plane_fraction([cells])
    assert max_plane_fraction([Agreement(10, 0, 40)]) == max_plane_fraction([]) == 1.0


def test_pairs_that_are_less_sure_than_those_that_hold_the_images_together_are_not_needed() -> None:
    fills = {(0, 1): 0.9, (1, 2): 0.8, (0, 2): 0.51, (2, 3): 0.7, (0, 3): 0.6, (7, 8): 0.75}
    assert bottleneck_fraction(fills) == 0.7
    assert bottleneck_fraction({(0, 1): 0.6}) == 0.6
    assert bottleneck_fraction({}) == np.inf
