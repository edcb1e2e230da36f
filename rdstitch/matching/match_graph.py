"""The match graph: pictures as nodes, links as edges; its connected parts, spanning tree and centre."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import sparse
from scipy.sparse import csgraph

from rdstitch.arrays import FloatArray, IntArray


def connected_components(count: int, image1: ArrayLike, image2: ArrayLike) -> list[list[int]]:
    """Groups of the ``count`` pictures that the links connect, largest first, each ascending.

    Groups of the same size are ordered by their first picture.
    """
    i, j = np.asarray(image1, dtype=np.intp), np.asarray(image2, dtype=np.intp)
    edges = sparse.coo_array((np.ones(len(i)), (i, j)), shape=(count, count))
    number, label = csgraph.connected_components(edges, directed=False)
    groups = [np.flatnonzero(label == k).tolist() for k in range(number)]
    return sorted(groups, key=lambda group: (-len(group), group[0]))


@dataclass(frozen=True)
class SpanningTree:
    """A tree over a connected graph, as the steps that reach one picture after the other from the root.

    Attributes
    ----------
    root : int
    link : ndarray of shape (N - 1,), intp
        The link of each step.
    parent, child : ndarray of shape (N - 1,), intp
        Where the step starts, and the picture that it reaches.
    """

    root: int
    link: IntArray
    parent: IntArray
    child: IntArray

    def chained(self, homographies: FloatArray, image1: NDArray[np.intp], root_matrix: FloatArray) -> FloatArray:
        """Plane-to-picture homographies (N, 3, 3) by chaining those of the links (L, 3, 3) from the root's."""
        matrices = np.empty((len(self.link) + 1, 3, 3))
        matrices[self.root] = root_matrix
        inverse = np.linalg.inv(homographies)
        for link, parent, child in zip(self.link, self.parent, self.child, strict=True):
            step = homographies[link] if image1[link] == parent else inverse[link]
            product = step @ matrices[parent]
            matrices[child] = product / np.cbrt(np.abs(np.linalg.det(product)))
        return matrices


def spanning_tree(
    count: int, image1: IntArray, image2: IntArray, weight: FloatArray, root: int | None = None
) -> SpanningTree:
    """The spanning tree of largest total weight over ``count`` connected pictures (Kruskal).

    Parameters
    ----------
    count : int
    image1, image2 : ndarray of shape (L,), intp
    weight : ndarray of shape (L,)
        How much each link can be relied on.
    root : int, optional
        The centre of the tree, from where the farthest picture is the fewest steps away, if not given.
    """
    group = np.arange(count)

    def head(node: int) -> int:
        while group[node] != node:
            group[node] = group[group[node]]
            node = int(group[node])
        return node

    chosen = []
    for link in np.argsort(-weight, kind="stable").tolist():
        a, b = head(int(image1[link])), head(int(image2[link]))
        if a != b:
            group[a] = b
            chosen.append(link)
    tree = np.sort(np.array(chosen, dtype=np.intp))
    number = sparse.coo_array((tree + 1.0, (image1[tree], image2[tree])), shape=(count, count)).tocsr()
    number = (number + number.T).tocsr()
    start = _centre(number) if root is None else root
    order, predecessor = csgraph.breadth_first_order(number, start, directed=False)
    child = order[1:].astype(np.intp)
    parent = predecessor[child].astype(np.intp)
    step = np.array([number[p, c] - 1 for p, c in zip(parent, child, strict=True)], dtype=np.intp)
    return SpanningTree(start, step, parent, child)


def _centre(tree: sparse.csr_array) -> int:
    """Middle of the longest path of a tree."""
    first = int(csgraph.breadth_first_order(tree, 0, directed=False)[0][-1])
    order, predecessor = csgraph.breadth_first_order(tree, first, directed=False)
    path = [int(order[-1])]
    while path[-1] != first:
        path.append(int(predecessor[path[-1]]))
    return path[len(path) // 2]
