"""A smooth field over each image, for what gains and vignetting leave of the differences in overlaps."""

import math
from collections.abc import Sequence

import numpy as np

from rdstitch.arrays import FloatArray
from rdstitch.compositing.cell_least_squares import DECIMALS, Prior, fit_robustly, solve
from rdstitch.compositing.overlap_cells import Cells
from rdstitch.compositing.photometric import bilinear_weights
from rdstitch.geometry.camera import Camera
from rdstitch.system.late_imports import sparse

_NODES = 7  # along each side of an image
_MAX_NODES = 50_000  # of all images: of more than some 1,000 each has fewer, so that the system stays bounded
_CELL_SIGMA = 0.03  # how well fields can explain the means of a cell, log units
_FIELD_SIGMA = 0.3  # log units that a field may stray from 0
# Log units to which images follow their own brightness, where they do: over _OWN_SIGMA / _RISE_SIGMA of an image.
_OWN_SIGMA = 0.02
_RISE_SIGMA = 0.1  # log units that a field may rise from one side of an image to the other
_BEND_SIGMA = 0.5  # log units that it may bend


def fit_fields(
    cells: Cells, values: FloatArray, cameras: Sequence[Camera], workers: int = 1
) -> tuple[FloatArray, FloatArray]:
    """Fields (N, B, B, C) beside gains and vignetting, and the errors (M, C)."""
    side, channels = _field_side(len(cameras)), values.shape[1]
    design = _field_design(cells, cameras, side)
    prior = _field_prior(np.zeros((len(cameras), channels)), side, _FIELD_SIGMA)
    weight = cells.content / _CELL_SIGMA**2
    fields, errors = fit_robustly(cells, design, weight, values, prior, clipped_weight=_CELL_SIGMA**-2, workers=workers)
    return fields.reshape(len(cameras), side, side, channels), errors


def fit_own_brightness(cells: Cells, wanted: FloatArray, cameras: Sequence[Camera], workers: int = 1) -> FloatArray:
    """Fields (N, B, B, C) of means ``wanted`` (N, C), that agree in the overlaps."""
    side, channels = _field_side(len(cameras)), wanted.shape[1]
    design = _field_design(cells, cameras, side)
    agree = np.zeros((len(cells.pair), channels))
    start = np.zeros((design.shape[1], channels))
    prior = _field_prior(wanted, side, _OWN_SIGMA)
    fields = solve(design, np.full(len(agree), _CELL_SIGMA**-2), agree, prior, start, workers)
    return np.round(fields, DECIMALS).reshape(len(cameras), side, side, channels)


def _field_side(count: int) -> int:
    """Nodes of a field along each side of one of so many images."""
    return max(2, min(_NODES, math.isqrt(_MAX_NODES // count)))


def _field_design(cells: Cells, cameras: Sequence[Camera], side: int) -> "sparse.csr_array":
    """What all nodes do to the cells, (M, nodes): four in either image."""
    rows, nodes = len(cells.pair), side**2
    columns, entries = np.empty((rows, 2, 4), dtype=np.int32), np.empty((rows, 2, 4))
    for end, image, chosen in cells.by_image():
        places, shares = bilinear_weights(cameras[image], cells.points[end, chosen], side)
        columns[chosen, end], entries[chosen, end] = image * nodes + places, (1 - 2 * end) * shares
    ends = 8 * np.arange(rows + 1, dtype=np.int32)
    return sparse.csr_array((entries.ravel(), columns.ravel(), ends), shape=(rows, len(cameras) * nodes))


def _field_prior(wanted: FloatArray, side: int, sigma: float) -> Prior:
    """Fields of means ``wanted`` (N, C), give or take ``sigma``, that rise and bend little."""
    nodes, one = side**2, np.eye(side)
    block = np.eye(nodes) / (sigma**2 * nodes)
    for order, change in ((1, _RISE_SIGMA), (2, _BEND_SIGMA)):
        step = np.diff(one, order, axis=0) * (side - 1) ** order
        for both in (np.kron(step, one), np.kron(one, step)):
            block += both.T @ both / (change**2 * max(1, len(both)))
    precision = sparse.csr_array(sparse.kron(sparse.eye_array(len(wanted)), block))
    along = np.column_stack([np.ones(side), np.linspace(-1.0, 1.0, side)])
    return Prior(
        precision,
        np.repeat(wanted, nodes, axis=0) / (sigma**2 * nodes),
        nodes,
        np.asarray(np.kron(along, along), dtype=np.float64),
    )
