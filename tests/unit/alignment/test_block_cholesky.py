"""Factors of sparse matrices of blocks, against dense ones."""

from collections.abc import Callable

import numpy as np
import pytest

from rdstitch.alignment.least_squares.block_cholesky import Elimination
from rdstitch.arrays import IntArray

_SIZE = 3


def _strip(rng: np.random.Generator) -> IntArray:
    """Lanes of images beside each other, a few of them joined to others far away, numbered at random."""
    count, wide = 240, 12
    links = {(k, k + step) for k in range(count) for step in (1, 2, wide, wide + 1) if k + step < count}
    links |= {tuple(sorted(pair)) for pair in rng.choice(count, (5, 2)).tolist() if pair[0] != pair[1]}
    numbered: IntArray = rng.permutation(count)[np.array(sorted(links))]
    return numbered


def _groups(rng: np.random.Generator) -> IntArray:
    """Pairs, a chain, a group that is linked throughout, and single images (the last three) without a link."""
    whole = [(a, b) for a in range(200, 240) for b in range(200, a)]
    return np.array(
        [*((2 * k, 2 * k + 1) for k in range(60)), *((k, k + 1) for k in range(120, 199)), *whole, (241, 240)]
    )


@pytest.mark.parametrize("graph", [_strip, _groups])
def test_solution_and_diagonal_of_the_inverse_are_those_of_the_dense_matrix(
    graph: Callable[[np.random.Generator], IntArray],
) -> None:
    rng = np.random.default_rng(2)
    image1, image2 = graph(rng).T
    count = int(max(image1.max(), image2.max())) + 4
    rows = rng.normal(size=(len(image1), 5, 2 * _SIZE))
    gram = rows.swapaxes(1, 2) @ rows
    # Units of the parameters that differ by far.
    units = 10.0 ** rng.uniform(-4, 4, (count, _SIZE))
    diagonal = np.zeros((count, _SIZE, _SIZE)) + 1e-2 * np.eye(_SIZE)
    np.add.at(diagonal, image1, gram[:, :_SIZE, :_SIZE])
    np.add.at(diagonal, image2, gram[:, _SIZE:, _SIZE:])
    diagonal *= units[:, :, None] * units[:, None, :]
    links = gram[:, _SIZE:, :_SIZE] * units[image2][:, :, None] * units[image1][:, None, :]
    dense = np.zeros((count, _SIZE, count, _SIZE))
    dense[image2, :, image1] = links
    dense[image1, :, image2] = links.swapaxes(1, 2)
    dense[np.arange(count), :, np.arange(count)] = diagonal
    inverse = np.linalg.inv(dense.reshape(count * _SIZE, -1) / np.outer(units, units)) / np.outer(units, units)

    elimination = Elimination.of(count, image1, image2)
    found = elimination.factorized(diagonal, links)
    right = rng.normal(size=(count, _SIZE, 4)) * units[..., None]
    expected = (inverse @ right.reshape(count * _SIZE, 4)).reshape(right.shape)
    np.testing.assert_allclose(found.solve(right) * units[..., None], expected * units[..., None], rtol=1e-6, atol=1e-8)
    blocks = inverse.reshape(count, _SIZE, count, _SIZE)[np.arange(count), :, np.arange(count)]
    np.testing.assert_allclose(found.inverse_diagonal(), blocks, rtol=1e-6, atol=1e-9 * np.abs(blocks).max())
    assert max(fronts.pivots for fronts in elimination.fronts) <= 40  # the strip is divided, the whole group is not
    for broken in ((diagonal, 3.0 * links), (-diagonal, links)):
        with pytest.raises(np.linalg.LinAlgError):
            elimination.factorized(*broken)


def test_factors_grow_little_faster_than_the_images() -> None:
    """Squares of images, each linked to eight around it: entries of the factors an image.

    Of four times as many images, and where one image in a hundred has a wrong link to some other one.
    """
    entries, rng = [], np.random.default_rng(4)
    for side, wrong in ((20, 0), (40, 0), (40, 16)):
        number = np.arange(side * side).reshape(side, side)
        steps = [(number[:-1], number[1:]), (number[:, :-1], number[:, 1:])]
        steps += [(number[:-1, :-1], number[1:, 1:]), (number[1:, :-1], number[:-1, 1:])]
        far = np.sort(rng.choice(side * side, (2, wrong), replace=False), axis=0)
        image1, image2 = (np.concatenate([*(step[k].ravel() for step in steps), far[k]]) for k in (0, 1))
        fronts = Elimination.of(side * side, image1, image2).fronts
        entries.append(sum(len(each.images) * each.pivots * each.images.shape[1] for each in fronts) / side**2)
    assert entries[1] < 1.5 * entries[0]
    assert entries[2] < 1.5 * entries[1]
