"""Brightness as a photographer would leave it: no step at any seam, and every region as bright as its own pictures.

Gains alone make the whole comparable, and carry the automatic exposure of one end of a flight to the other, where
bright ground is then burnt out. Here the correction of each picture is a smooth field instead of one factor: fields of
overlapping pictures make up for the difference between them, are as even as that allows, and tend to leave the
picture's own brightness alone (least squares over all pictures, a screened membrane). What is left over at low
frequency, and skies that differ, get a soft transition in the same way.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from rdstitch.arrays import FloatArray
from rdstitch.camera import Camera
from rdstitch.compositing.boxes import Box, cut
from rdstitch.compositing.field_solver import solve_fields
from rdstitch.compositing.gain_compensation import estimate_gains
from rdstitch.compositing.options import ExposureMethod
from rdstitch.compositing.photometric import Exposure, bilinear_weights, full_scale
from rdstitch.compositing.placed_picture import PlacedPicture
from rdstitch.compositing.survey import Survey, SurveyTile

_NODES = 7  # along each side of a picture
# Pictures are compared by the means of cells: so many along a picture that is not cut off.
_CELLS, _MAX_CELLS = 16, 150_000  # along a side of an overlap, and of all overlaps together
_MIN_BRIGHTNESS = 0.02
# How well the means of a cell agree, log units, where nothing but light differs; what differs by more counts less.
_CELL_SIGMA, _HUBER = 0.03, 1.345
_ROUNDS = 5
# How far a picture may stray from its own brightness, or, with gains that hold, from these (log units), and how much a
# field may rise, and bend, from one side of a picture to the other. Brightness follows the pictures' own over a
# distance of the first by the third, in pictures.
_OWN_SIGMA, _GAIN_SIGMA = 0.02, 0.3
_RISE_SIGMA, _BEND_SIGMA = 0.1, 0.5
# From here on, as a share of the full range, brightened samples are compressed instead of clipped.
_KNEE = 0.75
# Of a picture, and of all together.
_MEDIAN_SAMPLES, _MAX_MEDIAN_SAMPLES, _MEDIAN_ROUNDS = 2000, 400_000, 4


def estimate_exposure(
    survey: Survey, pictures: Sequence[PlacedPicture], method: ExposureMethod = "balanced"
) -> Exposure:
    """What makes pictures agree where they overlap, with the median brightness of the set kept.

    Parameters
    ----------
    method : str
        "gain": one factor per picture and channel, and one vignetting for all. "blocks": also a smooth field per
        picture. "balanced": gains and fields that stay near the pictures' own brightness at large scale, and nothing
        is clipped.
    """
    exposure, cameras = estimate_gains(survey, pictures), [picture.camera for picture in pictures]
    cells = None if method == "gain" else _compare(survey, exposure)
    if cells is not None:
        wanted, sigma = np.zeros_like(exposure.log_gain), _GAIN_SIGMA
        if method == "balanced":
            wanted, sigma = -_brightness_around(cells, exposure.log_gain), _OWN_SIGMA
        exposure = replace(exposure, fields=_fit_fields(cells, exposure, cameras, wanted, sigma))
    if method == "balanced" and any(t is not None and t.pixels.dtype.kind == "u" for t in survey.tiles):
        exposure = replace(exposure, knee=_KNEE)
    return _with_median_kept(exposure, survey, cameras)


@dataclass(frozen=True)
class _Cells:
    """Cells that two pictures show: pictures (M,), measured pixels of the middle in either (M, 2), difference (M, C).

    The difference is what the first picture is brighter by, log units; the overlap (N, N), sparse, of two pictures the
    share of the smaller one.
    """

    first: NDArray[np.intp]
    second: NDArray[np.intp]
    point1: FloatArray
    point2: FloatArray
    difference: FloatArray
    overlap: sparse.csr_array


def _compare(survey: Survey, exposure: Exposure) -> _Cells | None:
    """Means of the cells of every overlap, clipped samples included: a burnt-out sky must not end in a step either."""
    pairs, count = survey.pairs(), len(survey.tiles)
    found: list[tuple[FloatArray, ...]] = []
    shares = np.zeros(len(pairs))
    for index, (i, j) in enumerate(pairs.tolist()):
        a, b, box, seen = survey.overlap(i, j)
        shares[index] = seen.sum() / min(a.inside.sum(), b.inside.sum())
        side = max(2, round(max(*seen.shape, *a.inside.shape, *b.inside.shape) / _CELLS))
        pixels, x, y = _cell_means(seen, box, side)
        means = [_cell_values(tile, box, seen, side, pixels) for tile in (a, b)]
        good = (pixels > side**2 / 2) & (np.minimum(*means).min(axis=-1) > _MIN_BRIGHTNESS)
        values = [np.log(mean[good] + exposure.offset) for mean in means]
        found.append((x[good], y[good], values[0] - values[1]))
    which = np.repeat(np.arange(len(pairs)), [len(entry[0]) for entry in found])
    # Of thousands of overlaps, each needs fewer.
    few = np.s_[:: max(1, -(-len(which) // _MAX_CELLS))]
    if not len(which):
        return None
    x, y, difference = (np.concatenate([entry[k] for entry in found])[few] for k in range(3))
    ends = pairs[which[few]].T
    points = [np.empty((len(x), 2)) for _ in ends]
    for picture, shown in zip(ends, points, strict=True):
        for k, chosen in _by_picture(picture):
            shown[chosen] = survey.warps[k].source_points(x[chosen], y[chosen])
    good = np.isfinite(points[0]).all(axis=1) & np.isfinite(points[1]).all(axis=1)
    overlap = sparse.csr_array((shares, (pairs[:, 0], pairs[:, 1])), shape=(count, count))
    first, second = (end[good] for end in ends)
    point1, point2 = (shown[good] for shown in points)
    return _Cells(first, second, point1, point2, difference[good], sparse.csr_array(overlap + overlap.T))


def _by_picture(pictures: NDArray[np.intp]) -> list[tuple[int, NDArray[np.intp]]]:
    """Each picture of a list, and where it is there."""
    order = np.argsort(pictures, kind="stable")
    groups = np.split(order, np.flatnonzero(np.diff(pictures[order])) + 1)
    return [(int(pictures[group[0]]), group) for group in groups if len(group)]


def _cell_means(seen: NDArray[np.bool_], box: Box, side: int) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Number of pixels that count in each cell of a box, and their mean place on the reduced canvas."""
    x, y = np.arange(box[0], box[2], dtype=np.float64), np.arange(box[1], box[3], dtype=np.float64)[:, None]
    count, across, down = np.moveaxis(_cell_sums(np.stack([seen, seen * x, seen * y], axis=-1), side), -1, 0)
    with np.errstate(invalid="ignore"):
        return count, across / count, down / count


def _cell_values(tile: SurveyTile, box: Box, seen: NDArray[np.bool_], side: int, count: FloatArray) -> FloatArray:
    """Mean share of the full range in each cell, shape (m, n, C); NaN where nothing counts."""
    pixels = cut(tile.pixels, tile.box, box)
    with np.errstate(invalid="ignore"):
        mean = _cell_sums(pixels * seen[..., None], side) / (count[..., None] * full_scale(pixels.dtype))
    return np.nan_to_num(mean)


def _cell_sums(values: NDArray[Any], side: int) -> FloatArray:
    """Sums of values (h, w, C) over cells of ``side`` x ``side`` pixels; the last ones may be cut off.

    As products with matrices of ones and zeros, which are many times faster than sums along short axes, and exact for
    whole numbers.
    """
    height, width, channels = values.shape
    rows, columns = (np.arange(n) // side == np.arange(-(-n // side))[:, None] for n in (height, width))
    summed = rows.astype(np.float64) @ values.reshape(height, -1).astype(np.float64)
    return np.asarray(columns.astype(np.float64) @ summed.reshape(-1, width, channels), dtype=np.float64)


def _brightness_around(cells: _Cells, log_gain: FloatArray) -> FloatArray:
    """What each picture and its neighbours are brighter by than the average, (N, C).

    Neighbours count by the share that they have in common with the picture: what one picture alone is brighter by is to
    vanish.
    """
    weight = cells.overlap + sparse.eye_array(len(log_gain))
    return np.asarray(weight @ log_gain / weight.sum(axis=1)[:, None])


def _fit_fields(
    cells: _Cells, exposure: Exposure, cameras: Sequence[Camera], wanted: FloatArray, sigma: float
) -> FloatArray:
    """Fields (N, B, B, C), beside gains and vignetting, by iteratively reweighted least squares.

    ``wanted`` (N, C) is what they tend to, within ``sigma``.
    """
    count, channels = exposure.log_gain.shape
    signed = ((1.0, cells.first, cells.point1), (-1.0, cells.second, cells.point2))
    left = cells.difference - exposure.log_gain[cells.first] + exposure.log_gain[cells.second]
    begin, parts = 4 * np.arange(len(left) + 1), []
    for sign, picture, points in signed:
        columns, entries = np.empty((len(left), 4), dtype=np.intp), np.empty((len(left), 4))
        for k, chosen in _by_picture(picture):
            nodes, shares = bilinear_weights(cameras[k], points[chosen], _NODES)
            columns[chosen], entries[chosen] = k * _NODES**2 + nodes, sign * shares
            # Only the vignetting: there are no fields yet.
            left[chosen] -= sign * exposure.smooth_part(k, cameras[k], points[chosen])
        shape = (len(left), count * _NODES**2)
        parts.append(sparse.csr_array((entries.ravel(), columns.ravel(), begin), shape=shape))
    even, near = _field_prior(sigma)
    expected = sparse.kron(sparse.eye_array(count), near) @ np.repeat(wanted, _NODES**2, axis=0)
    prior = sparse.csr_array(sparse.kron(sparse.eye_array(count), even + near)), expected
    weight, fields = np.ones(len(left)), np.zeros((count, _NODES, _NODES, channels))
    for _ in range(_ROUNDS):
        fields = solve_fields((parts[0], parts[1]), weight / _CELL_SIGMA**2, left, prior, fields)
        values = fields.reshape(-1, channels)
        residual = np.abs(left - parts[0] @ values - parts[1] @ values).mean(axis=1)
        weight = 1.0 / np.maximum(1.0, residual / (_HUBER * _CELL_SIGMA))
    return fields


def _field_prior(sigma: float) -> tuple[sparse.csr_array, sparse.csr_array]:
    """Precision of one picture's nodes: fields rise and bend little; and are near to what is wanted."""
    n, one = _NODES, sparse.eye_array(_NODES)
    rise = sparse.diags_array([-1.0, 1.0], offsets=[0, 1], shape=(n - 1, n)) * (n - 1)
    bend = sparse.diags_array([1.0, -2.0, 1.0], offsets=[0, 1, 2], shape=(n - 2, n)) * (n - 1) ** 2
    total: Any = sparse.csr_array((n * n, n * n))
    for step, size in ((rise, _RISE_SIGMA), (bend, _BEND_SIGMA)):
        for both in (sparse.kron(step, one), sparse.kron(one, step)):
            total = total + both.T @ both / (size**2 * both.shape[0])
    return sparse.csr_array(total), sparse.csr_array(sparse.eye_array(n * n) / (sigma**2 * n * n))


def _with_median_kept(exposure: Exposure, survey: Survey, cameras: Sequence[Camera]) -> Exposure:
    """Gains with a common factor that leaves the median of all samples where it was."""
    values, logs = [], []
    limit = min(_MEDIAN_SAMPLES, max(1, _MAX_MEDIAN_SAMPLES // len(cameras)))
    for index, tile in enumerate(survey.tiles):
        if tile is None:
            continue
        where = np.flatnonzero(tile.inside)
        where = where[:: max(1, len(where) // limit)]
        y, x = (axis.astype(np.float64) for axis in np.unravel_index(where, tile.inside.shape))
        points = survey.warps[index].source_points(x + tile.box[0], y + tile.box[1])
        pixels = tile.pixels.reshape(-1, tile.pixels.shape[2])[where].astype(np.float64)
        values.append(pixels / full_scale(tile.pixels.dtype))
        logs.append(exposure.log_gain[index] + exposure.smooth_part(index, cameras[index], points))
    if not values:
        return exposure
    value, log = np.concatenate(values) + exposure.offset, np.concatenate(logs)
    known = np.isfinite(log).all(axis=1)
    value, log = value[known], log[known]
    target, common = float(np.median(value.mean(axis=1))), 0.0
    for _ in range(_MEDIAN_ROUNDS):
        common += float(np.log(np.median((value * np.exp(-log - common)).mean(axis=1)) / target)) if target > 0 else 0.0
    return replace(exposure, log_gain=exposure.log_gain + common)
