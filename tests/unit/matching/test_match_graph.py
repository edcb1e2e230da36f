"""The match graph: its connected parts, spanning forest and centre."""

import numpy as np

from rdstitch.matching.match_graph import connected_components, spanning_forest, spanning_tree


def test_components_come_largest_first() -> None:
    assert connected_components(7, [5, 1, 2], [6, 2, 4]) == [[1, 2, 4], [5, 6], [0], [3]]
    assert connected_components(2, [], []) == [[0], [1]]


def test_spanning_tree_takes_the_links_of_most_weight() -> None:
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


def test_of_two_centres_the_one_with_more_matches_is_the_root_whatever_the_numbers() -> None:
    weight = np.array([5.0, 4.0, 3.0])
    for chain in ([0, 1, 2, 3], [3, 2, 1, 0], [2, 0, 3, 1]):
        i, j = np.array(chain[:-1], dtype=np.intp), np.array(chain[1:], dtype=np.intp)
        assert spanning_tree(4, i, j, weight).root == chain[1]
