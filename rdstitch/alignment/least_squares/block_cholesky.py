"""Cholesky factors of the normal matrix of poses, which has a block for each image and for each two that a link joins.

Images are eliminated in the order of a nested dissection of the match graph (George 1973): images that divide it in two
come after those on either side, and so on within the sides, so that factors grow little faster than the number of
images. What is eliminated at a time is a dense front of a few images with those that are linked to them (the
multifrontal method; Duff and Reid 1983). The order depends on the links alone, and is found once.

Of 2,000 images with 14 links each SciPy's ``splu`` takes 1.3 to 2 times as long; it does not tell whether the matrix is
positive definite, nor give the inverse's blocks on the diagonal.
"""

from collections import Counter
from dataclasses import dataclass
from functools import lru_cache
from itertools import product
from typing import Self

import numpy as np

from rdstitch.arrays import BoolArray, FloatArray, IntArray
from rdstitch.system.late_imports import csgraph, sparse

_UNDIVIDED = 20  # images that are eliminated at once: what dense matrices do in less time than further division
_FRACTIONS = (0.4, 0.5, 0.6)  # of the images of a part on one side, where it may be divided
_HALVED = 16  # rows from which on half a triangular matrix is inverted by itself
_WORTHWHILE = 3  # times as many images a part must have as divide it; otherwise it is eliminated as one


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
        """The order for ``count`` images with links (L,) and (L,) between them.

        Of images 0-1-2-3-4 in a row, were two eliminated as one, image 3 would divide 0 1 2 from 4, and then 1 divide 0
        from 2. Fronts, the pivot first, are 0 1 and 2 1 3, whose parent is the front of 1; then 1 3 and 4 3, a batch of
        one shape, whose parent is the front of 3; then 3 alone.
        """
        front, level = dissection(count, image1, image2)
        order = np.lexsort((front, -level[front]))  # the images, those of the parts divided most first
        rank = np.empty(count, dtype=np.intp)
        rank[order] = np.arange(count)
        turned = rank[image1] > rank[image2]
        first, later = np.where(turned, [image2, image1], [image1, image2])
        parent, members = _members(front, level, order, first, rank[later])
        front_of_member, rank_of_member = np.divmod(members.key, count)
        image, in_parent = order[rank_of_member], members.places(parent[front_of_member], rank_of_member)
        owner = front[first]  # the front in which the block of each link is
        column, row = (members.places(owner, rank[end]) for end in (first, later))
        # Fronts of one level and shape are eliminated together.
        shape = np.stack([-level, np.bincount(front), np.diff(members.start)], axis=1)
        shapes, batch = np.unique(shape, axis=0, return_inverse=True)
        batch = batch.reshape(-1)
        by_batch, within = np.argsort(batch[owner], kind="stable"), np.empty(len(level), dtype=np.intp)
        result = []
        ends = np.searchsorted(batch[owner][by_batch], np.arange(1, len(shapes)))
        for k, links in enumerate(np.split(by_batch, ends)):
            number, pivots = np.flatnonzero(batch == k), int(shapes[k, 1])
            within[number] = np.arange(len(number))
            rows = members.start[number][:, None] + np.arange(shapes[k, 2])
            where = within[owner[links]], row[links], column[links]
            others = in_parent[rows[:, pivots:]]
            result.append(Fronts(image[rows], pivots, number, parent[number], others, links, where))
        return cls(tuple(result), turned)

    @classmethod
    def of_links(cls, count: int, image1: IntArray, image2: IntArray) -> Self:
        """:meth:`of`, kept for links that were asked for a short while ago."""
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
        children = Counter(parent for fronts in self.elimination.fronts for parent in fronts.parent.tolist())
        for fronts, (inverse, across) in zip(self.elimination.fronts[::-1], self.factors[::-1], strict=True):
            for k, (number, parent) in enumerate(zip(fronts.number.tolist(), fronts.parent.tolist(), strict=True)):
                edge, places = inverse.shape[1], _expanded(fronts.places[k], size)
                joint = np.empty((edge + len(places), edge + len(places)))
                if len(places):
                    joint[edge:, edge:] = known[parent][np.ix_(places, places)]
                    children[parent] -= 1
                    if not children[parent]:
                        del known[parent]
                below = across[k] @ inverse[k]
                joint[edge:, :edge] = -joint[edge:, edge:] @ below
                joint[:edge, edge:] = joint[edge:, :edge].T
                joint[:edge, :edge] = inverse[k].T @ inverse[k] - below.T @ joint[edge:, :edge]
                if children[number]:
                    known[number] = joint
                blocks = joint[:edge, :edge].reshape(fronts.pivots, size, fronts.pivots, size)
                pivots = np.arange(fronts.pivots)
                result[fronts.images[k, : fronts.pivots]] = blocks[pivots, :, pivots]
        return result * self.scale[:, :, None] * self.scale[:, None, :]


@lru_cache(maxsize=8)
def _remembered(count: int, image1: bytes, image2: bytes) -> tuple[tuple[Fronts, ...], BoolArray]:
    elimination = Elimination.of(count, *(np.frombuffer(ends, np.int64) for ends in (image1, image2)))
    return elimination.fronts, elimination.turned


def _lower_inverse(lower: FloatArray) -> FloatArray:
    """Invert lower triangular matrices (B, K, K), by halves where that takes fewer operations."""
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


@dataclass(frozen=True, eq=False)
class _Members:
    """The images of all fronts: for each front its pivots and what is linked to them, by rank of elimination."""

    key: IntArray  # ascending: ``front * count + rank``
    start: IntArray  # (F + 1,): where those of each front begin
    count: int  # images

    def places(self, front: IntArray, rank: IntArray) -> IntArray:
        """Where among those of a front the images of some ranks are."""
        places: IntArray = np.searchsorted(self.key, front * self.count + rank) - self.start[front]
        return places


def _members(
    front: IntArray, level: IntArray, order: IntArray, first: IntArray, later: IntArray
) -> tuple[IntArray, _Members]:
    """The parent of each front (F,), -1 without one, and the images of all.

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
    key = np.sort(np.concatenate([pivots, *known]))
    return parent, _Members(key, np.searchsorted(key, np.arange(len(level) + 1) * count), count)


def dissection(count: int, image1: IntArray, image2: IntArray) -> tuple[IntArray, IntArray]:
    """The front of each image (N,), and how many times the graph was divided before each front, (F,)."""
    if count <= _UNDIVIDED:
        return np.zeros(count, dtype=np.intp), np.zeros(1, dtype=np.intp)
    edges = sparse.coo_array((np.ones(len(image1)), (image1.astype(np.int32), image2.astype(np.int32))), (count, count))
    graph = edges.tocsr()
    part = csgraph.connected_components(graph, directed=False)[1].astype(np.intp)
    coordinates, links, images = _coordinates(graph, part), np.stack([image1, image2]), np.arange(count)
    front, levels, fronts = np.full(count, -1), [np.empty(0, dtype=np.intp)], 0
    while len(images):
        part[images] = np.unique(part[images], return_inverse=True)[1].reshape(-1)
        separator, second = _best_cuts(images, part, coordinates, links)
        pivots = images[separator[images]]
        parts, number = np.unique(part[pivots], return_inverse=True)
        front[pivots] = fronts + number.reshape(-1)
        fronts += len(parts)
        levels.append(np.full(len(parts), len(levels) - 1))
        images = images[~separator[images]]
        part[images] = 2 * part[images] + second[images]
        links = links[:, ~separator[links].any(axis=0)]
    return front, np.concatenate(levels)


def _best_cuts(
    images: IntArray, part: IntArray, coordinates: FloatArray, links: IntArray
) -> tuple[BoolArray, BoolArray]:
    """Which images divide the part that they are in, and which of the others are in its second half then, (N,) each.

    A part is cut across one of the coordinates (N, 4) at one of the :data:`_FRACTIONS`. Images at one end of the links
    that are cut divide it; of all cuts the one with the fewest counts. Where none is worthwhile all of a part are such.
    """
    of, size = part[images], np.bincount(part[images])
    place = np.arange(len(images)) - np.repeat(np.cumsum(size) - size, size)  # in its part, in any order
    fewest, second, separator = size.copy(), np.zeros(len(part), dtype=np.bool_), np.ones(len(part), dtype=np.bool_)
    for values, fraction in product(coordinates.T, _FRACTIONS):
        half = np.zeros(len(part), dtype=np.bool_)
        half[images[np.lexsort((values[images], of))]] = place >= np.repeat(fraction * size, size)
        ends = np.unique(links[:, half[links[0]] != half[links[1]]])
        counts = np.stack([np.bincount(part[ends[half[ends] == side]], minlength=len(size)) for side in (0, 1)])
        better = counts.min(axis=0) < fewest
        chosen, dividing = images[better[of]], ends[half[ends] == np.argmin(counts, axis=0)[part[ends]]]
        second[chosen], separator[chosen] = half[chosen], False
        separator[dividing[better[part[dividing]]]] = True
        fewest = np.minimum(fewest, counts.min(axis=0))
    separator[images[((size <= _UNDIVIDED) | (size < _WORTHWHILE * fewest))[of]]] = True
    return separator, second


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
        lengths_of_paths: FloatArray = csgraph.dijkstra(lengths, directed=False, indices=images, min_only=True)
        return lengths_of_paths

    def farthest(away: FloatArray) -> IntArray:
        """The image of each part that is farthest away."""
        order = np.lexsort((-away, part))
        return order[np.flatnonzero(np.diff(part[order], prepend=-1))]

    one = distances(farthest(distances(farthest(np.zeros(len(part))))))
    other = distances(farthest(one))
    aside = distances(farthest(np.minimum(one, other)))
    x, y = one - other, aside - distances(farthest(aside))
    return np.stack([x, y, x + y, x - y], axis=1)
