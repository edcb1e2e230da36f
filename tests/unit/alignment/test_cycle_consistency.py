"""Links that contradict each other."""

from dataclasses import replace

import numpy as np
import pytest

from rdstitch.alignment.bundle_adjustment import Priors
from rdstitch.alignment.cycle_consistency import cycle_consistency, misfitting_links, triangles
from rdstitch.alignment.initialization import adjust_pairs_independently, relations_at
from rdstitch.alignment.motion_models import HOMOGRAPHY
from rdstitch.alignment.observations import Observations
from rdstitch.camera import LENS_PARAMETERS
from tests.alignment_scenes import grid, scene


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
    """One of the links of three by three pictures is off by a share of the half diagonal."""
    rng = np.random.default_rng(4)
    given = scene(grid(3, 3, (0.3, 0.25), 0.1, rng), noise=noise, outliers=0.0, per_link=40, rng=rng)
    wrong = next(k for k, link in enumerate(given.links) if (link.image1, link.image2) == (3, 4))
    link = given.links[wrong]
    moved = link.points2 + shift * given.cameras[0].half_diagonal * np.array([0.6, 0.8])
    links = [replace(link, points2=moved) if k == wrong else other for k, other in enumerate(given.links)]
    observations = Observations.from_links(links, given.cameras)
    lens = np.zeros(len(LENS_PARAMETERS))
    lens[0] = given.distortion
    apart = adjust_pairs_independently(
        HOMOGRAPHY,
        observations,
        relations_at(observations, [link.relation for link in links], lens),
        np.empty(0),
        lens,
        lens != 0.0,
        Priors.none(HOMOGRAPHY, 0),
        np.zeros((9, 2)),
    )
    suspects, confirmed = cycle_consistency(apart, observations, 9)
    assert np.flatnonzero(suspects).tolist() == [wrong] * suspected
    assert (np.delete(confirmed, wrong) > 0).all()
