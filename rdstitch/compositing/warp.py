"""One resampling from the original: canvas pixels → plane → undistorted → measured pixels of one image.

Coordinates are computed on a lattice of the canvas, and interpolated linearly between its nodes.
"""

import math
from collections.abc import Callable, Sequence
from functools import cached_property
from typing import Any, Self

import cv2
import numpy as np
from numpy.typing import NDArray

from rdstitch.arrays import FloatArray
from rdstitch.compositing.boxes import Box, Float32Array, encloses, grown, intersection
from rdstitch.compositing.canvas import Canvas
from rdstitch.compositing.projection import PLANE, Projection
from rdstitch.compositing.source_images import Displacement, LoadedImage, PlacedImage
from rdstitch.compositing.transparency import OPAQUE
from rdstitch.geometry.camera import Camera
from rdstitch.geometry.radial_homography import to_plane
from rdstitch.system.dataclasses import dataclass, replace

LATTICE_STEPS = (32, 16, 8, 4, 2, 1)
"""Spacings of lattices, canvas pixels; all have the nodes of the first."""

INTERPOLATION = {"linear": cv2.INTER_LINEAR, "cubic": cv2.INTER_CUBIC, "lanczos": cv2.INTER_LANCZOS4}
_NOWHERE = np.float32(-1e6)
# Coordinates are computed on a lattice of the canvas and interpolated linearly, to this many pixels of the image or,
# where that gets smaller, of the canvas. OpenCV rounds them to as many afterwards.
_LATTICE_ERROR = 1.0 / 32.0

_PROBES = 16
# OpenCV resamples from no side as long as this, pixels.
_TOO_LONG = 32767
_KERNEL_MARGIN = 8  # room around a piece of an image for the kernel of the resampling, pixels
_MIN_WEIGHT = np.float32(1e-6)


@dataclass(frozen=True, eq=False)
class Lattice:
    """Pixels of an image at the nodes of a lattice around a box of the canvas.

    It is anchored to the canvas: every node, and every pixel between them, is the same bit for bit in every box.
    """

    box: Box  # x0, y0, x1, y1, canvas pixels, end exclusive
    step: int  # spacing, one of ``LATTICE_STEPS``
    # (m, n, 2), float32: at the nodes, which enclose the box, those of the widest spacing too; far outside where there
    # are no pixels
    points: Float32Array

    @classmethod
    def over(cls, box: Box, step: int, places: Callable[[FloatArray, FloatArray], FloatArray]) -> Self:
        """Nodes by what maps x (1, n) and y (m, 1), canvas pixels, to pixels (m, n, 2) of an image."""
        (x0, x1), (y0, y1) = _enclosing(box, LATTICE_STEPS[0])
        x, y = (np.arange(start, stop + 1, step, dtype=np.float64) for start, stop in ((x0, x1), (y0, y1)))
        return cls(box, step, _somewhere(places(x[None, :], y[:, None])))

    def nodes(self, box: Box, step: int) -> Float32Array:
        """Pixels at the nodes that enclose a box within this one's, (m, n, 2), at this spacing or a wider one."""
        (x0, x1), (y0, y1) = _enclosing(box, step)
        (left, _), (top, _) = _enclosing(self.box, LATTICE_STEPS[0])
        rows, columns = (
            slice((start - first) // self.step, (stop - first) // self.step + 1, step // self.step)
            for first, start, stop in ((top, y0, y1), (left, x0, x1))
        )
        return self.points[rows, columns]

    def maps(self, box: Box) -> tuple[Float32Array, Float32Array]:
        """Measured pixels of every canvas pixel of a box within this one's: two arrays (h, w)."""
        points = self.nodes(box, self.step)
        return interpolated(points[..., 0], box, self.step), interpolated(points[..., 1], box, self.step)


def interpolated(nodes: Float32Array, box: Box, step: int) -> Float32Array:
    """Linear interpolation of node values (m, n) to the pixels (h, w) of the box that they enclose.

    Every value depends on its four nodes alone, bit for bit, whatever the box.
    """
    x0, y0, x1, y1 = box
    left, top = x0 % step, y0 % step
    share = np.arange(step, dtype=np.float32) / np.float32(step)
    rise = nodes[:, 1:] - nodes[:, :-1]
    columns = (rise[..., None] * share + nodes[:, :-1, None]).reshape(len(nodes), -1)[:, left : left + x1 - x0]
    values: Float32Array = (columns[1:] - columns[:-1])[:, None, :] * share[:, None]
    values += columns[:-1, None, :]
    return np.asarray(values.reshape(-1, x1 - x0)[top : top + y1 - y0])


def _enclosing(box: Box, step: int) -> tuple[tuple[int, int], tuple[int, int]]:
    """First and last node that enclose a box, across and down, canvas pixels."""
    x0, y0, x1, y1 = box
    across, down = ((start // step * step, ((stop - 1) // step + 1) * step) for start, stop in ((x0, x1), (y0, y1)))
    return across, down


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

    def contains(self, x: NDArray[Any], y: NDArray[Any]) -> NDArray[np.bool_]:
        """Which measured pixels lie in the image; NaN does not."""
        width, height = self.camera.image_size
        within: NDArray[np.bool_] = (x >= -0.5) & (x < width - 0.5) & (y >= -0.5) & (y < height - 0.5)
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
    def inside(self) -> NDArray[np.bool_]:
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
    """The warp with its box, and with the spacing and the shrinkage at canvas pixels all over the image."""
    draft = replace(draft, shrink=_shrink(draft, probes))
    return replace(draft, box=_reached(draft, canvas), step=_lattice_step(draft, probes))


def _reached(warp: Warp, canvas: Canvas) -> Box:
    """The warp's box with room for what a displacement moves beyond it."""
    if warp.displacement is None:
        return warp.box
    moved = np.abs(warp.displacement(warp.camera.outline(_PROBES))).max() / warp.shrink
    return intersection(grown(warp.box, int(np.ceil(moved)) + 1), (0, 0, *canvas.size)) or warp.box


def plan_warps(images: Sequence[PlacedImage], canvas: Canvas) -> list[Warp]:
    """The warps of all images."""
    return [plan_warp(p.camera, p.homography, canvas, k, p.displacement) for k, p in enumerate(images)]


def locate(warp: Warp, box: Box) -> Geometry:
    """Where the pixels of a box come from, and which of them lie in the image."""
    return Geometry(warp, box, Lattice.over(box, warp.step, warp.source_points))


def _somewhere(points: FloatArray) -> Float32Array:
    """Places in an image, far outside where there are none."""
    placed = points.astype(np.float32)
    placed[~np.isfinite(placed).all(axis=-1)] = _NOWHERE
    return placed


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


def border_weight(geometry: Geometry) -> Float32Array:
    """1 at the image's centre, falling to 0 at its border (measured in the image) and outside."""
    (map_x, map_y), (width, height) = geometry.maps, geometry.warp.camera.image_size
    one, half = np.float32(1.0), np.float32(0.5)
    weight: Float32Array = (map_x + half) * np.float32(2.0 / width) - one
    weight = one - np.abs(weight, out=weight)
    down = (map_y + half) * np.float32(2.0 / height) - one
    weight *= one - np.abs(down, out=down)
    # Never 0 inside: a border pixel that one image alone covers must not get lost.
    np.maximum(weight, _MIN_WEIGHT, out=weight)
    weight[~geometry.inside] = 0.0
    return weight


def sample(image: LoadedImage, geometry: Geometry, interpolation: str = "cubic") -> NDArray[Any]:
    """Resample an image; content is mirrored outside of it, so that filters find no edge there.

    The image is prepared for ``geometry.warp.shrink``; the result is (h, w) or (h, w, C), in its sample type.
    """
    map_x, map_y = _mirrored(image, geometry)
    return _remap_whole(image.pixels, map_x, map_y, INTERPOLATION[interpolation])


def sample_places(image: LoadedImage, geometry: Geometry) -> tuple[NDArray[np.int16], NDArray[np.uint16]]:
    """Where :func:`sample` takes pixels from, as ``cv2.remap`` takes it quickest: (h, w, 2), and parts of a pixel."""
    places, parts = cv2.convertMaps(*_mirrored(image, geometry), cv2.CV_16SC2)
    return np.asarray(places, dtype=np.int16), np.asarray(parts, dtype=np.uint16)


def sample_opacity(image: LoadedImage, geometry: Geometry) -> Float32Array | None:
    """Opacity (h, w), 0 where the image is masked out; None for an image without a mask."""
    if image.opacity is None:
        return None
    map_x, map_y = _mirrored(image, geometry)
    opacity = _remap_whole(image.opacity, map_x, map_y, cv2.INTER_LINEAR) * np.float32(1.0 / OPAQUE)
    # The outer half of the last opaque pixel is outside.
    return np.where(opacity >= np.float32(0.5 * image.opacity_step), opacity, np.float32(0.0))


def _mirrored(image: LoadedImage, geometry: Geometry) -> tuple[Float32Array, Float32Array]:
    """Pixels of the (reduced) image, all inside it."""
    map_x, map_y = geometry.maps
    if not geometry.inside.all():
        # Mirroring rounds: what is inside keeps its coordinates, whatever else the box holds.
        mirrored = [_mirror(m, n) for m, n in zip((map_x, map_y), geometry.warp.camera.image_size, strict=True)]
        for values, exact in zip(mirrored, (map_x, map_y), strict=True):
            np.copyto(values, exact, where=geometry.inside)
        map_x, map_y = mirrored
    if image.reduction > 1:
        half, factor = np.float32(0.5), np.float32(image.reduction)
        map_x, map_y = ((m + half) / factor - half for m in (map_x, map_y))
    return map_x, map_y


def _remap_whole(pixels: NDArray[Any], map_x: Float32Array, map_y: Float32Array, interpolation: int) -> NDArray[Any]:
    """``cv2.remap`` from an image; of a very long one, from the piece of it that is needed."""
    if max(pixels.shape[:2]) < _TOO_LONG:
        return remap(pixels, map_x, map_y, interpolation)
    left, top = (max(0, int(m.min()) - _KERNEL_MARGIN) for m in (map_x, map_y))
    right, bottom = (int(m.max()) + 2 + _KERNEL_MARGIN for m in (map_x, map_y))
    # Whole pixels are subtracted exactly, so the piece does not change the result.
    piece = pixels[top:bottom, left:right]
    return remap(piece, map_x - np.float32(left), map_y - np.float32(top), interpolation)


def remap(piece: NDArray[Any], map_x: NDArray[Any], map_y: NDArray[Any], interpolation: int) -> NDArray[Any]:
    """``cv2.remap`` for any number of channels."""
    channels = 1 if piece.ndim == 2 else piece.shape[2]
    if channels <= 4:
        done = cv2.remap(piece, map_x, map_y, interpolation, borderMode=cv2.BORDER_REFLECT)
        return np.asarray(done).reshape(*map_x.shape[:2], *piece.shape[2:])
    bands = [remap(np.ascontiguousarray(piece[..., k]), map_x, map_y, interpolation) for k in range(channels)]
    return np.stack(bands, axis=-1)


def _mirror(values: Float32Array, length: int) -> Float32Array:
    """Coordinates mirrored at the image's borders; far outside, those of the border."""
    half, turn = np.float32(0.5), np.float32(2 * length)
    mirrored = values + half
    np.abs(mirrored, out=mirrored)
    np.minimum(mirrored, turn - mirrored, out=mirrored)
    np.maximum(mirrored, np.float32(0.0), out=mirrored)
    mirrored -= half
    return mirrored
