"""Nearest points, exactly: OpenCV's k-d tree, twice as fast as SciPy's, which takes 0.2 s to import."""

import cv2
import numpy as np

from rdstitch.arrays import FloatArray, IntArray

_SINGLE_TREE: dict[str, bool | int | float | str] = {"algorithm": 4}  # FLANN_INDEX_KDTREE_SINGLE
_EXACT: dict[str, bool | int | float | str] = {"checks": -1}


def nearest_points(points: FloatArray, queries: FloatArray, count: int) -> tuple[FloatArray, IntArray]:
    """The nearest points of each query.

    Of ``points`` (N, D), at least one, and ``queries`` (M, D): distances, ascending, and indices, both (M, K),
    where K is the smaller of ``count`` and N.
    """
    centre = points.mean(axis=0)  # of coordinates far from 0 float32 keeps little
    tree = cv2.flann.Index(np.ascontiguousarray(points - centre, np.float32), _SINGLE_TREE)
    indices, squared = tree.knnSearch(
        np.ascontiguousarray(queries - centre, np.float32), min(count, len(points)), params=_EXACT
    )
    return np.sqrt(squared, dtype=np.float64), indices.astype(np.intp)
