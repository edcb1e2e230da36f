"""Pairs of images that are linked: what a link is worth, the graph, and what is left out of it."""

import itertools

import numpy as np

from rdstitch.geometry.camera import Camera
from rdstitch.geometry.radial_homography import RadialHomography
from rdstitch.matching.links import Link, grid_subsample, in_alternate_directions
from rdstitch.matching.match_graph import connected_components, spanning_forest, spanning_tree


def _link(image1: int, image2: int) -> Link:
    first, second = Camera((640, 480), distortion=-0.2), Camera((320, 240), distortion=-0.2)
    relation = RadialHomography(
        np.array([[0.9, 0.1, 0.3], [-0.1, 1.1, 0.05], [0.02, 0.01, 1.0]]), first, second, np.ones(30, dtype=np.bool_)
    )
    points = np.random.default_rng(0).uniform((100.0, 100.0), (400.0, 380.0), (30, 2))
    return Link(image1, image2, points, relation.transfer(points), relation, 99)


def test_a_reversed_link_leads_back() -> None:
    link = _link(3, 5)
    back = link.reversed()
    assert (back.image1, back.image2, len(back)) == (5, 3, 99)
    np.testing.assert_allclose(back.relation.transfer(back.points1), back.points2, atol=1e-6)
    again = back.reversed()
    np.testing.assert_array_equal(again.points1, link.points1)
    np.testing.assert_allclose(again.relation.homography, link.relation.homography, atol=1e-12)
    assert again.relation.camera == link.relation.camera


def test_every_other_link_of_a_sequence_is_reversed_however_far_apart_its_images_are() -> None:
    for apart in (1, 2, 3, 7):
        given = [_link(k, k + apart) for k in range(12)]
        backward = [link.image1 > link.image2 for link in in_alternate_directions(given)]
        assert all(first is not second for first, second in itertools.pairwise(backward))


def test_components_come_largest_first_and_trees_take_the_links_of_most_weight() -> None:
    assert connected_components(7, [5, 1, 2], [6, 2, 4]) == [[1, 2, 4], [5, 6], [0], [3]]
    assert connected_components(2, [], []) == [[0], [1]]
    i, j = np.array([0, 1, 0, 2]), np.array([1, 2, 2, 3])
    tree = spanning_tree(4, i, j, np.array([5.0, 1.0, 4.0, 3.0]))
    assert sorted(tree.link.tolist()) == [0, 2, 3]
    assert sorted([tree.root, *tree.child.tolist()]) == [0, 1, 2, 3]
    reached = {tree.root}
    for link, parent, child in zip(tree.link, tree.parent, tree.child, strict=True):
        assert parent in reached
        assert {int(i[link]), int(j[link])} == {int(parent), int(child)}
        reached.add(int(child))


def test_the_root_is_the_middle_of_the_longest_path_wherever_the_numbers_begin() -> None:
    # 5 - 3 - 0 - 1 - 6 - 4 - 2, and 7 hangs on 0.
    path = np.array([5, 3, 0, 1, 6, 4, 2])
    i, j = np.append(path[:-1], 0), np.append(path[1:], 7)
    assert spanning_tree(8, i, j, np.ones(7)).root == 1
    # Of two middles the one with more matches.
    weight = np.array([5.0, 4.0, 3.0])
    for chain in ([0, 1, 2, 3], [3, 2, 1, 0], [2, 0, 3, 1]):
        i, j = np.array(chain[:-1], dtype=np.intp), np.array(chain[1:], dtype=np.intp)
        assert spanning_tree(4, i, j, weight).root == chain[1]


def test_chaining_goes_along_links_in_either_direction() -> None:
    rng = np.random.default_rng(0)
    truth = np.eye(3) + 0.2 * rng.normal(size=(4, 3, 3))
    i, j = np.array([1, 1, 3]), np.array([0, 2, 2])
    h = truth[j] @ np.linalg.inv(truth[i])
    tree = spanning_tree(4, i, j, np.ones(3), root=0)
    chained = tree.chained(h, i, truth[0])
    unit = np.cbrt(np.abs(np.linalg.det(truth)))[:, None, None]
    ours = np.cbrt(np.abs(np.linalg.det(chained)))[:, None, None]
    np.testing.assert_allclose(chained / ours, truth / unit, atol=1e-10)


def test_a_spanning_forest_of_many_links_is_that_of_kruskal() -> None:
    rng = np.random.default_rng(0)
    count = 60
    pairs = np.stack(np.triu_indices(count, 1), axis=1)
    i, j = pairs[rng.random(len(pairs)) < 0.2].T
    weight = rng.integers(1, 50, len(i)).astype(float)
    group = np.arange(count)
    expected = []
    for link in np.argsort(-weight, kind="stable"):
        one, other = group[i[link]], group[j[link]]
        if one != other:
            group[group == one] = other
            expected.append(int(link))
    assert spanning_forest(count, i, j, weight).tolist() == sorted(expected)


def test_thinning_keeps_the_overlap_covered() -> None:
    rng = np.random.default_rng(0)
    crowd = rng.normal(0.2, 0.01, (900, 2))
    spread = rng.uniform(-1, 1, (100, 2))
    points = np.concatenate([crowd, spread])
    kept = grid_subsample(points, 100)
    assert len(kept) == 100
    assert len(np.unique(kept)) == 100
    assert (kept >= 900).sum() > 60
    assert (grid_subsample(points[:7], 100) == np.arange(7)).all()
    # Ten in each of the nine cells of a grid of three by three, but two in the last.
    cells = np.repeat(np.stack(np.meshgrid(range(3), range(3)), axis=-1).reshape(-1, 2), 10, axis=0)[:82]
    points = (cells + rng.uniform(0.2, 0.8, cells.shape)) / 3.0
    points[0], points[-1] = 0.0, 1.0
    # Of each cell the first; then the second of the first one. The point on the border is in the last cell.
    assert grid_subsample(points, 9).tolist() == [0, 10, 20, 30, 40, 50, 60, 70, 80]
    assert grid_subsample(points, 10).tolist() == [0, 1, 10, 20, 30, 40, 50, 60, 70, 80]
