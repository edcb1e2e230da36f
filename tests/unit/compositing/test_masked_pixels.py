"""Transparent pixels get samples of the nearest opaque ones, in memory of some rows."""

import tracemalloc

import numpy as np
from scipy.spatial import KDTree

from rdstitch.compositing.masked_pixels import filled


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
    nearest = np.asarray(KDTree(np.argwhere(opaque)).query(hidden)[0])
    assert (np.linalg.norm(source - hidden, axis=1) <= 1.05 * nearest).all()  # distances of 5 x 5 chamfers


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
