"""Covariances where neighbouring errors agree: a sandwich over cells, but no less than independent errors give."""

import numpy as np
import pytest

from rdstitch.arrays import FloatArray
from rdstitch.camera import Camera
from rdstitch.robust.covariance import covariances
from rdstitch.robust.measurements import Measurements

LENS = Camera((600, 800))  # half a diagonal of 500 pixels: cells of 100


def _data(cells: list[tuple[int, int]], each: int = 3) -> Measurements:
    """So many points in each cell of 100 pixels around the centre."""
    middle = np.repeat(np.asarray(cells, dtype=np.float64) + 0.5, each, axis=0)
    jitter = np.random.default_rng(0).uniform(-0.45, 0.45, middle.shape)
    points = 100.0 * (middle + jitter) + LENS.center
    return Measurements.from_pixels(points, points, LENS, LENS)


CELLS = [(0, 0), (-1, 0), (1, 2), (-3, -4), (2, -1), (-2, 3)]
DATA = _data(CELLS)
A = np.array([[4.0, 1.0, 0.0], [1.0, 3.0, 0.5], [0.0, 0.5, 2.0]])


def _influence(size: float) -> FloatArray:
    found = np.zeros((1, DATA.present.shape[1], 3))
    found[0, :18] = size * np.random.default_rng(1).normal(size=(18, 3))
    return found


def _clustered(influence: FloatArray) -> FloatArray:
    sums = influence[0, :18].reshape(6, 3, 3).sum(axis=1)
    inverse = np.linalg.inv(A)
    return np.asarray(inverse @ (sums.T @ sums) @ inverse)


def test_independent_errors_give_the_inverse_of_the_information() -> None:
    found = covariances(A[None], _influence(1e-6), np.array([0.5]), DATA)[0]
    np.testing.assert_allclose(found, 0.25 * np.linalg.inv(A), rtol=1e-6)


def test_errors_that_agree_within_cells_give_the_sandwich() -> None:
    influence = _influence(100.0)
    found = covariances(A[None], influence, np.array([0.5]), DATA)[0]
    np.testing.assert_allclose(found, _clustered(influence), rtol=1e-6)


@pytest.mark.parametrize("size", [0.3, 1.0])
def test_no_direction_has_less_than_either(size: float) -> None:
    influence = _influence(size)
    found = covariances(A[None], influence, np.array([1.0]), DATA)[0]
    for least in (np.linalg.inv(A), _clustered(influence)):
        assert np.linalg.eigvalsh(found - least).min() > -1e-9
    assert np.linalg.eigvalsh(found - np.linalg.inv(A) - _clustered(influence)).max() < 1e-9


def test_pairs_do_not_mix() -> None:
    both = DATA.take(np.array([0, 0]))
    influence = np.concatenate([_influence(100.0), _influence(1e-6)])
    found = covariances(np.stack([A, A]), influence, np.array([0.5, 0.5]), both)
    np.testing.assert_allclose(found[0], _clustered(influence[:1]), rtol=1e-6)
    np.testing.assert_allclose(found[1], 0.25 * np.linalg.inv(A), rtol=1e-6)


def test_what_is_not_determined_is_infinite() -> None:
    singular = np.diag([1.0, 1.0, 0.0])
    redundant = np.array([[1.0, 1.0, 0.0], [1.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
    broken = np.full((3, 3), np.nan)
    data = DATA.take(np.zeros(4, dtype=np.intp))
    found = covariances(np.stack([singular, redundant, broken, A]), np.zeros((4, 20, 3)), np.ones(4), data)
    assert np.isinf(found[:3]).all()
    np.testing.assert_allclose(found[3], np.linalg.inv(A), rtol=1e-9)


def test_all_that_is_far_out_is_one_cell() -> None:
    """Beyond 32 cells from the centre, as a damaged camera file may put it."""
    far = _data([(40, 0), (60, 0)])
    influence = np.zeros((1, far.present.shape[1], 3))
    influence[0, :6] = 10.0 * np.random.default_rng(2).normal(size=(6, 3))
    total = influence[0].sum(axis=0)
    found = covariances(A[None], influence, np.array([1e-6]), far)[0]
    inverse = np.linalg.inv(A)
    np.testing.assert_allclose(found, inverse @ np.outer(total, total) @ inverse, rtol=1e-5, atol=1e-9)
