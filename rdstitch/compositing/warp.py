"""One resampling from the original: canvas pixels → plane → undistorted → measured pixels of one picture."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rdstitch.arrays import FloatArray
from rdstitch.camera import Camera
from rdstitch.compositing.boxes import Box, Float32Array, encloses, grown, intersection
from rdstitch.compositing.canvas import Canvas
from rdstitch.compositing.lattice import LATTICE_STEPS, Lattice
from rdstitch.compositing.placed_picture import Displacement, PlacedPicture
from rdstitch.compositing.projection import PLANE, Projection
from rdstitch.radial_homography import to_plane

# Coordinates are computed on a lattice of the canvas and interpolated linearly, to this many pixels of the picture.
# OpenCV rounds them to 1/32 pixel afterwards.
_LATTICE_ERROR = 0.01
_PROBES = 16


@dataclass(frozen=True)
class Surface:
    """A canvas that is no plane.

    Attributes
    ----------
    projection : Projection
    from_canvas : ndarray of shape (3, 3)
        Canvas pixels to places of the projection, affine.
    """

    projection: Projection
    from_canvas: FloatArray

    def directions(self, x: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Directions at canvas pixels, by coordinate."""
        a = self.from_canvas
        # Upright, as nearly all canvases are, each coordinate stays a single row or column of numbers.
        across = a[0, 0] * x + a[0, 2] if a[0, 1] == 0.0 else a[0, 0] * x + a[0, 1] * y + a[0, 2]
        down = a[1, 1] * y + a[1, 2] if a[1, 0] == 0.0 else a[1, 0] * x + a[1, 1] * y + a[1, 2]
        return self.projection.directions(across, down)


@dataclass(frozen=True)
class Warp:
    """How the canvas is filled from one picture.

    Attributes
    ----------
    camera : Camera
    from_canvas : ndarray of shape (3, 3)
        Canvas pixels, or the directions of a projection, to normalized undistorted coordinates; third coordinate
        positive in front of the camera.
    box : (int, int, int, int)
        Where the picture can lie on the canvas: x0, y0, x1, y1, pixels, end exclusive.
    step : int
        Spacing of the coordinate lattice, canvas pixels.
    shrink : float
        Picture pixels per canvas pixel (median over the picture); above 1 the picture gets smaller.
    surface : Surface or None
        What gives directions to canvas pixels; None where the canvas is a plane.
    displacement : callable, optional
        Added to the measured pixels.
    """

    camera: Camera
    from_canvas: FloatArray
    box: Box
    step: int
    shrink: float
    surface: "Surface | None" = None
    displacement: Displacement | None = None

    def source_points(self, x: FloatArray, y: FloatArray) -> FloatArray:
        """Measured pixels (..., 2) of the picture at canvas pixels ``x``, ``y``; NaN where there are none."""
        m = self.from_canvas
        if self.surface is None:
            z = m[2, 0] * x + m[2, 1] * y + m[2, 2]
            z = np.where(z > 0.0, z, np.nan)
            u = (m[0, 0] * x + m[0, 1] * y + m[0, 2]) / z
            v = (m[1, 0] * x + m[1, 1] * y + m[1, 2]) / z
        else:
            dx, dy, dz = self.surface.directions(x, y)
            z = m[2, 0] * dx + m[2, 1] * dy + m[2, 2] * dz
            z = np.where(z > 0.0, z, np.nan)
            u = (m[0, 0] * dx + m[0, 1] * dy + m[0, 2] * dz) / z
            v = (m[1, 0] * dx + m[1, 1] * dy + m[1, 2] * dz) / z
        points = self.camera.distort(self.camera.denormalize(np.stack([u, v], axis=-1)))
        return points if self.displacement is None else points + self.displacement(points)

    def contains(self, x: NDArray[Any], y: NDArray[Any]) -> NDArray[np.bool_]:
        """Which measured pixels lie in the picture; NaN does not."""
        width, height = self.camera.image_size
        within: NDArray[np.bool_] = (x >= -0.5) & (x < width - 0.5) & (y >= -0.5) & (y < height - 0.5)
        if (radius := self.camera.drawn_radius) < math.inf:
            within &= (x - self.camera.center[0]) ** 2 + (y - self.camera.center[1]) ** 2 <= radius**2
        return within


@dataclass(frozen=True, eq=False)
class Geometry:
    """Where the pixels of one box of the canvas come from in one picture; computed on demand.

    Attributes
    ----------
    warp : Warp
    box : (int, int, int, int)
        x0, y0, x1, y1 on the canvas, pixels, end exclusive; it may reach beyond the canvas.
    lattice : Lattice
        Of this box or of a larger one.
    """

    warp: Warp
    box: Box
    lattice: Lattice

    @property
    def shape(self) -> tuple[int, int]:
        """Height and width of the box."""
        return self.box[3] - self.box[1], self.box[2] - self.box[0]

    @cached_property
    def maps(self) -> tuple[Float32Array, Float32Array]:
        """Measured pixels x and y, (h, w) each, far outside where there are none."""
        return self.lattice.maps(self.box)

    @cached_property
    def filled(self) -> bool:
        """Whether the picture certainly covers the box: it holds all nodes of the lattice, with half a pixel around."""
        points = self.lattice.nodes(self.box, self.lattice.step)
        limit = np.array(self.warp.camera.image_size, dtype=np.float32) - 1
        drawn = self.warp.camera.drawn_radius == math.inf or bool(self.warp.contains(*points.T).all())
        return drawn and bool((points >= 0).all() and (points <= limit).all())

    @cached_property
    def inside(self) -> NDArray[np.bool_]:
        """Which pixels (h, w) lie in the picture."""
        return np.ones(self.shape, dtype=np.bool_) if self.filled else self.warp.contains(*self.maps)

    def on(self, box: Box) -> "Geometry":
        """The same for another box."""
        if encloses(self.lattice.box, box):
            return Geometry(self.warp, box, self.lattice)
        return locate(self.warp, box)


def plan_warp(
    camera: Camera, homography: FloatArray, canvas: Canvas, index: int, displacement: Displacement | None = None
) -> Warp:
    """Everything about the resampling of picture ``index`` that does not depend on the tile."""
    if canvas.projection != PLANE:
        surface = Surface(canvas.projection, np.asarray(np.linalg.inv(canvas.matrix), dtype=np.float64))
        from_directions = np.asarray(np.linalg.inv(homography), dtype=np.float64)
        draft = Warp(camera, from_directions, canvas.boxes()[index], 1, 1.0, surface, displacement)
        probes = canvas.place(camera, homography, np.concatenate([_grid(camera), camera.outline(_PROBES)]))
        return _measured(draft, probes, canvas)
    to_canvas = canvas.matrix @ homography
    from_canvas = np.asarray(np.linalg.inv(to_canvas), dtype=np.float64)
    outline = canvas.footprints[index]
    # The sign of a homography is free; its inverse must put the footprint in front of the camera.
    if from_canvas[2] @ np.array([*outline.mean(axis=0), 1.0]) < 0:
        to_canvas, from_canvas = -to_canvas, -from_canvas
    box = canvas.boxes()[index]
    draft = Warp(camera, from_canvas, box, 1, 1.0, None, displacement)
    probes = _probes(camera, to_canvas, outline)
    return _measured(draft, probes, canvas)


def _measured(draft: Warp, probes: FloatArray, canvas: Canvas) -> Warp:
    """The warp with its box, and with the spacing and the shrinkage at canvas pixels all over the picture."""
    draft = replace(draft, shrink=_shrink(draft, probes))
    return replace(draft, box=_reached(draft, canvas), step=_lattice_step(draft, probes))


def _reached(warp: Warp, canvas: Canvas) -> Box:
    """The warp's box with room for what a displacement moves beyond it."""
    if warp.displacement is None:
        return warp.box
    moved = np.abs(warp.displacement(warp.camera.outline(_PROBES))).max() / warp.shrink
    return intersection(grown(warp.box, int(np.ceil(moved)) + 1), (0, 0, *canvas.size)) or warp.box


def plan_warps(pictures: Sequence[PlacedPicture], canvas: Canvas) -> list[Warp]:
    """The warps of all pictures."""
    return [plan_warp(p.camera, p.homography, canvas, k, p.displacement) for k, p in enumerate(pictures)]


def locate(warp: Warp, box: Box) -> Geometry:
    """Where the pixels of a box come from, and which of them lie in the picture."""
    return Geometry(warp, box, Lattice.over(box, warp.step, warp.source_points))


def _probes(camera: Camera, to_canvas: FloatArray, outline: FloatArray) -> FloatArray:
    """Canvas pixels (K, 2) spread over the picture, its outline included."""
    return np.concatenate([to_plane(camera, to_canvas, _grid(camera)), outline])


def _grid(camera: Camera) -> FloatArray:
    """Measured pixels (K, 2) spread over a picture."""
    width, height = camera.image_size
    grid = np.stack(np.meshgrid(np.linspace(0, width - 1, _PROBES), np.linspace(0, height - 1, _PROBES)), axis=-1)
    return grid.reshape(-1, 2)


def _lattice_step(warp: Warp, probes: FloatArray) -> int:
    """Widest spacing of the lattice whose interpolation error stays below the limit."""
    corners = np.array([(-1, -1), (-1, 1), (1, -1), (1, 1)])
    truth = warp.source_points(probes[:, 0], probes[:, 1])
    known = np.isfinite(truth).all(axis=1)
    for step in LATTICE_STEPS[:-1]:
        around = probes[:, None] + corners * step
        reach = warp.source_points(around[..., 0], around[..., 1])
        around = probes[:, None] + corners * (step / 2)
        near = warp.source_points(around[..., 0], around[..., 1])
        error = np.linalg.norm(near.mean(axis=1) - truth, axis=1)[known]
        if np.isfinite(reach[known]).all() and (error < _LATTICE_ERROR).all():
            return step
    return 1


def _shrink(warp: Warp, probes: FloatArray) -> float:
    """Median over the picture of picture pixels per canvas pixel."""
    offsets = np.array([(-0.5, 0.0), (0.5, 0.0), (0.0, -0.5), (0.0, 0.5)])
    around = probes[:, None] + offsets
    left, right, top, bottom = np.moveaxis(warp.source_points(around[..., 0], around[..., 1]), 1, 0)
    (ax, ay), (bx, by) = (right - left).T, (bottom - top).T
    return math.sqrt(float(np.nanmedian(np.abs(ax * by - ay * bx))))
