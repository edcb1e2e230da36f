"""Which pairs are looked at: all of a few pictures; of many, those that follow one another or look alike."""

import numpy as np
import pytest

from rdstitch.camera import Camera
from rdstitch.features import Features
from rdstitch.features.keypoints import Descriptors
from rdstitch.matching.candidate_pairs import EXHAUSTIVE_UP_TO, first_pairs, lookalikes, neighbours


def _features(descriptors: Descriptors) -> Features:
    count = len(descriptors)
    ones = np.ones(count)
    places = np.random.default_rng(count).uniform(0.0, 500.0, (count, 2))
    return Features(places, descriptors, ones, np.zeros(count), ones, None, "made up")


def _drive(count: int, binary: bool = False) -> list[Features]:
    """A path that is driven twice: each frame shows a slice of a strip of descriptors, half of it also the next."""
    rng = np.random.default_rng(5)
    strip = rng.normal(size=(count // 2 * 100 + 100, 64)).astype(np.float32)
    if binary:
        strip = rng.integers(0, 256, strip.shape).astype(np.uint8)
    frames = []
    for index in range(count):
        start = 100 * (index % (count // 2))
        seen = strip[start : start + 200][rng.permutation(200)]
        noise = 0.1 * rng.normal(size=seen.shape)
        frames.append(_features(seen if binary else (seen + noise).astype(np.float32)))
    return frames


@pytest.mark.parametrize("binary", [False, True])
def test_frames_of_the_same_place_are_paired_however_far_apart(binary: bool) -> None:
    count = 48
    pairs = set(first_pairs(_drive(count, binary), seed=0))
    again = {(index, index + count // 2) for index in range(count // 2)}
    following = {(index, index + 1) for index in range(count - 1)}
    assert following < pairs
    assert len(again & pairs) >= 0.9 * len(again)


def test_the_number_of_pairs_grows_with_the_number_of_frames_not_with_its_square() -> None:
    few, many = (len(first_pairs(_drive(count), seed=0)) for count in (40, 160))
    assert few < len(first_pairs(_drive(EXHAUSTIVE_UP_TO), seed=0)) * 2
    assert 3.0 < many / few < 5.0


def test_pictures_without_features_look_like_none() -> None:
    nothing = _features(np.zeros((0, 64), dtype=np.float32))
    assert lookalikes([nothing] * 40, seed=1) == set()
    assert len(first_pairs([nothing, *_drive(34)], seed=1)) > 34


@pytest.mark.parametrize(("overlap", "found"), [(0.1, []), (0.2, [(0, 1)]), (0.5, [(0, 1)]), (0.9, [(0, 1)])])
@pytest.mark.parametrize("size", [1.0, 0.4])
def test_pictures_that_overlap_by_a_fifth_are_neighbours(overlap: float, found: list[object], size: float) -> None:
    """Of the smaller footprint: the second picture may have been taken from nearer."""
    lens = Camera((640, 480))
    width, height = 639 / lens.half_diagonal, 479 / lens.half_diagonal
    x = (0.5 - size * (overlap - 0.5)) * width
    shifted = np.array([[size, 0.0, x], [0.0, size, (1 - size) * height / 4], [0.0, 0.0, 1.0]])
    assert neighbours([lens, lens], np.stack([np.eye(3), shifted]), set()) == found
    assert neighbours([lens, lens], np.stack([np.eye(3), shifted]), {(0, 1)}) == []
