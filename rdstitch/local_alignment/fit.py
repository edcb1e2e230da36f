"""Displacements on the plane, one regularised field per picture, by robust sparse least squares over all pictures.

A match of the pictures i and j that the alignment puts ``r`` apart on the plane is explained by
``d_i(p_i) - d_j(p_j)``. Fields rise and bend little, and vanish where nothing supports them; that alone fixes what the
matches leave open, a displacement of all pictures together, at zero. Both coordinates have the same normal equations.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.linalg import splu

from rdstitch.arrays import FloatArray
from rdstitch.camera import Camera
from rdstitch.local_alignment.field import DisplacementField, bilinear, grid_shape, node_points
from rdstitch.local_alignment.matches import PlaneMatches, jacobians

# Residuals are trusted up to about this many times their median, but at least so many pixels; at first, up to this
# percentile of them, then by this factor less from round to round, and as many rounds at the end.
_ROBUST, _MIN_SCALE = 2.0, 0.3
_WIDEST, _SHARPENED, _SHARP_ROUNDS = 95.0, 0.5, 3
# A field vanishes over about this share of a picture where nothing supports it.
_FADE = 0.2
# Limit of the displacement's change per pixel: far from 1, where a picture would fold.
_MAX_GRADIENT = 0.25


@dataclass(frozen=True)
class Stiffness:
    """How freely fields bend.

    Attributes
    ----------
    cells : int
        Of the grid, along the longer side of a picture.
    slope : float
        Change of the displacement per pixel that is as likely as a residual of one robust scale.
    """

    cells: int
    slope: float


@dataclass(frozen=True, eq=False)
class PlaneFields:
    """Displacement of each picture on the plane, at the nodes of its grid.

    Attributes
    ----------
    shapes : tuple of (int, int)
        Rows and columns of nodes of each picture.
    values : tuple of ndarray of shape (m n, 2)
        Pixels of the median picture.
    """

    shapes: tuple[tuple[int, int], ...]
    values: tuple[FloatArray, ...]

    def at(self, cameras: Sequence[Camera], images: NDArray[np.intp], points: FloatArray) -> FloatArray:
        """Displacements (M, 2) of one picture each at its measured pixels (M, 2)."""
        found = np.empty((len(points), 2))
        for k in np.unique(images):
            chosen = images == k
            nodes, shares = bilinear(points[chosen], cameras[k].image_size, self.shapes[k])
            found[chosen] = (self.values[k][nodes] * shares[..., None]).sum(axis=1)
        return found

    def residual(self, cameras: Sequence[Camera], matches: PlaneMatches) -> FloatArray:
        """What they leave over at matches, (M, 2)."""
        first, second = (self.at(cameras, matches.images[:, k], matches.points[:, k]) for k in (0, 1))
        return np.asarray(matches.residual - first + second)


def fit_fields(matches: PlaneMatches, cameras: Sequence[Camera], stiffness: Stiffness) -> PlaneFields:
    """Fields of all pictures, by reweighted least squares with graduated non-convexity (Blake and Zisserman, 1987)."""
    shapes = tuple(grid_shape(camera.image_size, stiffness.cells) for camera in cameras)
    start = np.concatenate([[0], np.cumsum([rows * columns for rows, columns in shapes])])
    design = _design(matches, cameras, shapes, start)
    prior = sparse.block_diag(
        [_smoothness(shape, camera, stiffness) for shape, camera in zip(shapes, cameras, strict=True)], format="csr"
    )
    left, sharp = matches.residual, 0
    # Graduated: the first rounds trust all that may be right, so that the fields reach what is far from the plane.
    scale = float(np.percentile(np.linalg.norm(left, axis=1), _WIDEST))
    while sharp < _SHARP_ROUNDS:
        length = np.linalg.norm(left, axis=1)
        sharpest = max(_MIN_SCALE, _ROBUST * float(np.median(length)))
        sharp += scale <= sharpest
        scale = max(scale, sharpest)
        weight = (1.0 / (1.0 + (length / scale) ** 2)) ** 2 / scale**2
        weighted: Any = (sparse.diags_array(weight) @ design).T
        normal = sparse.csc_array(weighted @ design + prior)
        # Symmetric and positive: an ordering of A + A' and no pivoting leave a third of the fill-in.
        factor = splu(normal, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})
        solution = factor.solve(weighted @ matches.residual)
        left = matches.residual - design @ solution
        scale *= _SHARPENED
    return PlaneFields(shapes, tuple(np.split(solution, start[1:-1])))


def _design(
    matches: PlaneMatches, cameras: Sequence[Camera], shapes: Sequence[tuple[int, int]], start: NDArray[np.intp]
) -> sparse.csr_array:
    """Shares of all nodes in the difference of displacements at every match."""
    columns, entries = np.empty((len(matches), 8), dtype=np.intp), np.empty((len(matches), 8))
    for part, sign in enumerate((1.0, -1.0)):
        images, place = matches.images[:, part], np.s_[4 * part : 4 * part + 4]
        for k in np.unique(images):
            chosen = images == k
            nodes, shares = bilinear(matches.points[chosen, part], cameras[k].image_size, shapes[k])
            columns[chosen, place], entries[chosen, place] = start[k] + nodes, sign * shares
    rows = np.repeat(np.arange(len(matches)), 8)
    return sparse.csr_array((entries.ravel(), (rows, columns.ravel())), shape=(len(matches), int(start[-1])))


def _smoothness(shape: tuple[int, int], camera: Camera, stiffness: Stiffness) -> sparse.csr_array:
    """Precision of one picture's nodes, for residuals in units of their robust scale: a membrane and a thin plate."""
    rows, columns = shape
    spacing = max(camera.image_size) / stiffness.cells
    fade = _FADE * max(camera.image_size)
    total: Any = sparse.eye_array(rows * columns) * (spacing / fade) ** 2
    for order in (1, 2):
        steps = [_differences(n, order) for n in (rows, columns)]
        for both in (sparse.kron(steps[0], sparse.eye_array(columns)), sparse.kron(sparse.eye_array(rows), steps[1])):
            total = total + both.T @ both
    return sparse.csr_array(total / (stiffness.slope * spacing) ** 2)


def _differences(count: int, order: int) -> Any:
    """First or second differences of ``count`` values."""
    weights = {1: [-1.0, 1.0], 2: [1.0, -2.0, 1.0]}[order]
    return sparse.diags_array(weights, offsets=list(range(order + 1)), shape=(count - order, count))


def picture_fields(
    fields: PlaneFields, cameras: Sequence[Camera], homographies: FloatArray, scale: float
) -> tuple[DisplacementField, ...]:
    """The displacements in measured pixels of each picture, limited so that nothing folds."""
    done = []
    for shape, values, camera, matrix in zip(fields.shapes, fields.values, cameras, homographies, strict=True):
        points = node_points(camera.image_size, shape)
        with np.errstate(invalid="ignore"):
            jacobian = scale * jacobians(camera, matrix, points)
        usable = np.isfinite(jacobian).all(axis=(1, 2))
        found = np.zeros_like(values)
        found[usable] = np.linalg.solve(jacobian[usable], values[usable, :, None])[..., 0]
        field = DisplacementField.of(camera.image_size, found.reshape(*shape, 2))
        if field.steepest > _MAX_GRADIENT:
            field = DisplacementField.of(camera.image_size, field.values * (_MAX_GRADIENT / field.steepest))
        done.append(field)
    return tuple(done)
