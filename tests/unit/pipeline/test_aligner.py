"""What is aligned of images that are there twice, and what is given of them."""

from dataclasses import replace
from typing import Any, cast

import numpy as np
import pytest

from examples.worlds.alignment_scenes import grid, grid_scene, scene
from rdstitch.alignment import AlignmentOptions
from rdstitch.alignment.frames.quarter_turns import QuarterTurns
from rdstitch.alignment.least_squares.plane_marks import Sighting
from rdstitch.alignment.motion_models import X
from rdstitch.alignment.result import Unused
from rdstitch.alignment.select import ModelChoice, select_model
from rdstitch.features import Correspondences
from rdstitch.geometry.camera import Camera
from rdstitch.geometry.radial_homography import to_plane
from rdstitch.matching.feature_store import StoredMatches
from rdstitch.matching.links import Link
from rdstitch.matching.pair_estimator import PairEstimator
from rdstitch.matching.two_view import PairRegistration
from rdstitch.pipeline.registration.aligner import Aligner
from rdstitch.pipeline.registration.redraft import draft_with_loops
from rdstitch.system.cache import NO_CACHE

COPY = 12


def _registered(link: Link) -> PairRegistration:
    index = np.column_stack([np.arange(len(link))] * 2)
    matches = Correspondences(index, link.points1, link.points2, np.linspace(0.1, 0.8, len(link)))
    return PairRegistration(link.image1, link.image2, StoredMatches.of(matches), link.relation)


@pytest.mark.parametrize(("moved", "orientation"), [(0.0, 1), (0.0, 6), (3.0, 1)])
def test_a_control_point_in_a_copy_counts(moved: float, orientation: int) -> None:
    """Where that is saved as a camera on its side does, too; and in one that was taken again beside its image."""
    given = grid_scene(4, 3, seed=1, per_link=60, outliers=0.0)
    lens, quarters = Camera((640, 480), distortion=given.distortion), QuarterTurns((1,) * 12 + (orientation,))
    first = next(link for link in given.links if link.image1 == 0)
    step = np.array([moved, 0.0])
    relation = replace(first.relation, homography=np.eye(3))
    again = replace(first, image2=COPY, points2=first.points1 + step, relation=relation)
    control = []
    for number, image in enumerate((0, 3, 5, 8, 11)):
        offset = np.array([30.0, 50.0])
        x, y = to_plane(lens, np.linalg.inv(given.truth[image]), offset[None] + lens.center)[0].tolist()
        shown = COPY if image == 0 else image
        seen = offset + step if image == 0 else offset
        across, down = quarters.back.point(seen, shown).tolist()
        control.append(Sighting(shown, (across, down), f"P{number}", (100.0 * x, -100.0 * y), 0.01))
    options = AlignmentOptions(model="rigid", lens="division", control=tuple(control))
    cameras = (*given.cameras, given.cameras[0])
    aligner = Aligner(tuple(map(str, range(13))), cameras, options, NO_CACHE, 3.0, quarters=quarters)
    found = aligner.align([_registered(link) for link in (*given.links, again)]).alignment
    assert found.used.all()
    assert found.leverage.keys() == {one.name for one in control}
    assert found.leverage["P0"] > 0.05


@pytest.mark.parametrize(("relief", "noise"), [(0.08, 0.0), (0.0, 0.5)])
def test_a_near_copy_over_relief_or_blurred_is_counted_once(relief: float, noise: float) -> None:
    """Its image is off as much where another copy, whose pair with it fits, is there as well; so are its own pairs."""
    rng = np.random.default_rng(2)
    poses = grid(3, 2, (0.4, 0.3), 0.2, rng)
    poses = np.vstack([poses, poses[4]])
    poses[6, X] += 0.008
    given = scene(poses, rng=rng, per_link=120, noise=0.2, outliers=0.0, relief=relief)
    camera = Camera((640, 480), distortion=given.distortion)
    links = []
    for link in given.links:
        to_second = given.truth[link.image2] @ np.linalg.inv(given.truth[link.image1])
        relation = replace(link.relation, homography=to_second, camera=camera, camera2=camera)
        blurred = noise if 6 in (link.image1, link.image2) else 0.0
        links.append(replace(link, points2=link.points2 + rng.normal(0.0, blurred, (len(link), 2)), relation=relation))
    again = [
        replace(link, **{end: 7})  # type: ignore[arg-type]
        for link in links
        for end in ("image1", "image2")
        if getattr(link, end) == 4
    ]
    copy = replace(links[0], image1=4, image2=7, points2=links[0].points1)
    copy = replace(copy, relation=replace(copy.relation, homography=np.eye(3)))
    pairs = [_registered(link) for link in (*links, *again, copy)]
    options = AlignmentOptions(model="auto", lens="division")
    aligner = Aligner(tuple("abcdefgh"), (given.cameras[0],) * 8, options, NO_CACHE, 3.0, QuarterTurns((1,) * 8))
    found = aligner.align(pairs).alignment
    assert found.used.all()
    assert {fit.reason for fit in found.links if 6 in fit.images} == {Unused.COPY}


@pytest.mark.parametrize(("moved", "selections"), [(0.0, 1), (30.0, 2)])
def test_the_model_is_chosen_again_only_where_more_pairs_disagree(
    moved: float, selections: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    given = grid_scene(6, 4, seed=3, per_link=60, outliers=0.0)
    pairs = [_registered(link) for link in given.links]
    last = pairs.pop()
    points = last.correspondences.points2 + moved
    homography = np.array([[1.0, 0.0, moved / given.cameras[0].scale], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
    relation = replace(last.relation, homography=homography @ last.relation.homography)
    loop = replace(last, matches=StoredMatches.of(replace(last.correspondences, points2=points)), relation=relation)

    class Estimator:
        def __init__(self) -> None:
            self.found = [loop]

        def estimate(self, wanted: object, *, distortion: float) -> list[PairRegistration]:
            found, self.found = self.found, []
            return found

        def progress(self, *_: object) -> None:
            pass

    chosen = []

    def counted(*args: Any) -> ModelChoice:
        chosen.append(select_model(*args))
        return chosen[-1]

    monkeypatch.setattr("rdstitch.alignment.recipe.select_model", counted)
    aligner = Aligner(
        tuple(map(str, range(24))), tuple(given.cameras), AlignmentOptions(), NO_CACHE, 3.0, QuarterTurns((1,) * 24)
    )
    found = draft_with_loops(aligner, cast(PairEstimator, Estimator()), pairs, [])
    assert len(chosen) == selections
    assert len(found.pairs) == len(given.links)
    expected = aligner.draft([*pairs, loop]).alignment
    assert found.alignment.model == expected.model
    assert found.alignment.distortion == pytest.approx(expected.distortion, abs=1e-4)
    whole, again = (aligner.completed(one).alignment for one in (found, aligner.draft([*pairs, loop])))
    assert whole.distortion == pytest.approx(again.distortion, abs=1e-4)
