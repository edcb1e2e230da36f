"""Cholesky factors of the normal matrix of poses, which has a block for each image and for each two that a link joins.

Images are eliminated in the order of a nested dissection of the match graph (George 1973): images that divide it in two
come after those on either side, and so on within the sides, so that factors grow little faster than the number of
images. What is eliminated at a time is a dense front of a few images with those that are linked to them (the
multifrontal method; Duff and Reid 1983). The order depends on the links alone, and is found once.
"""

from functools import lru_cache
from itertools import product
from typing import Self

import numpy as np

from rdstitch.arrays import BoolArray, FloatArray, IntArray
from rdstitch.system.dataclasses import dataclass
from rdstitch.system.late_imports import csgraph, sparse

_UNDIVIDED = 20
"""Images that are eliminated at once: what dense matrices do in less time than further division."""

_FRACTIONS = (0.4, 0.5, 0.6)
"""Of the images of a part on one side, where it may be divided."""

_HALVED = 16
"""Rows from which on half a triangular matrix is inverted by itself."""

_WORTHWHILE = 3
"""Times as many images a part must have as divide it; otherwise it is eliminated as one."""


@dataclass(frozen=True, eq=False)
class Fronts:
    """B fronts of one shape: the images that are eliminated, and those that are linked to them and come later."""

    images: IntArray  # (B, I): in the order of elimination
    pivots: int  # how many of these are eliminated
    number: IntArray  # (B,): of each front among all
    parent: IntArray  # (B,): the front that the first of the others belongs to; -1 where there are none
    places: IntArray  # (B, I - pivots): where among the images of that front the others are
    links: IntArray  # (K,): those of the blocks between images of which the earlier one is eliminated here
    where: tuple[IntArray, IntArray, IntArray]  # (K,) each: of these the front, row and column of images


@dataclass(frozen=True, eq=False)
class Elimination:
    """How N images are eliminated."""

    fronts: tuple[Fronts, ...]  # in the order of elimination
    turned: BoolArray  # (L,): links whose second image is eliminated before the first

    @classmethod
    def of(cls, count: int, image1: IntArray, image2: IntArray) -> Self:
        """Of so many images, by links between them (L,) and (L,)."""
        front, level = dissection(count, image1, image2)
        order = np.lexsort((front, -level[front]))
        rank = np.empty(count, dtype=np.intp)
        rank[order] = np.arange(count)
        turned = rank[image1] > rank[image2]
        first, later = np.where(turned, [image2, image1], [image1, image2])
        parent, member = _members(front, level, order, first, rank[later])
        start, total = np.searchsorted(member, np.arange(len(level) + 1) * count), np.bincount(front)
        of, image = member // count, order[member % count]
        place = np.searchsorted(member, parent[of] * count + member % count) - start[parent[of]]
        owner = front[first]
        column, row = (np.searchsorted(member, owner * count + rank[end]) - start[owner] for end in (first, later))
        shape = np.stack([-level, total, np.diff(start)], axis=1)
        shapes, kind = np.unique(shape, axis=0, return_inverse=True)
        kind = kind.reshape(-1)
        by_kind = np.argsort(kind[owner], kind="stable")
        within = np.empty(len(level), dtype=np.intp)
        result = []
        for k, links in enumerate(np.split(by_kind, np.searchsorted(kind[owner][by_kind], np.arange(1, len(shapes))))):
            number, pivots = np.flatnonzero(kind == k), int(shapes[k, 1])
            within[number] = np.arange(len(number))
            rows = start[number][:, None] + np.arange(shapes[k, 2])
            where = within[owner[links]], row[links], column[links]
            result.append(Fronts(image[rows], pivots, number, parent[number], place[rows[:, pivots:]], links, where))
        return cls(tuple(result), turned)

    @classmethod
    def of_links(cls, count: int, image1: IntArray, image2: IntArray) -> Self:
        """The same; from before where these links were asked for a short while ago."""
        return cls(*_remembered(count, *(np.ascontiguousarray(ends, np.int64).tobytes() for ends in (image1, image2))))

    def factorized(self, diagonal: FloatArray, off_diagonal: FloatArray) -> "BlockCholesky":
        """Factors of the matrix of the images' blocks (N, D, D), and the links' (L, D, D): row image2, column image1.

        :exc:`numpy.linalg.LinAlgError` where it is not positive definite.
        """
        size, squared = diagonal.shape[1], np.einsum("ndd->nd", diagonal)
        if not (squared > 0.0).all():
            raise np.linalg.LinAlgError("not positive definite")
        scale = 1.0 / np.sqrt(squared)  # to units in which the diagonal is one
        diagonal = diagonal * scale[:, :, None] * scale[:, None, :]
        turned = np.where(self.turned[:, None, None], off_diagonal.swapaxes(1, 2), off_diagonal)
        waiting: dict[int, list[tuple[IntArray, FloatArray]]] = {}
        factors = []
        for fronts in self.fronts:
            count, images = fronts.images.shape
            blocks, pivots = np.zeros((count, images, size, images, size)), np.arange(fronts.pivots)
            blocks[:, pivots, :, pivots] = diagonal[fronts.images[:, : fronts.pivots]].swapaxes(0, 1)
            front, row, column = fronts.where
            rows, columns = scale[fronts.images[front, row]], scale[fronts.images[front, column]]
            blocks[front, row, :, column] = turned[fronts.links] * rows[:, :, None] * columns[:, None, :]
            matrix, edge = blocks.reshape(count, images * size, images * size), fronts.pivots * size
            for one, number in zip(matrix, fronts.number.tolist(), strict=True):
                for places, update in waiting.pop(number, ()):
                    one[np.ix_(places, places)] += update
            lower = np.asarray(np.linalg.cholesky(matrix[:, :edge, :edge]), dtype=np.float64)
            inverse = _lower_inverse(lower)
            across = matrix[:, edge:, :edge] @ inverse.swapaxes(1, 2)
            factors.append((inverse, across))
            if images > fronts.pivots:
                updates = matrix[:, edge:, edge:] - across @ across.swapaxes(1, 2)
                for parent, places, update in zip(fronts.parent.tolist(), fronts.places, updates, strict=True):
                    waiting.setdefault(parent, []).append((_expanded(places, size), update))
        return BlockCholesky(self, scale, tuple(factors))


@dataclass(frozen=True, eq=False)
class BlockCholesky:
    """Factors of a symmetric matrix of blocks."""

    elimination: Elimination
    scale: FloatArray  # (N, D): of rows and columns
    # of each batch of fronts the inverse of the Cholesky factor, and the rows of the factor below it
    factors: tuple[tuple[FloatArray, FloatArray], ...]

    def solve(self, right: FloatArray) -> FloatArray:
        """The solution (N, D, C) for right-hand sides (N, D, C)."""
        x, (size, columns) = right * self.scale[:, :, None], right.shape[1:]
        for fronts, (inverse, across) in zip(self.elimination.fronts, self.factors, strict=True):
            pivots, others = np.split(fronts.images, [fronts.pivots], axis=1)
            solved = inverse @ x[pivots].reshape(len(pivots), pivots.shape[1] * size, columns)
            x[pivots] = solved.reshape(*pivots.shape, size, columns)
            np.subtract.at(x, others, (across @ solved).reshape(*others.shape, size, columns))
        for fronts, (inverse, across) in zip(self.elimination.fronts[::-1], self.factors[::-1], strict=True):
            pivots, others = np.split(fronts.images, [fronts.pivots], axis=1)
            below = across.swapaxes(1, 2) @ x[others].reshape(len(pivots), others.shape[1] * size, columns)
            solved = inverse.swapaxes(1, 2) @ (x[pivots].reshape(below.shape) - below)
            x[pivots] = solved.reshape(*pivots.shape, size, columns)
        return x * self.scale[:, :, None]

    def inverse_diagonal(self) -> FloatArray:
        """The blocks (N, D, D) of the inverse on its diagonal, without the others (Takahashi et al. 1973)."""
        count, size = self.scale.shape
        result, known = np.empty((count, size, size)), dict[int, FloatArray]()
        for fronts, (inverse, across) in zip(self.elimination.fronts[::-1], self.factors[::-1], strict=True):
            for k, (number, parent) in enumerate(zip(fronts.number.tolist(), fronts.parent.tolist(), strict=True)):
                edge, places = inverse.shape[1], _expanded(fronts.places[k], size)
                joint = np.empty((edge + len(places), edge + len(places)))
                if len(places):
                    joint[edge:, edge:] = known[parent][np.ix_(places, places)]
                below = across[k] @ inverse[k]
                joint[edge:, :edge] = -joint[edge:, edge:] @ below
                joint[:edge, edge:] = joint[edge:, :edge].T
                joint[:edge, :edge] = inverse[k].T @ inverse[k] - below.T @ joint[edge:, :edge]
                known[number] = joint
                blocks = joint[:edge, :edge].reshape(fronts.pivots, size, fronts.pivots, size)
                pivots = np.arange(fronts.pivots)
                result[fronts.images[k, : fronts.pivots]] = blocks[pivots, :, pivots]
        return result * self.scale[:, :, None] * self.scale[:, None, :]


@lru_cache(maxsize=8)
def _remembered(count: int, image1: bytes, image2: bytes) -> tuple[tuple[Fronts, ...], BoolArray]:
    found = Elimination.of(count, *(np.frombuffer(ends, np.int64) for ends in (image1, image2)))
    return found.fronts, found.turned


def _lower_inverse(lower: FloatArray) -> FloatArray:
    """Of lower triangular matrices (B, K, K): of halves, where that takes fewer operations than a general inverse."""
    half = lower.shape[1] // 2
    if half < _HALVED:
        return np.asarray(np.linalg.inv(lower), dtype=np.float64)
    first, last = _lower_inverse(lower[:, :half, :half]), _lower_inverse(lower[:, half:, half:])
    result = np.zeros_like(lower)
    result[:, :half, :half], result[:, half:, half:] = first, last
    result[:, half:, :half] = -last @ (lower[:, half:, :half] @ first)
    return result


def _expanded(images: IntArray, size: int) -> IntArray:
    """The rows of images with blocks of a size."""
    return (images[:, None] * size + np.arange(size)).ravel()


def _members(
    front: IntArray, level: IntArray, order: IntArray, first: IntArray, later: IntArray
) -> tuple[IntArray, IntArray]:
    """The parent of each front (F,), and the images of all, ascending, as ``front * N + rank`` of elimination.

    Those of a front are its own and what is linked to these, or to what an earlier front has joined; ``later`` is the
    rank of the later image of each link (L,).
    """
    count, levels = len(front), int(level.max()) + 1
    parent = np.full(len(level), -1)
    outside = front[first] != front[order[later]]
    known = [np.empty(0, dtype=np.intp)] * levels  # by the level of the front

    def give(fronts: IntArray, ranks: IntArray) -> None:
        for k in np.unique(level[fronts]).tolist():
            chosen = level[fronts] == k
            known[k] = np.unique(np.concatenate([known[k], fronts[chosen] * count + ranks[chosen]]))

    give(front[first][outside], later[outside])
    for here in reversed(range(levels)):
        fronts, ranks = np.divmod(known[here], count)
        found, at = np.unique(fronts, return_index=True)
        parent[found] = front[order[ranks[at]]]
        inherited = front[order[ranks]] != parent[fronts]
        give(parent[fronts][inherited], ranks[inherited])
    pivots = front[order] * count + np.arange(count)
    return parent, np.sort(np.concatenate([pivots, *known]))


def dissection(count: int, image1: IntArray, image2: IntArray) -> tuple[IntArray, IntArray]:
    """The front of each image (N,), and how many times the graph was divided before each front, (F,)."""
    edges = sparse.coo_array((np.ones(len(image1)), (image1.astype(np.int32), image2.astype(np.int32))), (count, count))
    graph = edges.tocsr()
    part = csgraph.connected_components(graph, directed=False)[1].astype(np.intp)
    along = _coordinates(graph, part)
    front, levels, fronts, links = np.full(count, -1), [np.empty(0, dtype=np.intp)], 0, np.stack([image1, image2])
    images = np.arange(count)
    while len(images):
        part[images] = np.unique(part[images], return_inverse=True)[1].reshape(-1)
        of, size = part[images], np.bincount(part[images])
        # Of some ways to divide each part in two the one by the fewest images.
        fewest, second, eliminated = size.copy(), np.zeros(count, dtype=np.bool_), np.ones(count, dtype=np.bool_)
        for values, fraction in product(along.T, _FRACTIONS):
            order, half = images[np.lexsort((values[images], of))], np.zeros(count, dtype=np.bool_)
            half[order] = np.arange(len(order)) - np.repeat(np.cumsum(size) - size, size) >= np.repeat(
                fraction * size, size
            )
            cut = np.unique(links[:, half[links[0]] != half[links[1]]])
            ends = np.stack([np.bincount(part[cut[half[cut] == side]], minlength=len(size)) for side in (0, 1)])
            better = images[(ends.min(axis=0) < fewest)[of]]
            second[better], eliminated[better] = half[better], False
            divide = cut[half[cut] == np.argmin(ends, axis=0)[part[cut]]]
            eliminated[divide[(ends.min(axis=0) < fewest)[part[divide]]]] = True
            fewest = np.minimum(fewest, ends.min(axis=0))
        eliminated[images[((size <= _UNDIVIDED) | (size < _WORTHWHILE * fewest))[of]]] = True
        pivots = images[eliminated[images]]
        parts, number = np.unique(part[pivots], return_inverse=True)
        front[pivots] = fronts + number.reshape(-1)
        fronts += len(parts)
        levels.append(np.full(len(parts), len(levels) - 1))
        images = images[~eliminated[images]]
        part[images] = 2 * part[images] + second[images]
        links = links[:, ~eliminated[links].any(axis=0)]
    return front, np.concatenate(levels)


def _coordinates(graph: "sparse.csr_array", part: IntArray) -> FloatArray:
    """Coordinates (N, 4) of the images by their distances, in links, from the ends of their part.

    A link between images without a common neighbour, as wrong ones are, is as long as a way through all others.
    """
    both = (graph + graph.T).tocsr()
    both.data[:] = 1.0
    confirmed = both * (both @ both)
    far = both - (confirmed > 0).astype(np.float64)
    lengths = both + far * float(len(part))

    def distances(images: IntArray) -> FloatArray:
        found: FloatArray = csgraph.dijkstra(lengths, directed=False, indices=images, min_only=True)
        return found

    def farthest(away: FloatArray) -> IntArray:
        """Of each part the image that is farthest away."""
        order = np.lexsort((-away, part))
        return order[np.flatnonzero(np.diff(part[order], prepend=-1))]

    if np.bincount(part).max() <= _UNDIVIDED:
        return np.zeros((len(part), 1))
    one = distances(farthest(distances(farthest(np.zeros(len(part))))))
    other = distances(farthest(one))
    aside = distances(farthest(np.minimum(one, other)))
    x, y = one - other, aside - distances(farthest(aside))
    return np.stack([x, y, x + y, x - y], axis=1)
