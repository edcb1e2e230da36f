"""Correspondences of all links as flat arrays."""

import numpy as np

from rdstitch.alignment.link_equations import link_equations
from rdstitch.alignment.observations import Observations


def _observations(counts: list[int]) -> Observations:
    rng = np.random.default_rng(0)
    total, links = sum(counts), len(counts)
    points = rng.uniform(-0.8, 0.8, (total, 2))
    return Observations(
        np.arange(links),
        np.arange(links) + 1,
        np.concatenate([[0], np.cumsum(counts)]).astype(np.intp),
        points,
        points + rng.normal(0.0, 0.05, points.shape),
        np.full(links, 400.0),
        np.full(links, 400.0),
        np.array(counts),
    )


def test_medians_of_links_of_any_length() -> None:
    counts = [5, 0, 1, 8, 2, 0]
    observations = _observations(counts)
    values = np.random.default_rng(1).normal(size=sum(counts))
    values[3] = np.inf
    found = observations.medians(values)
    parts = np.split(values, np.cumsum(counts)[:-1])
    assert found.tolist() == [float(np.median(part)) if len(part) else np.inf for part in parts]
    assert _observations([0, 0]).medians(np.empty(0)).tolist() == [np.inf, np.inf]


def test_areas_of_links_with_few_correspondences_or_many() -> None:
    corners = np.array([(-1.0, -1.0), (1.0, -1.0), (-1.0, 1.0), (1.0, 1.0)])
    points = np.concatenate([corners, 0.5 * corners + 0.2, corners * (1.0, 0.0), corners[:1]])
    start = np.array([0, 4, 8, 12, 13, 13])
    sizes = np.full(5, 400.0)
    made = Observations(np.arange(5), np.arange(5) + 1, start, points, points, sizes, sizes, np.diff(start))
    np.testing.assert_allclose(made.areas, [1.0, 0.25, 0.0, 0.0, 0.0], atol=1e-12)


def test_sums_of_a_link_do_not_depend_on_the_other_links() -> None:
    """Whether these have as many correspondences or not."""
    observations = _observations([30, 12, 30, 0, 7])
    homographies = np.eye(3) + np.random.default_rng(2).normal(0.0, 0.01, (5, 3, 3))
    lens, free = np.array([-0.2, 0.0, 0.0, 0.0, 0.0]), np.array([True, False, False, True, True])
    together = link_equations(observations, homographies, lens, 20.0, free)
    for link in range(5):
        alone = link_equations(observations.subset(np.array([link])), homographies[[link]], lens, 20.0, free)
        np.testing.assert_allclose(together.gram[link], alone.gram[0], rtol=1e-12, atol=1e-9)
        np.testing.assert_allclose(together.gradient[link], alone.gradient[0], rtol=1e-12, atol=1e-9)
    assert (together.gram[3] == 0.0).all()
    assert (together.gram[0] != 0.0).any()
