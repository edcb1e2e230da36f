"""The match graph, and links that contradict each other."""

import numpy as np

from rdstitch.alignment.cycle_consistency import misfitting_links, triangles
from rdstitch.alignment.observations import Observations
from rdstitch.matching.match_graph import connected_components, spanning_tree


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


def test_the_root_is_the_middle_of_a_chain() -> None:
    chain = np.arange(8)
    assert spanning_tree(9, chain, chain + 1, np.ones(8)).root == 4
    assert spanning_tree(9, chain, chain + 1, np.ones(8), root=0).parent.tolist() == list(range(8))


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
