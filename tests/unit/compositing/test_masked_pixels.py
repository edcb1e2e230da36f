"""Transparent pixels get samples of the nearest opaque ones, in memory of some rows."""

import tracemalloc

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial import KDTree

from rdstitch.compositing.masked_pixels import OPAQUE, filled, opacity


def test_what_is_transparent_has_the_samples_of_the_nearest_opaque_pixel() -> None:
    rng = np.random.default_rng(0)
    height, width = 60, 80
    opaque = np.ones((height, width), dtype=np.bool_)
    opaque[:, 55:] = False
    opaque[10:25, 10:30] = rng.random((15, 20)) > 0.7
    y, x = np.mgrid[:height, :width]
    pixels = np.stack([x, y, np.zeros_like(x)], axis=-1).astype(np.uint8)
    made = filled(pixels, opaque)
    assert np.array_equal(made[opaque], pixels[opaque])
    hidden, source = np.argwhere(~opaque), made[~opaque][:, 1::-1].astype(np.intp)
    assert opaque[tuple(source.T)].all()
    nearest = KDTree(np.argwhere(opaque)).query(hidden)[0]
    assert (np.linalg.norm(source - hidden, axis=1) <= 1.05 * nearest).all()  # distances of 5 x 5 chamfers


def _masks() -> dict[str, NDArray[np.bool_]]:
    y, x = np.mgrid[:1100, :300]
    return {
        "sky": y > 700 + 0.3 * x,
        "ground": y < 300,
        "band": (y > 480) & (y < 520),
        "gap": (y < 100) | (y > 900),
        "circle": (x - 150) ** 2 + (y - 550) ** 2 < 140**2,
    }


@pytest.mark.parametrize("name", list(_masks()))
def test_rows_apart_give_what_the_whole_does_near_the_mask_and_opaque_samples_elsewhere(name: str) -> None:
    opaque = _masks()[name]
    pixels = np.where(opaque, np.random.default_rng(1).integers(1, 60000, opaque.shape), 0).astype(np.uint16)
    made = filled(pixels, opaque)
    hidden = (~opaque).astype(np.uint8)
    distance, labels = cv2.distanceTransformWithLabels(hidden, cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL)
    position = np.zeros(int(labels.max()) + 1, dtype=np.intp)
    position[labels[opaque]] = np.flatnonzero(opaque)
    near = distance <= 64
    np.testing.assert_array_equal(made[near], pixels.ravel()[position[labels[near]]])
    assert np.isin(made, pixels[opaque]).all()
    reach = 0.125 * min(opaque.shape)
    whole = np.asarray(cv2.distanceTransform(opaque.astype(np.uint8), cv2.DIST_L2, 5)) / np.float32(reach)
    np.testing.assert_allclose(opacity(opaque)[0] / OPAQUE, np.minimum(whole, np.float32(1.0)), atol=1e-5)


def test_where_nothing_is_opaque_there_is_nothing_to_fill_with() -> None:
    pixels = np.full((600, 20, 3), 7, dtype=np.uint8)
    assert np.array_equal(filled(pixels, np.zeros((600, 20), dtype=np.bool_)), pixels)


def test_memory_beyond_the_result_is_that_of_some_rows() -> None:
    opaque = np.zeros((3000, 1000), dtype=np.bool_)
    opaque[1500:] = True
    pixels = np.zeros((*opaque.shape, 3), dtype=np.uint8)
    tracemalloc.start()
    made = filled(pixels, opaque)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 2.5 * made.nbytes
