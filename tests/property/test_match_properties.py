"""Matching small sets with many ties, against the definition."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from rdstitch.features import Features, match


def features(descriptors: NDArray[np.float32], place: NDArray[np.float64]) -> Features:
    count = len(descriptors)
    zeros = np.zeros(count)
    return Features(np.column_stack([place, zeros]), descriptors, zeros + 1, zeros, zeros, None, "sift")


@settings(max_examples=200, deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1),
    counts=st.tuples(st.integers(0, 9), st.integers(0, 9)),
    places=st.integers(1, 12),
    block_bytes=st.integers(1, 300),
    ratio=st.sampled_from([0.5, 0.9, 1.0]),
)
def test_matches_of_locations(seed: int, counts: tuple[int, int], places: int, block_bytes: int, ratio: float) -> None:
    rng = np.random.default_rng(seed)
    one, two = (
        features(rng.integers(0, 4, (n, 3)).astype(np.float32), rng.integers(0, places, n).astype(np.float64))
        for n in counts
    )
    found = match(one, two, ratio, block_bytes)
    got = {(float(a[0]), float(b[0])) for a, b in zip(found.points1, found.points2, strict=True)}
    assert len(got) == len(found)

    place1, place2 = np.unique(one.points[:, 0]), np.unique(two.points[:, 0])
    table = np.array(
        [
            [
                min(
                    float(np.sum((a - b) ** 2))
                    for a in one.descriptors[one.points[:, 0] == p]
                    for b in two.descriptors[two.points[:, 0] == q]
                )
                for q in place2
            ]
            for p in place1
        ]
    ).reshape(len(place1), len(place2))
    wanted = set()
    for i, p in enumerate(place1):
        for j, q in enumerate(place2):
            rivals = np.append(np.delete(table[i], j), np.delete(table[:, j], i))
            rival = rivals.min(initial=np.inf)
            if table[i, j] < rival and np.sqrt(table[i, j]) < ratio * np.sqrt(rival):
                wanted.add((float(p), float(q)))
    assert got == wanted
