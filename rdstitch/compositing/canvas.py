"""The canvas: where every image lies in the output, and how large that is.

A homography ``G`` maps the half-diagonal-normalized undistorted coordinates of its image to *plane* coordinates,
which have no unit; the canvas is the plane scaled, turned and shifted to pixels. Where images were taken by turning
on the spot, G maps them to directions, and the canvas is what a projection makes of these.

Of an oblique image the near part is drawn (:mod:`rdstitch.compositing.visible_region`).
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from rdstitch.arrays import FloatArray
from rdstitch.compositing.boxes import Box
from rdstitch.compositing.projection import PLANE, Projection
from rdstitch.compositing.visible_region import POINTS_PER_SIDE, PROBES, VisibleRegion, visible_regions
from rdstitch.errors import ArgumentError, LimitError
from rdstitch.geometry.camera import Camera, points_over
from rdstitch.geometry.radial_homography import to_directions, to_plane

_MAX_GROWTH = 100.0
_MAX_ENLARGEMENT = 400.0  # pixels of the canvas for each pixel of the images
_LEVEL = 1e-9  # rounding of what a turn within the plane leaves as it is


@dataclass(frozen=True, eq=False)
class Canvas:
    """The output image's geometry."""

    size: tuple[int, int]  # width and height, pixels
    matrix: FloatArray  # (3, 3): affine, from plane coordinates to canvas pixels (centre of the top-left one at (0, 0))
    # (K, 2) each: outline of what is drawn of each image, canvas pixels, clockwise. Of a canvas that goes all the way
    # round, one of its places; it may reach beyond the canvas
    footprints: tuple[FloatArray, ...]
    projection: Projection = PLANE  # what ``matrix`` is applied to: the places that it gives to directions
    # width of a full turn, pixels, where the images go all the way round; None where they do not
    period: float | None = None
    near: tuple[VisibleRegion | None, ...] = ()  # what of each image is drawn; None, as by default: all
    # (3, 3): what the registered images were turned by before, as it is recorded; None where they were not
    orientation: FloatArray | None = None
    cropped_to: Box | None = None  # what a crop leaves, instead of the largest part without holes

    def __post_init__(self) -> None:
        if not self.near:
            object.__setattr__(self, "near", (None,) * len(self.footprints))

    @property
    def from_level_plane(self) -> FloatArray | None:
        """Affine (3, 3) from the plane of the registration to pixels; None where that was tilted to be upright."""
        turned = np.eye(3) if self.orientation is None else self.orientation
        level: FloatArray = self.matrix @ (turned / turned[2, 2])
        return level if np.abs(turned[2, :2]).max() <= _LEVEL * abs(turned[2, 2]) else None

    def box(self, index: int) -> Box:
        """Bounds (x0, y0, x1, y1) of an image, whole pixels inside the canvas, end exclusive.

        An image that lies across the edge of a canvas that goes all the way round has the whole width.
        """
        outline, (width, height) = self.footprints[index], self.size
        low, high = np.floor(outline.min(axis=0)), np.ceil(outline.max(axis=0)) + 1
        shifts = self._shifts(float(low[0]), float(high[0])) or [0.0]
        low[0], high[0] = low[0] + min(shifts), high[0] + max(shifts)
        # Of an image beyond a grid that was given, or a crop, there is one pixel, in which it is not.
        x0, y0 = (min(max(0, int(v)), side - 1) for v, side in zip(low, (width, height), strict=True))
        return x0, y0, max(x0 + 1, min(width, int(high[0]))), max(y0 + 1, min(height, int(high[1])))

    def on_grid(self, matrix: FloatArray, size: tuple[int, int]) -> "Canvas":
        """The same plane on other pixels, which images may lie beyond."""
        return replace(self._changed(matrix @ np.linalg.inv(self.matrix), size), matrix=matrix)

    def _changed(self, change: FloatArray, size: tuple[int, int]) -> "Canvas":
        """Other pixels, to which a similarity (3, 3) leads."""
        outlines = tuple(outline @ change[:2, :2].T + change[:2, 2] for outline in self.footprints)
        return replace(self, size=size, matrix=change @ self.matrix, footprints=outlines)

    def areas(self) -> list[int]:
        """Area of the bounds of every image, as if it had only one place on the canvas, square pixels."""
        if self.period is None:
            return [(x1 - x0) * (y1 - y0) for x0, y0, x1, y1 in map(self.box, range(len(self.footprints)))]
        sizes = [np.minimum(np.ptp(outline, axis=0) + 1, self.size) for outline in self.footprints]
        return [int(width * height) for width, height in sizes]

    @property
    def outlines(self) -> list[tuple[FloatArray, ...]]:
        """The footprint of every image at each of its places: two, where it lies across the edge of a full turn."""
        return [
            tuple(outline + np.array([shift, 0.0]) for shift in self._shifts(outline[:, 0].min(), outline[:, 0].max()))
            for outline in self.footprints
        ]

    def _shifts(self, low: float, high: float) -> list[float]:
        """Shifts, pixels, from where an image is to all its places on the canvas, which repeat with each turn."""
        if self.period is None:
            return [0.0]
        turns = [k * self.period for k in range(-2, 3)]
        return [turn for turn in turns if low + turn < self.size[0] and high + turn > 0]

    def place(self, camera: Camera, homography: FloatArray, points: ArrayLike) -> FloatArray:
        """Canvas pixels (N, 2) of measured pixels (N, 2) of an image; NaN where it has no place."""
        if self.projection == PLANE:
            return to_plane(camera, self.matrix @ homography, points)
        directions = to_directions(camera, homography, points)
        return np.asarray(self.projection.project(directions) @ self.matrix[:2, :2].T + self.matrix[:2, 2])

    def cut_away(self, cameras: Sequence[Camera], homographies: FloatArray) -> float:
        """Share of what the images show that has no place here, because it would be stretched too much."""
        drawn = []
        for k, (camera, matrix) in enumerate(zip(cameras, homographies, strict=True)):
            points = points_over(camera.image_size, PROBES)
            part, places = self.near[k], self.place(camera, matrix, points)
            with np.errstate(invalid="ignore"):
                outside = (places < -1.0) | (places > np.array(self.size))
                inside = np.isfinite(places).all(axis=1) & ~outside[:, 1 if self.period else 0 :].any(axis=1)
            drawn.append(inside if part is None else inside & part.shows(points))
        return 1.0 - float(np.mean(drawn))

    def cropped(self, box: Box) -> "Canvas":
        """The part (x0, y0, x1, y1) of this canvas as a canvas of its own."""
        x0, y0, x1, y1 = box
        shift = np.array([[1.0, 0.0, -x0], [0.0, 1.0, -y0], [0.0, 0.0, 1.0]])
        wanted = self.cropped_to
        if wanted is not None:
            wanted = wanted[0] - x0, wanted[1] - y0, wanted[2] - x0, wanted[3] - y0
        return replace(self._changed(shift, (x1 - x0, y1 - y0)), cropped_to=wanted)

    def reduced(self, factor: int) -> "Canvas":
        """The same canvas with pixels ``factor`` times as large."""
        width, height = (-(-n // factor) for n in self.size)
        shift = 0.5 / factor - 0.5
        to_reduced = np.array([[1.0 / factor, 0.0, shift], [0.0, 1.0 / factor, shift], [0.0, 0.0, 1.0]])
        period = None if self.period is None else self.period / factor
        # What a crop leaves is decided at full size.
        return replace(self._changed(to_reduced, (width, height)), period=period, cropped_to=None)


def plan_canvas(
    cameras: Sequence[Camera],
    homographies: ArrayLike,
    *,
    scale: float = 1.0,
    rotate: float = 0.0,
    reference: int | None = None,
    names: Sequence[str] | None = None,
    max_stretch: float = math.inf,
) -> Canvas:
    """Plan the smallest upright canvas that holds every image.

    At ``scale`` 1 it keeps the resolution that the reference image, or the median one, has at its centre. With
    ``max_stretch`` the near part of an oblique image is drawn (:mod:`rdstitch.compositing.visible_region`); without, an
    image that shows the horizon is refused.
    """
    matrices = np.asarray(homographies, dtype=np.float64)
    called = [f"image {k + 1}" for k in range(len(cameras))] if names is None else list(names)
    check_placement(cameras, matrices, scale, rotate, reference, called, max_stretch)
    to_plane = [_oriented(c, g) for c, g in zip(cameras, matrices, strict=True)]
    px_per_unit = np.array([_resolution(c, g) for c, g in zip(cameras, to_plane, strict=True)])
    usual = abs(px_per_unit[reference]) if reference is not None else np.nanmedian(np.abs(px_per_unit))
    near = visible_regions(cameras, to_plane, float(usual), max_stretch)
    outlines = [
        _outline_on_plane(c, g, part, name) for c, g, part, name in zip(cameras, to_plane, near, called, strict=True)
    ]
    _refuse_mirrored(px_per_unit, called)
    resolution = scale * float(usual)

    linear = turned_and_scaled(rotate, resolution)
    placed = [outline @ linear.T for outline in outlines]
    low = np.min([outline.min(axis=0) for outline in placed], axis=0)
    high = np.max([outline.max(axis=0) for outline in placed], axis=0)
    _refuse_disproportionate(cameras, placed, high - low, scale, called)
    refuse_scale(cameras, high - low)
    return replace(canvas_between(low, high, linear, placed), near=tuple(near))


def turned_and_scaled(rotate: float, resolution: float) -> FloatArray:
    """The linear part (2, 2) of a canvas: so many pixels per unit, turned by so many degrees clockwise."""
    angle = math.radians(rotate)
    cos, sin = resolution * math.cos(angle), resolution * math.sin(angle)
    return np.array([[cos, -sin], [sin, cos]])


def canvas_between(low: FloatArray, high: FloatArray, linear: FloatArray, outlines: Sequence[FloatArray]) -> Canvas:
    """The canvas from ``low`` to ``high``, which outlines are counted in after the linear part was applied to them."""
    # The outermost edge is the canvas' edge, half a pixel before the centre of the first pixel.
    size = np.maximum(np.ceil(high - low - 1e-6), 1).astype(int)
    matrix = np.eye(3)
    matrix[:2, :2], matrix[:2, 2] = linear, -low - 0.5
    return Canvas((int(size[0]), int(size[1])), matrix, tuple(outline - low - 0.5 for outline in outlines))


def check_placement(
    cameras: Sequence[Camera],
    matrices: FloatArray,
    scale: float,
    rotate: float,
    reference: int | None,
    names: Sequence[str],
    max_stretch: float,
) -> None:
    """Refuse arguments of :func:`plan_canvas` that do not fit together."""
    if not cameras or matrices.shape != (len(cameras), 3, 3) or len(names) != len(cameras):
        raise ArgumentError(f"expected one homography (3, 3) per camera, not {matrices.shape} for {len(cameras)}")
    if not (math.isfinite(scale) and scale > 0):
        raise ArgumentError(f"scale must be positive, not {scale}")
    if not math.isfinite(rotate):
        raise ArgumentError(f"rotate must be an angle in degrees, not {rotate}")
    if reference is not None and not 0 <= reference < len(cameras):
        raise ArgumentError(f"reference must be the index of one of {len(cameras)} images, not {reference}")
    if not max_stretch > 1.0:
        raise ArgumentError(f"max_stretch must be larger than 1, not {max_stretch}")
    for matrix, name in zip(matrices, names, strict=True):
        if not np.isfinite(matrix).all() or np.linalg.cond(matrix) > 1e12:
            raise ArgumentError(f"{name}: the homography is singular or not finite")


def _oriented(camera: Camera, matrix: FloatArray) -> FloatArray:
    """The homography with the sign that puts the image, or a part of it, in front of the camera."""
    flat = camera.normalize(camera.undistort(camera.outline(1)))
    return matrix if (flat @ matrix[2, :2] + matrix[2, 2] > 0).any() else -matrix


def _outline_on_plane(camera: Camera, matrix: FloatArray, near: VisibleRegion | None, name: str) -> FloatArray:
    """Densely sampled outline of what is drawn, in plane coordinates."""
    outline = to_plane(camera, matrix, camera.outline(POINTS_PER_SIDE) if near is None else near.outline())
    # What is in front of the horizon on the outline is so inside.
    if not len(outline) or not np.isfinite(outline).all():
        raise LimitError(f"{name}: the horizon crosses the image; leave it out, or choose another reference image")
    return outline


def _resolution(camera: Camera, matrix: FloatArray) -> float:
    """Image pixels per plane unit at the image's centre, negative where the image is mirrored."""
    middle = np.array(camera.image_center)
    left, right, top, bottom = to_plane(camera, matrix, middle + np.array([(-0.5, 0), (0.5, 0), (0, -0.5), (0, 0.5)]))
    (ax, ay), (bx, by) = right - left, bottom - top
    area = ax * by - ay * bx
    return float(math.copysign(1.0 / math.sqrt(max(abs(area), 1e-300)), area))


def _refuse_mirrored(px_per_unit: FloatArray, names: Sequence[str]) -> None:
    usual = 1.0 if (px_per_unit > 0).sum() * 2 >= len(px_per_unit) else -1.0
    for value, name in zip(px_per_unit, names, strict=True):
        if value * usual < 0:
            raise LimitError(f"{name}: would be mirrored (folded) in the output; leave it out")


def _refuse_disproportionate(
    cameras: Sequence[Camera], outlines: Sequence[FloatArray], extent: FloatArray, scale: float, names: Sequence[str]
) -> None:
    """Refuse a canvas, or an image in it, that is out of all proportion to the input."""
    pixels = [c.image_size[0] * c.image_size[1] * scale**2 for c in cameras]
    for outline, image_pixels, name in zip(outlines, pixels, names, strict=True):
        growth = float(np.prod(np.ptp(outline, axis=0))) / image_pixels
        if growth > _MAX_GROWTH:
            raise LimitError(
                f"{name}: would be stretched to {growth:.0f} times its size (near the horizon, or wrongly placed); "
                "leave it out, or choose another reference image"
            )
    if float(np.prod(extent)) > _MAX_GROWTH * sum(pixels):
        middle = np.median([outline.mean(axis=0) for outline in outlines], axis=0)
        farthest = int(np.argmax([np.linalg.norm(outline.mean(axis=0) - middle) for outline in outlines]))
        raise LimitError(
            f"the canvas would have {extent[0]:.0f} x {extent[1]:.0f} pixels, over {_MAX_GROWTH:.0f} times all "
            f"images; {names[farthest]} lies farthest off: leave it out"
        )


def refuse_scale(cameras: Sequence[Camera], extent: ArrayLike, advice: str = "use a --scale nearer to 1") -> None:
    """Refuse a canvas that leaves nothing of the images, or that enlarges them over 400 times in all."""
    extent = np.asarray(extent, dtype=np.float64)
    pixels = sum(c.image_size[0] * c.image_size[1] for c in cameras)
    if float(extent.min()) < 1.0 or float(np.prod(extent)) > _MAX_ENLARGEMENT * pixels:
        raise LimitError(f"the canvas would have {extent[0]:.3g} x {extent[1]:.3g} pixels; {advice}")
