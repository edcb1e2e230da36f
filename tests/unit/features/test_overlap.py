"""Where images overlap: as a few matches tell, generously, and not at all where they do not tell."""

import numpy as np
import pytest

from rdstitch.arrays import FloatArray
from rdstitch.features import Correspondences, Features, match, match_overlap
from rdstitch.features.match import overlapping

SIZE = (800, 600)
SHIFT = np.array([560.0, 0.0])  # three tenths of the first image are in the second


def _features(points: FloatArray, descriptors: FloatArray) -> Features:
    ones = np.ones(len(points))
    return Features(points, descriptors.astype(np.float32), ones, 0 * ones, ones, None, "sift", SIZE)


@pytest.fixture(scope="module")
def images() -> tuple[Features, Features]:
    """A strip of the plane, and the same farther to the right."""
    rng = np.random.default_rng(5)
    points = rng.uniform((0, 0), (1360, 600), (3000, 2))
    descriptors = rng.uniform(0, 120, (3000, 128)).round()
    left, right = points[:, 0] < SIZE[0], points[:, 0] >= SHIFT[0]
    return _features(points[left], descriptors[left]), _features(points[right] - SHIFT, descriptors[right])


def _some(found: Correspondences, count: int) -> Correspondences:
    """Every so-manieth match."""
    kept = np.linspace(0, len(found) - 1, count).astype(np.intp)
    return Correspondences(found.indices[kept], found.points1[kept], found.points2[kept], found.ratio[kept])


def _joined(first: Correspondences, second: Correspondences) -> Correspondences:
    return Correspondences(
        np.concatenate([first.indices, second.indices]),
        np.concatenate([first.points1, second.points1]),
        np.concatenate([first.points2, second.points2]),
        np.concatenate([first.ratio, second.ratio]),
    )


def _chance(features1: Features, features2: Features, count: int) -> Correspondences:
    """Matches that mean nothing."""
    rng = np.random.default_rng(1)
    indices = np.column_stack([rng.choice(len(f), count, replace=False) for f in (features1, features2)])
    return Correspondences.of(features1, features2, indices, np.full(count, 0.8))


def test_what_overlaps_is_kept_and_most_of_the_rest_is_not(images: tuple[Features, Features]) -> None:
    everything = match(*images)
    parts = overlapping(*images, _some(everything, 80))
    for side, (part, features) in enumerate(zip(parts, images, strict=True)):
        assert np.isin(everything.indices[:, side], part).all()
        assert len(part) < 0.6 * len(features)


def test_matches_in_the_overlap_are_those_of_the_whole(images: tuple[Features, Features]) -> None:
    everything = match(*images)
    found = match_overlap(match, *images, _some(everything, 80))
    for name in ("indices", "points1", "points2"):
        np.testing.assert_array_equal(np.sort(getattr(found, name), axis=0), np.sort(getattr(everything, name), axis=0))
    np.testing.assert_array_equal(found.points1, images[0].points[found.indices[:, 0]])
    np.testing.assert_array_equal(found.points2, images[1].points[found.indices[:, 1]])


def test_a_few_matches_by_chance_do_not_widen_it(images: tuple[Features, Features]) -> None:
    some = _some(match(*images), 80)
    alone, beside = overlapping(*images, some), overlapping(*images, _joined(some, _chance(*images, 6)))
    for clean, disturbed in zip(alone, beside, strict=True):
        assert len(np.setdiff1d(disturbed, clean)) < 0.1 * len(clean)


def test_many_that_stand_alone_tell_nothing(images: tuple[Features, Features]) -> None:
    assert overlapping(*images, _joined(_some(match(*images), 80), _chance(*images, 30))) is None


def test_few_tell_nothing(images: tuple[Features, Features]) -> None:
    everything = match(*images)
    assert overlapping(*images, _some(everything, 40)) is None
    found = match_overlap(match, *images, _some(everything, 40))
    np.testing.assert_array_equal(found.indices, everything.indices)
