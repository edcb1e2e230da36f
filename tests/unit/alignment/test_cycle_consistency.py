"""Links that contradict each other."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from examples.worlds.alignment_scenes import Scene, grid, grid_scene, scene
from rdstitch.alignment.adjustment_problem import LinkProblem
from rdstitch.alignment.alignment_options import AlignmentOptions
from rdstitch.alignment.cycle_consistency import cycle_consistency, misfitting_links, triangles
from rdstitch.alignment.least_squares.bundle_adjustment import BundleAdjustmentResult
from rdstitch.alignment.least_squares.observations import Observations
from rdstitch.alignment.motion_models import Y
from rdstitch.alignment.pairwise import pairwise_homographies, relations_at
from rdstitch.arrays import BoolArray
from rdstitch.geometry.camera import LENS_PARAMETERS
from rdstitch.matching.links import Link


def test_triangles_of_a_complete_graph() -> None:
    i, j = (index.astype(np.intp) for index in np.triu_indices(5, 1))
    found = triangles(5, j, i)  # the direction of a link does not matter
    assert len(found) == 10
    for ij, jk, ik in found:
        nodes = [{int(i[link]), int(j[link])} for link in (ij, jk, ik)]
        assert len(nodes[0] | nodes[1] | nodes[2]) == 3
        assert min(nodes[0]) == min(nodes[2])
        assert max(nodes[1]) == max(nodes[2])


def test_a_link_far_worse_than_the_others_misfits() -> None:
    count = 6
    seen = Observations(
        np.zeros(count, dtype=np.intp),
        np.arange(1, count + 1, dtype=np.intp),
        np.arange(0, 10 * count + 1, 10, dtype=np.intp),
        np.zeros((10 * count, 2)),
        np.zeros((10 * count, 2)),
        np.full(count, 400.0),
        np.full(count, 400.0),
        np.full(count, 10, dtype=np.intp),
    )
    errors = np.full((count, 10), 0.5)
    errors[3] = 30.0
    errors[5, :7] = np.inf
    assert misfitting_links(errors.ravel() ** 2, seen).tolist() == [False, False, False, True, False, True]
    errors[:] = 6.0  # all alike: too rigid a model, not wrong pairs
    assert not misfitting_links(errors.ravel() ** 2, seen).any()
    errors[:] = [[0.5], [0.5], [90.0], [90.0], [90.0], [90.0]]  # most pairs, not most matches
    few = replace(seen, matches=np.array([200, 200, 50, 50, 50, 50]))
    assert misfitting_links(errors.ravel() ** 2, few).tolist() == [False, False, True, True, True, True]


@pytest.mark.parametrize(
    ("shift", "noise", "suspected"),
    [
        (0.0, 0.3, False),
        (0.06, 0.3, True),  # a wrong pair, as a neighbouring tile gives
        (0.06, 1.2, True),  # the same, by some twenty standard deviations
        (0.06, 6.0, False),  # the same where the links are hardly known
        (0.01, 0.01, False),  # hundreds of standard deviations, but what relief or a rolling shutter does
    ],
)
def test_a_link_is_suspected_by_what_its_covariance_allows(shift: float, noise: float, suspected: bool) -> None:
    """One of the links of three by three images is off by a share of the half diagonal."""
    given = grid_scene(3, 3, (0.3, 0.25), 0.1, seed=4, noise=noise, outliers=0.0, per_link=40)
    wrong = next(k for k, link in enumerate(given.links) if (link.image1, link.image2) == (3, 4))
    link = given.links[wrong]
    moved = link.points2 + shift * given.cameras[0].scale * np.array([0.6, 0.8])
    links = [replace(link, points2=moved) if k == wrong else other for k, other in enumerate(given.links)]
    suspects, confirmed = _judged(given, links)
    assert np.flatnonzero(suspects).tolist() == [wrong] * suspected
    assert (np.delete(confirmed, wrong) > 0).all()


def test_pairs_that_show_a_vehicle_only_are_suspected_though_they_open_most_triangles() -> None:
    """Six images in a row; those far apart have only in common what drives ahead."""
    rng = np.random.default_rng(12)
    path = grid(6, 1, (0.45, 0.0), 0.1, rng)
    swaying = 0.15 * path + rng.normal(0.0, 0.04, path.shape) * (np.arange(6) == Y)
    plane, ahead = scene(path, per_link=200, rng=rng), scene(swaying, per_link=50, rng=rng)
    near = {(0, 1), (0, 2), (1, 2), (1, 3), (2, 3), (3, 4), (3, 5), (4, 5)}
    links = [link for link in plane.links if (link.image1, link.image2) in near]
    links += [link for link in ahead.links if (link.image1, link.image2) not in near]
    suspects, _ = _judged(plane, links)
    assert not suspects[:8].any()
    assert suspects[8:].sum() >= 5  # of seven; then no triangle is left


def _judged(given: Scene, links: list[Link]) -> tuple[BoolArray, NDArray[np.intp]]:
    """What :func:`cycle_consistency` says of links between the images of a scene."""
    return cycle_consistency(*_apart(given, links), len(given.cameras))


def _apart(given: Scene, links: list[Link]) -> tuple[BundleAdjustmentResult, Observations]:
    """Links between the images of a scene, each on its own."""
    observations = Observations.from_links(links, given.cameras)
    lens = np.zeros(len(LENS_PARAMETERS))
    lens[0] = given.distortion
    relations = relations_at(observations, [link.relation for link in links], lens)
    known = AlignmentOptions().camera_priors(given.cameras)
    return pairwise_homographies(LinkProblem(observations, relations, lens, lens != 0.0, known)), observations


def test_a_fit_that_ran_away_is_suspected_and_says_nothing_of_others() -> None:
    given = grid_scene(3, 3, (0.3, 0.25), 0.1, seed=4, noise=0.3, outliers=0.0, per_link=40)
    apart, observations = _apart(given, given.links)
    for lost in (np.zeros((3, 3)), np.outer([1e200, 1.0, 1.0], [1.0, 1e-3, 1.0]), np.full((3, 3), np.nan)):
        ran_away = replace(apart)
        homographies = apart.homographies.copy()
        homographies[5] = lost
        ran_away.__dict__["homographies"] = homographies
        suspects, confirmed = cycle_consistency(ran_away, observations, 9)
        assert np.flatnonzero(suspects).tolist() == [5]
        assert (np.delete(confirmed, 5) > 0).all()


def test_every_link_keeps_a_triangle_of_very_many(monkeypatch: pytest.MonkeyPatch) -> None:
    i, j = (index.astype(np.intp) for index in np.triu_indices(12, 1))
    monkeypatch.setattr("rdstitch.alignment.cycle_consistency._MAX_TRIANGLES", 5)
    monkeypatch.setattr("rdstitch.alignment.cycle_consistency._TRIANGLES_PER_LINK", 0)
    assert set(triangles(12, i, j).ravel().tolist()) == set(range(len(i)))
