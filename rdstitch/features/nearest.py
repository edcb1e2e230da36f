"""Mutual nearest neighbours with the ratio of the nearest to the second nearest, exactly and in bounded memory.

How alike descriptors are is an exact number: larger is more alike, and equal means equal. Floating-point sums depend on
the order of summation, hence on block sizes and threads. Here all terms are integers small enough for every partial sum
to be exact, so there is nothing to depend on.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray

from rdstitch.arrays import FloatArray
from rdstitch.features.keypoints import Descriptors, Features

# |a|² + |b|² and 2 a·b then stay below 2²³, where float32 still knows halves.
_MAX_NORM = 1024.0
_BYTES_EACH = 4  # of a similarity


class Similarity:
    """``-d²/2`` of descriptors, one matrix product a block; of bits ``d²`` is the Hamming distance.

    SIFT's and RootSIFT's are integers as they come; others are rounded to a grid of at most 1/512 of the largest
    norm. With the products of ``(a, 1, -|a|²/2)`` and ``(b, -|b|²/2, 1)`` the BLAS does all the work.
    """

    def __init__(self, descriptors1: Descriptors, descriptors2: Descriptors) -> None:
        self._bits = descriptors1.dtype == np.uint8
        both = [_as_numbers(descriptors) for descriptors in (descriptors1, descriptors2)]
        largest = float(np.sqrt(max(np.einsum("ij,ij->i", v, v).max(initial=0.0) for v in both)))
        # A power of two, so that integers stay integers.
        scale = np.float32(2.0 ** np.floor(np.log2(_MAX_NORM / largest)) if largest > 0 else 1.0)
        sides = []
        for descriptors, (one, half) in zip(both, ((-2, -1), (-1, -2)), strict=True):
            side = np.empty((len(descriptors), descriptors.shape[1] + 2), np.float32)
            values = side[:, :-2]
            np.rint(np.multiply(descriptors, scale, out=values), out=values)
            side[:, one] = 1.0
            side[:, half] = np.einsum("ij,ij->i", values, values) / np.float32(-2.0)
            sides.append(side)
        self._left, self._right = sides
        self._block = np.empty((0, len(self._right)), np.float32)

    def block(self, rows: NDArray[np.intp]) -> NDArray[np.float32]:
        """Similarities of some descriptors of image 1 to all of image 2, (R, M); the next call overwrites them."""
        # Fresh memory for every block would cost a fifth of the time.
        if len(self._block) < len(rows):
            self._block = np.empty((len(rows), len(self._right)), np.float32)
        return np.matmul(self._left[rows], self._right.T, out=self._block[: len(rows)])

    def pairs(self, rows: NDArray[np.intp], columns: NDArray[np.intp]) -> NDArray[np.float32]:
        """Similarities of single pairs of descriptors, (R,)."""
        return np.asarray(np.einsum("ij,ij->i", self._left[rows], self._right[columns]))

    def distance(self, similarity: NDArray[np.float32]) -> FloatArray:
        """The distance that a similarity stands for, in a unit of these descriptors; infinite for -inf."""
        squared = np.abs(2.0 * similarity.astype(np.float64))
        return squared if self._bits else np.sqrt(squared)


def _as_numbers(descriptors: Descriptors) -> NDArray[np.float32]:
    bits = descriptors.dtype == np.uint8
    return (np.unpackbits(descriptors.astype(np.uint8), axis=1) if bits else descriptors).astype(np.float32, copy=False)


@dataclass(frozen=True, eq=False)
class Locations:
    """Keypoints grouped by location: SIFT gives a point with several orientations as many descriptors.

    They compete with each other in the ratio test, which then loses the point, and would give several matches of
    one point. So what is matched is locations, as alike as the most alike of their descriptors.
    """

    # layer k holds the index of the (k+1)-th keypoint of each location that has one; the locations with the most
    # keypoints come first, so that every layer is a beginning of the one before
    layers: tuple[NDArray[np.intp], ...]
    count: NDArray[np.intp]  # (L,): number of keypoints of each location

    @classmethod
    def group(cls, points: FloatArray, chosen: NDArray[np.intp]) -> Self:
        """Group the chosen (C,), ascending, of the points (N, 2); keypoints of one location keep their order."""
        by_location = chosen[np.lexsort(points[chosen].T)]
        first = np.ones(len(chosen), dtype=np.bool_)
        first[1:] = (np.diff(points[by_location], axis=0) != 0.0).any(axis=1)
        starts = np.flatnonzero(first)
        count = np.diff(np.append(starts, len(chosen)))
        # Among equally many keypoints the first keypoint decides: the order of the input, not that of coordinates.
        order = np.lexsort((by_location[starts], -count))
        starts, count = starts[order], count[order]
        layers = [by_location[starts[count > k] + k] for k in range(int(count.max(initial=1)))]
        return cls(tuple(layers), count)

    def __len__(self) -> int:
        return len(self.layers[0])

    @property
    def order(self) -> NDArray[np.intp]:
        """The keypoints, layer after layer."""
        return np.concatenate(self.layers)

    def places(self, chosen: slice) -> list[NDArray[np.intp]]:
        """Index the keypoints of a range of locations in that order, a layer each."""
        places, offset = [], 0
        for layer in self.layers:
            in_layer = np.arange(offset + chosen.start, offset + min(chosen.stop, len(layer)))
            if len(in_layer):
                places.append(in_layer)
            offset += len(layer)
        return places

    def blocks(self, most: int) -> Iterator[slice]:
        """All locations in ranges with at most so many keypoints together, or with one location."""
        until = np.append(0, np.cumsum(self.count))
        start = 0
        while start < len(self):
            stop = max(start + 1, int(np.searchsorted(until, until[start] + most, side="right")) - 1)
            yield slice(start, stop)
            start = stop


def mutual_nearest(
    features1: Features, features2: Features, block_bytes: int, limit: float = np.inf
) -> tuple[NDArray[np.intp], FloatArray]:
    """Pairs of keypoints (M, 2) that are each other's nearest in descriptor space, and how distinct they are (M,).

    That is the distance to the nearest over the distance to the second nearest location, the worse of both directions;
    pairs of ``limit`` or more are left out, and so are those of which several are equally near. The matrix of
    similarities is made in blocks of ``block_bytes``, one row of it at least.
    """
    pairs, ratios = [np.zeros((0, 2), dtype=np.intp)], [np.zeros(0)]
    for chosen1, chosen2 in _comparable(features1, features2):
        one, two = Locations.group(features1.points, chosen1), Locations.group(features2.points, chosen2)
        similarity = Similarity(features1.descriptors[one.order], features2.descriptors[two.order])
        nearest, best, second = _two_best(similarity, one, two, block_bytes)
        distinct = np.flatnonzero(best > second)
        ratio = np.divide(*(similarity.distance(each[distinct]) for each in (best, second)))
        passed = ratio < limit
        pairs.append(_nearest_keypoints(similarity, one, two, distinct[passed], nearest[distinct[passed]]))
        ratios.append(ratio[passed])
    return np.concatenate(pairs), np.concatenate(ratios)


def _comparable(features1: Features, features2: Features) -> list[tuple[NDArray[np.intp], NDArray[np.intp]]]:
    """Indices of features that may match each other: those of either sign of the Laplacian, where there are signs."""
    signs = features1.laplacian_sign, features2.laplacian_sign
    if signs[0] is None or signs[1] is None:
        groups = [(np.arange(len(features1)), np.arange(len(features2)))]
    else:
        groups = [(np.flatnonzero(signs[0] == sign), np.flatnonzero(signs[1] == sign)) for sign in (-1, 1)]
    return [group for group in groups if all(map(len, group))]


def _two_best(
    similarity: Similarity, one: Locations, two: Locations, block_bytes: int
) -> tuple[NDArray[np.intp], NDArray[np.float32], NDArray[np.float32]]:
    """The nearest location in image 2 to each in image 1, how alike they are, and the best other pair of either.

    Where that is less alike, the two are each other's nearest. The descriptors are in the orders of the locations.
    """
    nearest = np.empty(len(one), dtype=np.intp)
    best, second = np.empty((2, len(one)), np.float32)
    # Of each location of image 2, the most alike of those whose nearest it is not.
    others = np.full(len(two), -np.inf, np.float32)
    for here in one.blocks(block_bytes // (_BYTES_EACH * len(two.order))):
        layers = one.places(here)
        block = _merge(similarity.block(np.concatenate(layers)), layers, two)
        index = np.arange(len(block))
        nearest[here] = block.argmax(axis=1)
        best[here] = block[index, nearest[here]]
        block[index, nearest[here]] = -np.inf
        second[here] = block.max(axis=1)
        np.maximum(others, block.max(axis=0), out=others)
    rivals = _rivals(nearest, best)
    return nearest, best, np.maximum.reduce([second, others[nearest], rivals])


def _rivals(nearest: NDArray[np.intp], best: NDArray[np.float32]) -> NDArray[np.float32]:
    """Compute how alike another location of image 1 is that has the same nearest, (L,).

    Of the most alike of these that is the best of the others; of the rest one that is no less alike than themselves.
    """
    order = np.lexsort((best, nearest))
    same = np.diff(nearest[order]) == 0
    rival = np.full(len(order), -np.inf, np.float32)
    rival[1:][same] = best[order][:-1][same]
    rival[:-1][same] = best[order][1:][same]
    by_location = np.empty_like(rival)
    by_location[order] = rival
    return by_location


def _merge(block: NDArray[np.float32], layers: list[NDArray[np.intp]], two: Locations) -> NDArray[np.float32]:
    """Reduce keypoints x keypoints to locations x locations, in place; returns the part that is the result."""
    top = block[: len(layers[0])]
    offset = len(top)
    for layer in layers[1:]:
        np.maximum(top[: len(layer)], block[offset : offset + len(layer)], out=top[: len(layer)])
        offset += len(layer)
    left = top[:, : len(two)]
    offset = len(two)
    for layer in two.layers[1:]:
        np.maximum(left[:, : len(layer)], top[:, offset : offset + len(layer)], out=left[:, : len(layer)])
        offset += len(layer)
    return left


def _nearest_keypoints(
    similarity: Similarity, one: Locations, two: Locations, location1: NDArray[np.intp], location2: NDArray[np.intp]
) -> NDArray[np.intp]:
    """Select the most alike pair of keypoints of each pair of locations, as indices into the features, shape (M, 2)."""
    count2 = two.count[location2]
    many = one.count[location1] * count2
    pair, first = np.repeat(np.arange(len(many)), many), np.cumsum(many) - many
    turn = np.arange(len(pair)) - first[pair]
    places = [
        np.cumsum([0, *map(len, side.layers)])[layer] + location[pair]
        for side, layer, location in ((one, turn // count2[pair], location1), (two, turn % count2[pair], location2))
    ]
    best = np.lexsort((-similarity.pairs(places[0], places[1]), pair))[first]
    return np.column_stack([side.order[place[best]] for side, place in zip((one, two), places, strict=True)])
