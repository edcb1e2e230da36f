"""Results that are accepted, and inliers selected again."""

from dataclasses import replace
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest

from examples.worlds.alignment_scenes import grid, scene
from rdstitch.alignment import AlignmentOptions
from rdstitch.alignment.frames.quarter_turns import QuarterTurns
from rdstitch.alignment.result import Unused
from rdstitch.arrays import FloatArray
from rdstitch.choices import LensName, Purpose
from rdstitch.errors import ImpossibleCameraError
from rdstitch.features import Correspondences, FeatureOptions
from rdstitch.geometry.camera import Camera
from rdstitch.io.write import write_image
from rdstitch.matching.feature_store import StoredMatches
from rdstitch.matching.links import Link
from rdstitch.matching.two_view import PairRegistration
from rdstitch.options.stitch_options import StitchOptions
from rdstitch.pipeline.recipes import mosaic
from rdstitch.pipeline.registration.accept import accept
from rdstitch.pipeline.registration.aligner import AlignedPairs, Aligner
from rdstitch.pipeline.registration.realign import realigned, without
from rdstitch.pipeline.registration.redraft import reselect_inliers, select_by_whole_lens
from rdstitch.pipeline.run import Run
from rdstitch.results.messages import Message, left_out
from rdstitch.system.cache import NO_CACHE
from rdstitch.verification.verdict import RefusedError
from tests.cli.running import flight
from tests.registrations import registered, registration
from tests.sampled import sampled

OPTIONS = StitchOptions(workers=1, features=FeatureOptions(max_features=600))


def test_pairs_that_contradicted_what_is_left_out_are_judged_again(tmp_path: Path) -> None:
    """The pair of the other two images had been dropped for contradicting the third one, and 0 with it."""
    frames = flight(3, 3).write(tmp_path)
    found = registered(frames, OPTIONS)
    links = tuple(fit if 2 in fit.images else replace(fit, reason=Unused.CONTRADICTS) for fit in found.alignment.links)
    spoiled = replace(
        found,
        alignment=replace(found.alignment, links=links, used=found.alignment.used & [False, True, True]),
        messages=(left_out(frames[0], "contradicts"),),
    )
    rest = without(spoiled, {(2,): "shows something else"}, Aligner.of(found.sources, OPTIONS, NO_CACHE))
    assert rest.alignment.used.tolist() == [True, True, False]
    assert [str(message) for message in rest.left_out] == [f"left out {frames[2]}: shows something else [left-out]"]


def test_what_was_left_out_stays_out_of_other_hypotheses(tmp_path: Path) -> None:
    found = registered(flight(3, 3).write(tmp_path), OPTIONS)
    accepted = replace(found, alignment=replace(found.alignment, used=np.array([True, True, False])))
    other = realigned(accepted, Aligner.of(found.sources, replace(OPTIONS, model="rigid"), NO_CACHE), lambda _: True)
    assert other is not None
    assert other.alignment.used.tolist() == [True, True, False]


def test_what_remains_has_metric_poses_where_they_are_needed(monkeypatch: pytest.MonkeyPatch) -> None:
    asked = []

    def aligned(aligner: Aligner, pairs: object, known: None) -> AlignedPairs:
        asked.append(aligner.options.model)
        metric = registration().alignment
        return AlignedPairs((), replace(metric, poses=None) if aligner.options.model == "auto" else metric, rough=False)

    monkeypatch.setattr(Aligner, "_drafted", aligned)
    monkeypatch.setattr("rdstitch.pipeline.registration.aligner.over_rough_ground", lambda pairs, threshold: pairs)
    free = Aligner.of([], OPTIONS, NO_CACHE)
    assert free.draft(()).alignment.poses is None
    assert replace(free, needs_poses=True).draft(()).alignment.poses is not None
    assert asked == ["auto", "auto", "pose"]


@pytest.mark.parametrize("error", [np.linalg.LinAlgError("singular"), ImpossibleCameraError("folds")])
def test_an_alternative_that_cannot_be_computed_is_none(monkeypatch: pytest.MonkeyPatch, error: Exception) -> None:
    monkeypatch.setattr(Aligner, "_drafted", Mock(side_effect=error))
    aligner = Aligner.of([], OPTIONS, NO_CACHE)
    assert realigned(registration(), aligner, lambda _: True) is None
    assert without(registration(), {(0,): "shows something else"}, aligner) is None


def test_of_two_motions_that_which_fills_more_of_the_overlaps_is_taken(tmp_path: Path) -> None:
    """What drives ahead fills a good third of every image, and has more matches where images overlap little."""
    plane, ahead = flight(3, 3, overlap=0.4), flight(5, 3, overlap=0.4)
    middle = ahead.poses.position.mean(axis=0)
    slow = middle + 0.15 * (ahead.poses.position - middle) + [[0.0, 25.0], [0.0, -25.0], [0.0, 25.0]]
    ahead = replace(ahead, poses=replace(ahead.poses, position=slow))
    frames = plane.write(tmp_path)
    for k, frame in enumerate(frames):
        write_image(frame, np.concatenate([plane.frame(k)[:192], ahead.frame(k)[192:]]))
    found = registered(frames, OPTIONS)
    accepted = accept(found, Run(OPTIONS, purpose=Purpose.TRAJECTORY))
    picture = mosaic(frames, None, replace(OPTIONS, focal=380.0)).registration
    steps = [np.diff(k.alignment.homographies[:, 0, 2]) for k in (found, accepted, picture)]
    assert np.all(np.abs(steps[0]) < 0.2)  # heights above the ground: what drives ahead moves by a sixth
    assert np.all(np.abs(steps[1]) > 0.7)
    assert np.all(np.abs(steps[2]) > 0.7)  # by its seams
    assert accepted.ok


def test_what_the_alignment_itself_fails_by_is_refused(tmp_path: Path) -> None:
    """Such as depth that looks like a lens, of a calibration."""
    failure = Message("no lens shows", severity="failure")
    found = registered(flight(2, 2).write(tmp_path), OPTIONS).with_messages([failure])
    with pytest.raises(RefusedError, match="no lens shows"):
        accept(found, Run(OPTIONS))
    assert not accept(found, Run(replace(OPTIONS, force=True))).ok


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
def curved() -> tuple[Aligner, list[PairRegistration], list[Link]]:
    rng = np.random.default_rng(0)
    given = scene(grid(4, 3, (0.4, 0.35), np.pi, rng), lens=FISHEYE, rng=rng, noise=0.25, focal=420.0)
    aligner = Aligner(
        tuple(map(str, range(12))), tuple(given.cameras), AlignmentOptions(), NO_CACHE, 3.0, QuarterTurns((1,) * 12)
    )
    return aligner, [_registered(link) for link in given.links], given.links


def test_corners_come_back_and_outliers_go(curved: tuple[Aligner, list[PairRegistration], list[Link]]) -> None:
    aligner, pairs, links = curved
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


def test_a_pair_that_does_not_fit_stays(curved: tuple[Aligner, list[PairRegistration], list[Link]]) -> None:
    aligner, pairs, _ = curved
    alignment = aligner.align(pairs).alignment
    moved = replace(pairs[0].correspondences, points2=pairs[0].correspondences.points2 + 9.0)
    selected = reselect_inliers([replace(pairs[0], matches=StoredMatches.of(moved)), *pairs[1:]], alignment, 3.0)
    assert 0 not in selected
    assert (selected[1].relation.inliers != pairs[1].relation.inliers).any()


@pytest.mark.parametrize("lens", sampled(["division", "auto"]))
def test_only_a_rich_lens_needs_it(curved: tuple[Aligner, list[PairRegistration], list[Link]], lens: LensName) -> None:
    aligner, pairs, _ = curved
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


def test_a_draft_lacks_uncertainties(curved: tuple[Aligner, list[PairRegistration], list[Link]]) -> None:
    aligner, pairs, _ = curved
    draft = aligner.draft(pairs)
    complete = aligner.completed(draft)
    first, second = draft.alignment, complete.alignment
    assert (first.model, first.lens == "division") == (second.model, False)
    assert first.distortion_std < second.distortion_std  # that of independent errors
    assert abs(first.distortion - second.distortion) < 3.0 * second.distortion_std
    np.testing.assert_allclose(first.homographies, second.homographies, atol=0.01)
