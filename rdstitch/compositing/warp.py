"""One resampling from the original: canvas pixels → plane → undistorted → measured pixels of one image."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Self

import numpy as np

from rdstitch.arrays import AnyArray, BoolArray, Float32Array, FloatArray
from rdstitch.compositing.boxes import Box, encloses, grown, intersection
from rdstitch.compositing.canvas import Canvas
from rdstitch.compositing.lattice import LATTICE_STEPS, Lattice
from rdstitch.compositing.projection import PLANE, Projection
from rdstitch.compositing.source_images import Displacement, PlacedImage
from rdstitch.geometry.camera import Camera
from rdstitch.geometry.radial_homography import to_plane

# Coordinates are computed on a lattice of the canvas and interpolated linearly, to this many pixels of the image or,
# where that gets smaller, of the canvas. OpenCV rounds them to as many afterwards.
_LATTICE_ERROR = 1.0 / 32.0

_PROBES = 16


@dataclass(frozen=True, eq=False)
class Surface:
    """A canvas that is no plane."""

    projection: Projection
    from_canvas: FloatArray  # (3, 3): canvas pixels to places of the projection, affine

    def directions(self, x: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Directions at canvas pixels, by coordinate."""
        a = self.from_canvas
        # Upright, as nearly all canvases are, each coordinate stays a single row or column of numbers.
        across = a[0, 0] * x + a[0, 2] if a[0, 1] == 0.0 else a[0, 0] * x + a[0, 1] * y + a[0, 2]
        down = a[1, 1] * y + a[1, 2] if a[1, 0] == 0.0 else a[1, 0] * x + a[1, 1] * y + a[1, 2]
        return self.projection.directions(across, down)


@dataclass(frozen=True, eq=False)
class Warp:
    """How the canvas is filled from one image."""

    camera: Camera
    # (3, 3): canvas pixels, or the directions of a projection, to normalized undistorted coordinates; third coordinate
    # positive in front of the camera
    from_canvas: FloatArray
    box: Box  # where the image can lie on the canvas: x0, y0, x1, y1, pixels, end exclusive
    step: int  # spacing of the coordinate lattice, canvas pixels
    shrink: float  # image pixels per canvas pixel (median over the image); above 1 the image gets smaller
    surface: "Surface | None" = None  # what gives directions to canvas pixels; None where the canvas is a plane
    displacement: Displacement | None = None  # added to the measured pixels

    def source_points(self, x: FloatArray, y: FloatArray) -> FloatArray:
        """Measured pixels (..., 2) of the image at canvas pixels ``x``, ``y``; NaN where there are none."""
        m = self.from_canvas
        dx, dy, dz = (x, y, 1.0) if self.surface is None else self.surface.directions(x, y)
        z = m[2, 0] * dx + m[2, 1] * dy + m[2, 2] * dz
        z = np.where(z > 0.0, z, np.nan)
        u = (m[0, 0] * dx + m[0, 1] * dy + m[0, 2] * dz) / z
        v = (m[1, 0] * dx + m[1, 1] * dy + m[1, 2] * dz) / z
        points = self.camera.distort(self.camera.denormalize(np.stack([u, v], axis=-1)))
        return points if self.displacement is None else points + self.displacement(points)

    def enlarged(self, ratio: float) -> Self:
        """The same onto a canvas with ``ratio`` times as many pixels along each side."""
        shift = 0.5 * ratio - 0.5
        back = np.array([[1.0 / ratio, 0.0, -shift / ratio], [0.0, 1.0 / ratio, -shift / ratio], [0.0, 0.0, 1.0]])
        x0, y0, x1, y1 = (v * ratio for v in self.box)
        box = math.floor(x0), math.floor(y0), math.ceil(x1), math.ceil(y1)
        finer = replace(self, box=box, shrink=self.shrink / ratio)
        if self.surface is None:
            return replace(finer, from_canvas=self.from_canvas @ back)
        return replace(finer, surface=replace(self.surface, from_canvas=self.surface.from_canvas @ back))

    def contains(self, x: AnyArray, y: AnyArray) -> BoolArray:
        """Which measured pixels lie in the image; NaN does not."""
        width, height = self.camera.image_size
        within: BoolArray = (x >= -0.5) & (x < width - 0.5) & (y >= -0.5) & (y < height - 0.5)
        if (radius := self.camera.drawn_radius) < math.inf:
            within &= (x - self.camera.center[0]) ** 2 + (y - self.camera.center[1]) ** 2 <= radius**2
        return within


@dataclass(frozen=True, eq=False)
class Geometry:
    """Where the pixels of one box of the canvas come from in one image; computed on demand."""

    warp: Warp
    box: Box  # x0, y0, x1, y1 on the canvas, pixels, end exclusive; it may reach beyond the canvas
    lattice: Lattice  # of this box or of a larger one

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
        """Whether the image certainly covers the box: it holds all nodes of the lattice, with half a pixel around."""
        points = self.lattice.nodes(self.box, self.lattice.step)
        limit = np.array(self.warp.camera.image_size, dtype=np.float32) - 1
        drawn = self.warp.camera.drawn_radius == math.inf or bool(self.warp.contains(*points.T).all())
        return drawn and bool((points >= 0).all() and (points <= limit).all())

    @cached_property
    def inside(self) -> BoolArray:
        """Which pixels (h, w) lie in the image."""
        return np.ones(self.shape, dtype=np.bool_) if self.filled else self.warp.contains(*self.maps)

    def on(self, box: Box) -> "Geometry":
        """The same for another box."""
        if encloses(self.lattice.box, box):
            return Geometry(self.warp, box, self.lattice)
        return locate(self.warp, box)


def plan_warp(
    camera: Camera, homography: FloatArray, canvas: Canvas, index: int, displacement: Displacement | None = None
) -> Warp:
    """Everything about the resampling of image ``index`` that does not depend on the tile."""
    if canvas.projection != PLANE:
        surface = Surface(canvas.projection, np.asarray(np.linalg.inv(canvas.matrix), dtype=np.float64))
        from_directions = np.asarray(np.linalg.inv(homography), dtype=np.float64)
        draft = Warp(camera, from_directions, canvas.box(index), 1, 1.0, surface, displacement)
        probes = canvas.place(camera, homography, np.concatenate([_grid(camera), camera.outline(_PROBES)]))
        return _measured(draft, probes, canvas)
    to_canvas = canvas.matrix @ homography
    from_canvas = np.asarray(np.linalg.inv(to_canvas), dtype=np.float64)
    outline = canvas.footprints[index]
    # The sign of a homography is free; its inverse must put the footprint in front of the camera.
    if from_canvas[2] @ np.array([*outline.mean(axis=0), 1.0]) < 0:
        to_canvas, from_canvas = -to_canvas, -from_canvas
    draft = Warp(camera, from_canvas, canvas.box(index), 1, 1.0, None, displacement)
    return _measured(draft, np.concatenate([to_plane(camera, to_canvas, _grid(camera)), outline]), canvas)


def _measured(draft: Warp, probes: FloatArray, canvas: Canvas) -> Warp:
    """The warp with the spacing and the shrinkage at canvas pixels all over the image, and with room in its box.

    That is for what a displacement moves beyond it.
    """
    warp = replace(draft, shrink=_shrink(draft, probes))
    warp, box = replace(warp, step=_lattice_step(warp, probes)), warp.box
    if warp.displacement is None:
        return warp
    moved = np.abs(warp.displacement(warp.camera.outline(_PROBES))).max() / warp.shrink
    return replace(warp, box=intersection(grown(box, int(np.ceil(moved)) + 1), (0, 0, *canvas.size)) or box)


def plan_warps(images: Sequence[PlacedImage], canvas: Canvas) -> list[Warp]:
    """The warps of all images."""
    return [plan_warp(p.camera, p.homography, canvas, k, p.displacement) for k, p in enumerate(images)]


def locate(warp: Warp, box: Box) -> Geometry:
    """Where the pixels of a box come from, and which of them lie in the image."""
    return Geometry(warp, box, Lattice.over(box, warp.step, warp.source_points))


def _grid(camera: Camera) -> FloatArray:
    """Measured pixels (K, 2) spread over an image."""
    width, height = camera.image_size
    grid = np.stack(np.meshgrid(np.linspace(0, width - 1, _PROBES), np.linspace(0, height - 1, _PROBES)), axis=-1)
    return grid.reshape(-1, 2)


def _lattice_step(warp: Warp, probes: FloatArray) -> int:
    """Widest spacing of the lattice whose interpolation error stays below the limit."""
    limit = _LATTICE_ERROR * max(1.0, warp.shrink)
    corners = np.array([(-1, -1), (-1, 1), (1, -1), (1, 1)])
    truth = warp.source_points(probes[:, 0], probes[:, 1])
    known = np.isfinite(truth).all(axis=1)
    for step in LATTICE_STEPS[:-1]:
        around = probes[known, None] + corners * (step / 2)
        error = warp.source_points(around[..., 0], around[..., 1]).mean(axis=1) - truth[known]
        if not ((error**2).sum(axis=1) < limit**2).all():
            continue
        around = probes[known, None] + corners * step
        if np.isfinite(warp.source_points(around[..., 0], around[..., 1])).all():
            return step
    return 1


def _shrink(warp: Warp, probes: FloatArray) -> float:
    """Median over the image of image pixels per canvas pixel."""
    offsets = np.array([(-0.5, 0.0), (0.5, 0.0), (0.0, -0.5), (0.0, 0.5)])
    around = probes[:, None] + offsets
    left, right, top, bottom = np.moveaxis(warp.source_points(around[..., 0], around[..., 1]), 1, 0)
    (ax, ay), (bx, by) = (right - left).T, (bottom - top).T
    return math.sqrt(float(np.nanmedian(np.abs(ax * by - ay * bx))))
