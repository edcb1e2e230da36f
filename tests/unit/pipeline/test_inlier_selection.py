"""Inliers by a lens that has more than λ: matches at the corners come back, outliers go."""

from dataclasses import replace

import numpy as np
import pytest

from rdstitch.alignment import AlignmentOptions
from rdstitch.arrays import FloatArray
from rdstitch.cache import NO_CACHE
from rdstitch.camera import Camera
from rdstitch.features import Correspondences
from rdstitch.matching.feature_store import StoredMatches
from rdstitch.matching.links import Link
from rdstitch.matching.two_view import PairRegistration
from rdstitch.pipeline.aligner import Aligner, select_by_whole_lens
from rdstitch.pipeline.inlier_selection import reselect_inliers
from tests.alignment_scenes import grid, scene
from tests.sampled import sampled

FISHEYE = Camera((640, 480), -0.49, -0.055, (335.0, 226.0), distortion3=-0.008)
FAR = 0.8  # half diagonals


def _radius(link: Link) -> FloatArray:
    """The larger of the distances of both points from the centre, half diagonals."""
    points = np.stack([link.points1, link.points2])
    radius: FloatArray = np.linalg.norm(FISHEYE.normalize(points), axis=2).max(axis=0)
    return radius


def _registered(link: Link) -> PairRegistration:
    """As an estimate with one λ leaves it: nothing near the corners, and some outliers in the middle."""
    count = len(link)
    index = np.column_stack([np.arange(count)] * 2)
    matches = Correspondences(index, link.points1, link.points2, np.linspace(0.1, 0.8, count))
    relation = replace(link.relation, inliers=_radius(link) < FAR)
    return PairRegistration(link.image1, link.image2, StoredMatches.of(matches), relation)


@pytest.fixture(scope="module")
def registered() -> tuple[Aligner, list[PairRegistration], list[Link]]:
    rng = np.random.default_rng(0)
    given = scene(grid(4, 3, (0.4, 0.35), np.pi, rng), lens=FISHEYE, rng=rng, noise=0.25, focal=420.0)
    aligner = Aligner(tuple(map(str, range(12))), tuple(given.cameras), AlignmentOptions(), NO_CACHE, 3.0)
    return aligner, [_registered(link) for link in given.links], given.links


def test_corners_come_back_and_outliers_go(registered: tuple[Aligner, list[PairRegistration], list[Link]]) -> None:
    aligner, pairs, links = registered
    alignment = aligner.align(pairs).alignment
    assert alignment.lens in ("division2", "division3")
    selected = reselect_inliers(pairs, alignment, 3.0)
    assert set(selected) == set(range(len(pairs)))
    inliers = np.concatenate([selected[k].relation.inliers for k in selected])
    radius = np.concatenate([_radius(link) for link in links])
    # One in twenty of the matches is an outlier.
    assert inliers[radius >= FAR].mean() > 0.8
    assert 0.93 < inliers.mean() < 0.99
    again = reselect_inliers(pairs, alignment, 0.6)
    assert sum(pair.relation.inliers.sum() for pair in again.values()) < 0.8 * inliers.sum()


def test_a_pair_that_does_not_fit_stays_as_it_is(
    registered: tuple[Aligner, list[PairRegistration], list[Link]],
) -> None:
    aligner, pairs, _ = registered
    alignment = aligner.align(pairs).alignment
    moved = replace(pairs[0].correspondences, points2=pairs[0].correspondences.points2 + 9.0)
    selected = reselect_inliers([replace(pairs[0], matches=StoredMatches.of(moved)), *pairs[1:]], alignment, 3.0)
    assert 0 not in selected
    assert (selected[1].relation.inliers != pairs[1].relation.inliers).any()


@pytest.mark.parametrize("lens", sampled(["division", "auto"]))
def test_only_a_rich_lens_calls_for_it_until_inliers_hardly_change(
    registered: tuple[Aligner, list[PairRegistration], list[Link]], lens: str
) -> None:
    aligner, pairs, _ = registered
    aligner = replace(aligner, options=AlignmentOptions(lens=lens))
    aligned = aligner.draft(pairs)
    selected = select_by_whole_lens(aligned, aligner.threshold)
    if lens == "division":
        assert selected is None
        return
    assert selected is not None
    again = aligner.draft(selected)
    gained = sum(again.alignment.support.values()) - sum(aligned.alignment.support.values())
    assert gained > 100
    assert select_by_whole_lens(again, aligner.threshold) is None


def test_a_draft_is_the_alignment_without_its_uncertainties(
    registered: tuple[Aligner, list[PairRegistration], list[Link]],
) -> None:
    aligner, pairs, _ = registered
    draft = aligner.draft(pairs)
    complete = aligner.completed(draft)
    assert aligner.completed(complete) is complete
    first, second = draft.alignment, complete.alignment
    assert (first.model, first.lens == "division", first.shape) == (second.model, False, None)
    assert second.shape is not None
    assert abs(first.distortion - second.distortion) < 3.0 * second.distortion_std
    np.testing.assert_allclose(first.homographies, second.homographies, atol=0.01)
