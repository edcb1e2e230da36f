"""Displacements on a plane or sphere, one regularised field per image, by robust sparse least squares over all images.

A match of the images i and j that the alignment puts ``r`` apart is explained by
``d_i(e_i) - d_j(e_j)``, where ``e`` is the pixel at which the alignment expects what is at the measured one: fields say
for each place of the output where its content is, so ``e`` is found anew from round to round. Fields rise and bend
little, and vanish where nothing supports them; that alone fixes what the matches leave open, a displacement of all
images together, at zero. All coordinates have the same normal equations. Between nodes the fit is bilinear, which
keeps its equations sparse; the field that is delivered, and judged, is a spline through the same nodes.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rdstitch.arrays import FloatArray
from rdstitch.geometry.camera import Camera
from rdstitch.local_alignment.field import DisplacementField, bilinear, grid_shape, node_points
from rdstitch.local_alignment.matches import ImagesOnSurface, PlacedMatches
from rdstitch.numerics.conjugate_gradients import conjugate_gradients
from rdstitch.numerics.robust_loss import robust_weight
from rdstitch.system.late_imports import sparse, sparse_linalg

_ROBUST = 2.0  # medians of the residuals, or their noise where relief makes them larger: width of the loss at the end
_MIN_SCALE = 0.3  # pixels: width of the loss at the least
_WIDEST = 95.0  # percentile of the residuals: width of the loss in the first round
_SHARPENED = 0.5  # factor of the width from round to round
_SHARP_ROUNDS = 2  # rounds with the last width
_FADE = 0.2  # share of an image over which a field vanishes where nothing supports it
_STEPS = 4  # of a fixed-point iteration to where the alignment expects something; each leaves the gradient's share
_MAX_GRADIENT = 0.5  # change of the displacement per pixel: half of what would fold an image
_FACTORIZED = 5000  # nodes of all images up to which equations are factorized as they are
_MIN_HALVED = 8  # cells of a grid from which on there is a coarser one
_TOLERANCE = 1e-6  # residual of the equations over their right side: a thousandth of a pixel
_SIGNS = np.array([1.0, -1.0])  # a residual leads from the second image to the first

Shapes = tuple[tuple[int, int], ...]  # rows and columns of the grid of each image


@dataclass(frozen=True)
class Stiffness:
    """How freely fields bend."""

    cells: int  # of the grid, along the longer side of an image
    slope: float  # change of the displacement per pixel that is as likely as a residual of one robust scale


@dataclass(frozen=True, eq=False)
class PlacedFields:
    """Displacement of each image on the plane or sphere, at the nodes of its grid."""

    images: ImagesOnSurface
    stiffness: Stiffness
    shapes: Shapes  # rows and columns of nodes of each image
    values: tuple[FloatArray, ...]  # (m n, D): pixels of the median image

    def unexplained(self, matches: PlacedMatches) -> tuple[FloatArray, FloatArray]:
        """What they leave over at matches, (M, D), and pixels (2 M, 2) where the alignment expects these."""
        values, expected = np.concatenate(self.values), matches.points.reshape(-1, 2)
        for _ in range(_STEPS):
            design = _design(matches, expected, self.images.cameras, self.shapes)
            expected = _expected(matches, self.images, design, values)
        return matches.residual - design @ values, expected

    @cached_property
    def delivered(self) -> tuple[DisplacementField, ...]:
        """What each image is displaced by in the output."""
        return tuple(map(self._of_image, range(len(self.shapes))))

    def _of_image(self, k: int) -> DisplacementField:
        """The displacement in measured pixels of an image, levelled where it is so steep that it might fold."""
        size = self.images.cameras[k].image_size
        points = node_points(size, self.shapes[k])
        with np.errstate(invalid="ignore"):
            shown = self.images.from_surface(k, self.images.to_surface(k, points) + self.values[k])
        displaced = np.where(np.isfinite(shown), shown - points, 0.0).reshape(*self.shapes[k], 2)
        return DisplacementField.of(size, DisplacementField(size, displaced).levelled(_MAX_GRADIENT).values)


class Reweighting:
    """Weights of residuals from round to round of reweighted least squares.

    The first rounds trust all that may be right, so that fits reach what is far from the plane: graduated
    non-convexity (Blake and Zisserman, 1987). They are not needed where the fit is nearly known.
    """

    def __init__(self, matches: PlacedMatches, *, known: bool = False) -> None:
        self._noise, self._sharp = matches.noise, int(known)
        self._scale = 0.0 if known else float(np.percentile(np.linalg.norm(matches.residual, axis=1), _WIDEST))

    def weights(self, residual: FloatArray) -> FloatArray | None:
        """Weights (M,) of matches by their residuals (M, D); None after the last round."""
        if self._sharp == _SHARP_ROUNDS:
            return None
        length = np.linalg.norm(residual, axis=1)
        sharpest = max(_MIN_SCALE, _ROBUST * min(float(np.median(length)), self._noise))
        self._sharp += self._scale <= sharpest
        scale = max(self._scale, sharpest)
        self._scale = scale * _SHARPENED
        return robust_weight(length**2, scale) / sharpest**2


def fit_fields(
    matches: PlacedMatches,
    images: ImagesOnSurface,
    stiffness: Stiffness,
    start: PlacedFields | None = None,
    base: PlacedFields | None = None,
) -> PlacedFields:
    """Fields of all images, by reweighted least squares.

    They start from fields that were fitted to much the same matches, and it is their difference from ``base``, of as
    many cells, that is stiff.
    """
    cameras = images.cameras
    shapes = tuple(grid_shape(camera.image_size, stiffness.cells) for camera in cameras)
    priors = [_smoothness(shape, camera.image_size, stiffness) for shape, camera in zip(shapes, cameras, strict=True)]
    prior, coarser = sparse.block_diag(priors, format="csr"), _coarser(shapes, cameras, stiffness.cells)
    known = np.zeros((prior.shape[0], matches.places.shape[-1])) if base is None else np.concatenate(base.values)
    residual, expected = (
        (matches.residual, matches.points.reshape(-1, 2)) if start is None else start.unexplained(matches)
    )
    reweighting, solution = Reweighting(matches, known=start is not None), known
    while (weight := reweighting.weights(residual)) is not None:
        design = _design(matches, expected, cameras, shapes)
        solution = known + _solve(design, weight, prior, matches.residual - design @ known, coarser)
        residual = matches.residual - design @ solution
        expected = _expected(matches, images, design, solution)
    return PlacedFields(images, stiffness, shapes, tuple(np.split(solution, _first_nodes(shapes)[1:-1])))


def _solve(
    design: "sparse.csr_array",
    weight: FloatArray,
    prior: "sparse.csr_array",
    residual: FloatArray,
    coarser: "sparse.csr_array | None",
) -> FloatArray:
    """All coordinates (nodes, D) of the fields.

    By conjugate gradients where values of ``coarser`` grids lead to those of the nodes: the equations of these grids
    are factorized, and solve what is smooth.
    """
    weighted = sparse.csr_array(design.T * weight)
    matrix, right = sparse.csr_array(weighted @ design + prior), weighted @ residual
    if coarser is None:
        return np.asarray(factorized(matrix).solve(right), dtype=np.float64)
    factor, finest = factorized(coarser.T @ matrix @ coarser), 1.0 / matrix.diagonal()[:, None]

    def smooth(residual: FloatArray) -> FloatArray:
        return np.asarray(coarser @ factor.solve(coarser.T @ residual), dtype=np.float64)

    return conjugate_gradients(
        matrix, right, smooth(right), lambda residual: finest * residual + smooth(residual), _TOLERANCE
    )


def factorized(matrix: Any) -> Any:
    """A sparse symmetric positive definite matrix, factorized."""
    symmetric: Any = {"permc_spec": "MMD_AT_PLUS_A", "diag_pivot_thresh": 0.0, "options": {"SymmetricMode": True}}
    return sparse_linalg.splu(sparse.csc_array(matrix), **symmetric)


def interpolation(nodes: NDArray[np.intp], shares: FloatArray, count: int) -> "sparse.csr_array":
    """Matrix from values at ``count`` nodes to those at places between four of them (N, 4), weighted so."""
    return sparse.csr_array((shares.ravel(), nodes.ravel(), np.arange(0, nodes.size + 1, 4)), shape=(len(nodes), count))


def _coarser(shapes: Shapes, cameras: Sequence[Camera], cells: int) -> "sparse.csr_array | None":
    """Matrix from the nodes of grids of half as many cells to those of all images; None where these are few."""
    if cells < _MIN_HALVED or _first_nodes(shapes)[-1] <= _FACTORIZED:
        return None
    parts = {}
    for shape, camera in zip(shapes, cameras, strict=True):
        if (size := camera.image_size) not in parts:
            few = grid_shape(size, cells // 2)
            parts[size] = interpolation(*bilinear(node_points(size, shape), size, few), few[0] * few[1])
    return sparse.csr_array(sparse.block_diag([parts[camera.image_size] for camera in cameras]))


def _expected(
    matches: PlacedMatches, images: ImagesOnSurface, design: "sparse.csr_array", values: FloatArray
) -> FloatArray:
    """Pixels (2 M, 2) at which the alignment expects matches, in images that are displaced by ``values`` at nodes."""
    sides = sparse.csr_array(
        (design.data, design.indices, np.arange(0, design.nnz + 1, 4, dtype=np.int32)),
        shape=(2 * len(matches), len(values)),
    )
    moved = (sides @ values).reshape(matches.places.shape) * _SIGNS[:, None]
    places, expected = (matches.places - moved).reshape(2 * len(matches), -1), matches.points.reshape(-1, 2).copy()
    for k, chosen in matches.of_image:
        shown = images.from_surface(k, places[chosen])
        expected[chosen] = np.where(np.isfinite(shown), shown, expected[chosen])
    return expected


def _design(
    matches: PlacedMatches, pixels: FloatArray, cameras: Sequence[Camera], shapes: Shapes
) -> "sparse.csr_array":
    """What all nodes do to the residuals of matches at pixels (2 M, 2): four in either image, shape (M, nodes)."""
    first = _first_nodes(shapes)
    columns, entries = np.empty((len(pixels), 4), dtype=np.int32), np.empty((len(pixels), 4))
    for k, chosen in matches.of_image:
        nodes, entries[chosen] = bilinear(pixels[chosen], cameras[k].image_size, shapes[k])
        columns[chosen] = first[k] + nodes
    entries *= np.tile(_SIGNS, len(matches))[:, None]
    rows = np.arange(0, columns.size + 1, 8, dtype=np.int32)
    return sparse.csr_array((entries.ravel(), columns.ravel(), rows), shape=(len(matches), int(first[-1])))


def _first_nodes(shapes: Shapes) -> NDArray[np.intp]:
    """Number of the first node of each image, and of all nodes."""
    return np.concatenate([[0], np.cumsum([rows * columns for rows, columns in shapes])])


@lru_cache(maxsize=8)
def _smoothness(shape: tuple[int, int], image_size: tuple[int, int], stiffness: Stiffness) -> "sparse.csr_array":
    """Precision of one image's nodes."""
    return smoothness(shape, max(image_size) / stiffness.cells, stiffness.slope, max(image_size))


def smoothness(shape: tuple[int, ...], spacing: float, slope: float, image_side: float) -> "sparse.csr_array":
    """Precision of the nodes of a grid, for residuals in units of their robust scale: a membrane and a thin plate."""
    rows, columns = shape
    total: Any = sparse.eye_array(rows * columns) * (spacing / (_FADE * image_side)) ** 2
    for weights in ([-1.0, 1.0], [1.0, -2.0, 1.0]):  # first and second differences
        order = len(weights) - 1
        steps = [sparse.diags_array(weights, offsets=range(order + 1), shape=(n - order, n)) for n in (rows, columns)]
        for both in (sparse.kron(steps[0], sparse.eye_array(columns)), sparse.kron(sparse.eye_array(rows), steps[1])):
            total = total + both.T @ both
    return sparse.csr_array(total / (slope * spacing) ** 2)
