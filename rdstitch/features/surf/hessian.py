"""Blobs: maxima of the determinant of the Hessian over place and scale, by box filters (Bay et al., §3).

Box filters of twice the size, sampled at every second pixel, are the same filters on the image of half the size.
So an octave of SURF is the first octave on the next level of a pyramid, and needs neither large filters nor code of
its own.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from rdstitch.arrays import FloatArray, Rows
from rdstitch.features.surf.patches import Grey, from_level, pyramid

# The box filter of 9 pixels stands for a Gaussian of σ = 1.2 pixels; larger ones in proportion (§3.3).
SIGMA_PER_SIZE = 1.2 / 9

_MIN_LOBE = 3
# Weight of the mixed derivative, which the box filters get relatively wrong (§3.2).
_MIXED_WEIGHT = 0.9

# Rows worked on at a time, few enough that the intermediate results stay in the cache.
_STRIP_ROWS = 48


def vertex(values: NDArray[np.floating]) -> tuple[FloatArray, NDArray[np.bool_]]:
    """Locate the maximum of the quadric through each neighbourhood (N, 3, 3, 3) (Brown and Lowe, BMVC 2002).

    Neighbourhoods have the axes scale, row, column; offsets (N, 3) from the middle are in steps along column, row,
    scale, and zero where the quadric has no maximum, which is returned too, (N,).
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


@dataclass(frozen=True, eq=False)
class Blobs(Rows):
    """Blobs of one image."""

    points: FloatArray  # (N, 2): centres, pixels
    size: FloatArray  # (N,): side of the box filter that answers most, pixels
    response: FloatArray  # (N,): determinant of the Hessian, grey levels²
    # (N,), int8: sign of the trace of the Hessian: +1 for dark blobs, -1 for light ones
    laplacian_sign: NDArray[np.int8]

    @property
    def scale(self) -> FloatArray:
        """The s of the paper, pixels, shape (N,)."""
        return self.size * SIGMA_PER_SIZE


def find_blobs(grey: Grey, threshold: float, octaves: int, layers: int) -> Blobs:
    """Find blobs whose determinant of the Hessian, grey levels², is at least ``threshold``.

    Each octave of scale works on the image of half the size of the one before, with so many ``layers`` of scales at
    which there can be blobs; filters grow by 6 pixels from one to the next.
    """
    parts = []
    for octave, level in enumerate(pyramid(grey, octaves)):
        height = len(level)
        for start in range(0, height, _STRIP_ROWS):
            blobs = _blobs_of_rows(level, start, min(start + _STRIP_ROWS, height), threshold, layers)
            parts.append(
                Blobs(from_level(blobs.points, octave), blobs.size * 2**octave, blobs.response, blobs.laplacian_sign)
            )
    return Blobs.concatenate(parts)


def _blobs_of_rows(level: Grey, start: int, stop: int, threshold: float, layers: int) -> Blobs:
    """Blobs centred in rows ``start`` to ``stop`` of a level, pixels of the level."""
    height, width = level.shape
    lobes = [_MIN_LOBE + 2 * k for k in range(layers + 2)]
    # One row more on either side, to compare with.
    first, last = max(start - 1, 0), min(stop + 1, height)
    reach = (3 * lobes[-1]) // 2
    top = max(first - reach, 0)
    integral = np.asarray(cv2.integral(level[top : min(last + reach, height)]), np.int32)
    determinant = np.zeros((layers + 2, last - first, width), np.float32)
    trace = np.zeros_like(determinant)
    for k, lobe in enumerate(lobes):
        half = (3 * lobe) // 2
        rows = range(max(first, half), min(last, height - half))
        if len(rows) and width >= 3 * lobe:
            inside = np.s_[k, rows.start - first : rows.stop - first, half : width - half]
            determinant[inside], trace[inside] = _hessian(integral, rows.start - top, len(rows), lobe)
    layer, row, column = _maxima(determinant, threshold)
    centred = (row + first >= start) & (row + first < stop)
    layer, row, column = layer[centred], row[centred], column[centred]
    offset, is_maximum = vertex(_neighbourhoods(determinant, layer, row, column))
    kept = is_maximum & (np.abs(offset) <= 1).all(axis=1)
    layer, row, column, offset = layer[kept], row[kept], column[kept], offset[kept]
    return Blobs(
        points=np.column_stack([column, row + first]) + offset[:, :2],
        size=3.0 * (_MIN_LOBE + 2.0 * (layer + offset[:, 2])),
        response=determinant[layer, row, column].astype(np.float64),
        laplacian_sign=np.where(trace[layer, row, column] >= 0, 1, -1).astype(np.int8),
    )


def _hessian(
    integral: NDArray[np.int32], row: int, count: int, lobe: int
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Determinant and trace of the Hessian at ``count`` rows from ``row`` on, where a filter of 3 lobes fits.

    Sums over boxes are differences of the integral image; those along v are taken first and shared.
    """
    half = (3 * lobe) // 2
    width = integral.shape[1] - 3 * lobe

    def rows(offset: int) -> NDArray[np.int32]:
        return integral[row + offset : row + offset + count]

    def columns(values: NDArray[np.int32], offset: int) -> NDArray[np.int32]:
        return values[:, half + offset : half + offset + width]

    # D_uu and D_vv: three lobes of weights 1, -2, 1, each 2 lobe - 1 across.
    across = rows(lobe) - rows(1 - lobe)
    middle = columns(across, half + 1 - lobe) - columns(across, lobe - half)
    duu = columns(across, half + 1) - columns(across, -half) - 3 * middle
    along = rows(half + 1) - rows(-half) - 3 * (rows(half + 1 - lobe) - rows(lobe - half))
    dvv = columns(along, lobe) - columns(along, 1 - lobe)
    # D_uv: four square lobes around the centre's row and column.
    above_below = rows(0) - rows(-lobe) - rows(lobe + 1) + rows(1)
    duv = (
        columns(above_below, 0) - columns(above_below, -lobe) - columns(above_below, lobe + 1) + columns(above_below, 1)
    )
    pure = np.float32(1 / (lobe * (2 * lobe - 1)))
    mixed = np.float32(_MIXED_WEIGHT / lobe**2)
    uu, vv, uv = duu.astype(np.float32), dvv.astype(np.float32), duv.astype(np.float32)
    uu *= pure
    vv *= pure
    uv *= mixed
    return uu * vv - uv * uv, uu + vv


def _maxima(
    determinant: NDArray[np.float32], threshold: float
) -> tuple[NDArray[np.intp], NDArray[np.intp], NDArray[np.intp]]:
    """Layer, row and column of the values above the threshold that exceed all 26 neighbours."""
    maxima = []
    kernel = np.ones((3, 3), np.uint8)
    for layer in range(1, len(determinant) - 1):
        values = determinant[layer]
        row, column = np.nonzero((values > threshold) & (values == cv2.dilate(values, kernel)))
        inside = (row > 0) & (row < values.shape[0] - 1) & (column > 0) & (column < values.shape[1] - 1)
        row, column = row[inside], column[inside]
        around = _neighbourhoods(determinant, np.full(len(row), layer), row, column).reshape(-1, 27)
        unique = (around >= around[:, 13:14]).sum(axis=1) == 1
        maxima.append((np.full(int(unique.sum()), layer), row[unique], column[unique]))
    layers, rows, columns = (np.concatenate(part) for part in zip(*maxima, strict=True))
    return layers, rows, columns


def _neighbourhoods(
    determinant: NDArray[np.float32], layer: NDArray[np.intp], row: NDArray[np.intp], column: NDArray[np.intp]
) -> NDArray[np.float32]:
    """Values around places, shape (N, 3, 3, 3), axes layer, row, column."""
    places = np.stack([layer, row, column])[..., None, None, None] + np.indices((3, 3, 3))[:, None] - 1
    return np.asarray(determinant[tuple(places)])
