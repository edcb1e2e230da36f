"""Maxima between samples: the vertex of the quadric through 3 x 3 x 3 values (Brown and Lowe, BMVC 2002)."""

import numpy as np
from numpy.typing import NDArray

from rdstitch.arrays import FloatArray


def vertex(values: NDArray[np.floating]) -> tuple[FloatArray, NDArray[np.bool_]]:
    """Where the quadric through each neighbourhood is largest.

    Parameters
    ----------
    values : ndarray of shape (N, 3, 3, 3)
        Axes scale, row, column.

    Returns
    -------
    offset : ndarray of shape (N, 3)
        Vertex relative to the middle, in steps along column, row, scale.
    is_maximum : ndarray of shape (N,), bool
        Whether the quadric has a maximum there; elsewhere the offset is zero.
    """
    n = values.astype(np.float64)
    middle = n[:, 1, 1, 1]
    gradient = np.stack(
        [n[:, 1, 1, 2] - n[:, 1, 1, 0], n[:, 1, 2, 1] - n[:, 1, 0, 1], n[:, 2, 1, 1] - n[:, 0, 1, 1]], axis=-1
    )
    uu = n[:, 1, 1, 2] + n[:, 1, 1, 0] - 2 * middle
    vv = n[:, 1, 2, 1] + n[:, 1, 0, 1] - 2 * middle
    ss = n[:, 2, 1, 1] + n[:, 0, 1, 1] - 2 * middle
    uv = (n[:, 1, 2, 2] - n[:, 1, 2, 0] - n[:, 1, 0, 2] + n[:, 1, 0, 0]) / 4
    us = (n[:, 2, 1, 2] - n[:, 2, 1, 0] - n[:, 0, 1, 2] + n[:, 0, 1, 0]) / 4
    vs = (n[:, 2, 2, 1] - n[:, 2, 0, 1] - n[:, 0, 2, 1] + n[:, 0, 0, 1]) / 4
    # Negative definite: leading minors alternate in sign (Sylvester).
    minor = uu * vv - uv**2
    determinant = ss * minor - us * (us * vv - uv * vs) + vs * (us * uv - uu * vs)
    is_maximum = (uu < 0) & (minor > 0) & (determinant < 0)
    second = np.stack([np.stack(row, axis=-1) for row in ((uu, uv, us), (uv, vv, vs), (us, vs, ss))], axis=-2)
    second[~is_maximum] = np.eye(3)
    offset = np.linalg.solve(second, -gradient[..., None] / 2)[..., 0]
    return np.where(is_maximum[:, None], offset, 0.0), is_maximum
