"""The match graph: images as nodes, links as edges; its connected parts, spanning tree and centre."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rdstitch.arrays import FloatArray, IntArray
from rdstitch.geometry.radial_homography import inverses
from rdstitch.system.late_imports import csgraph, sparse


def connected_components(count: int, image1: ArrayLike, image2: ArrayLike) -> list[list[int]]:
    """Groups of the ``count`` images that the links connect, largest first, each ascending.

    Groups of the same size are ordered by their first image.
    """
    edges = _graph(count, image1, image2, np.ones(np.size(image1)))
    number, label = csgraph.connected_components(edges, directed=False)
    groups = [np.flatnonzero(label == k).tolist() for k in range(number)]
    return sorted(groups, key=lambda group: (-len(group), group[0]))


@dataclass(frozen=True, eq=False)
class SpanningTree:
    """A tree over a connected graph, as the steps that reach one image after the other from the root."""

    root: int
    link: IntArray  # (N - 1,), intp: the link of each step
    parent: IntArray  # parent, child: (N - 1,), intp: where the step starts, and the image that it reaches
    child: IntArray

    def chained(self, homographies: FloatArray, image1: NDArray[np.intp], root_matrix: FloatArray) -> FloatArray:
        """Plane-to-image homographies (N, 3, 3) by chaining those of the links (L, 3, 3) from the root's."""
        matrices = np.empty((len(self.link) + 1, 3, 3))
        matrices[self.root] = root_matrix
        inverse = inverses(homographies)
        for link, parent, child in zip(self.link, self.parent, self.child, strict=True):
            step = homographies[link] if image1[link] == parent else inverse[link]
            product = step @ matrices[parent]
            matrices[child] = product / np.cbrt(np.abs(np.linalg.det(product)))
        return matrices


def spanning_forest(count: int, image1: IntArray, image2: IntArray, weight: FloatArray) -> IntArray:
    """Indices, ascending, of the links of the spanning forest of largest total weight; of equal ones, earlier links."""
    order = np.argsort(-weight, kind="stable")
    both = np.sort(np.stack([image1[order], image2[order]], axis=1), axis=1)
    pairs, first = np.unique(both, axis=0, return_index=True)
    # Ranks instead of weights: they are distinct, so that the forest is unique, and they name the link.
    kept = csgraph.minimum_spanning_tree(_graph(count, pairs[:, 0], pairs[:, 1], first.astype(np.float64) + 1.0))
    return np.sort(order[kept.data.astype(np.intp) - 1])


def _graph(count: int, image1: ArrayLike, image2: ArrayLike, value: FloatArray) -> "sparse.csr_array":
    """One edge a link. Indices are 32-bit, the only ones that csgraph takes before SciPy 1.17."""
    i, j = np.asarray(image1, dtype=np.int32), np.asarray(image2, dtype=np.int32)
    return sparse.csr_array(sparse.coo_array((value, (i, j)), shape=(count, count)))


def spanning_tree(
    count: int, image1: IntArray, image2: IntArray, weight: FloatArray, root: int | None = None
) -> SpanningTree:
    """The spanning tree of largest total weight over ``count`` connected images.

    The root, if not given, is its centre, from where the farthest image is the fewest steps away; of two, the one
    whose links weigh more, so that the numbers of the images do not decide.
    """
    tree = spanning_forest(count, image1, image2, weight)
    number = _graph(count, image1[tree], image2[tree], tree.astype(np.float64) + 1.0)
    number = (number + number.T).tocsr()
    if root is None:
        middle = _centre(number)
        root = max(middle, key=lambda node: float(weight[(image1 == node) | (image2 == node)].sum()))
    order, predecessor = csgraph.breadth_first_order(number, root, directed=False)
    child = order[1:].astype(np.intp)
    parent = predecessor[child].astype(np.intp)
    step = np.array([number[p, c] - 1 for p, c in zip(parent, child, strict=True)], dtype=np.intp)
    return SpanningTree(root, step, parent, child)


def _centre(tree: "sparse.csr_array") -> list[int]:
    """Middle of the longest path of a tree: one node, or two."""
    first = int(csgraph.breadth_first_order(tree, 0, directed=False)[0][-1])
    order, predecessor = csgraph.breadth_first_order(tree, first, directed=False)
    path = [int(order[-1])]
    while path[-1] != first:
        path.append(int(predecessor[path[-1]]))
    return path[(len(path) - 1) // 2 : len(path) // 2 + 1]
