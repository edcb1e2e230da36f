"""Planes to look at: procedural textures of any size, hopeless ones, and any given image.

A texture answers for any rectangle of itself, so that a plane of a gigapixel need not be in memory. Values are grey
levels or RGB in [0, 1].
"""

from dataclasses import dataclass
from functools import lru_cache
from typing import Protocol

import cv2
import numpy as np

from rdstitch.arrays import AnyArray, Float32Array, FloatArray, Int32Array, IntArray, UInt8Array
from rdstitch.errors import ArgumentError

# Periods of the layers of an endless texture, texels. Up to 100,000 no shift is within 100 of a multiple of all three.
# (Two layers of 2039 and 1787 come within 12 at 14,284, and places so far apart look the same.)
LAYER_PERIODS = (2063, 1997, 1613)
_SUBPIXEL_BITS = 4
_MIN_RADIUS = 2.5  # texels, of patches
_MAX_RADIUS = 160.0  # texels, where the plane is six times as large
_KINDS = 0.7, 0.2, 0.1  # fractions of the patches that are polygons, ellipses and streaks
_IRREGULAR = 0.35  # of the angle between two corners of a polygon, that they stray
_ELLIPSE_CORNERS = 16
_FLATNESS = 0.4, 1.0  # ratios of the axes of polygons and ellipses
_STREAK_LENGTH = 2.5  # times the radius of other patches
_STREAK_WIDTH = 0.1  # of their length
_MATERIALS = 9
_MATERIAL_GREY = 60.0, 190.0  # grey levels of 8 bits, as all that follow
_TINT = 18.0  # standard deviation of a material's channels
_PATCH_SPREAD = 28.0  # standard deviation of the patches of a material
_PATCH_GREY = 20.0, 235.0


class Texture(Protocol):
    """An image of the plane."""

    @property
    def size(self) -> tuple[int, int]:
        """Width and height, texels."""

    @property
    def channels(self) -> int:
        """1 for grey, 3 for RGB."""

    def region(self, left: int, top: int, right: int, bottom: int) -> Float32Array:
        """Texels of a rectangle inside the texture, shape (bottom - top, right - left, channels), in [0, 1]."""


@dataclass(frozen=True, eq=False)
class ImageTexture:
    """An image as texture: uint8 or uint16 of full range, or float32 in [0, 1], (h, w) or (h, w, C)."""

    pixels: AnyArray

    def __post_init__(self) -> None:
        if self.pixels.ndim not in (2, 3) or self.pixels.size == 0:
            raise ArgumentError(f"a texture has shape (h, w) or (h, w, C), not {self.pixels.shape}")
        if self.pixels.dtype not in (np.uint8, np.uint16, np.float32):
            raise ArgumentError(f"a texture is uint8, uint16 or float32, not {self.pixels.dtype}")

    @property
    def size(self) -> tuple[int, int]:
        """Width and height, texels."""
        return self.pixels.shape[1], self.pixels.shape[0]

    @property
    def channels(self) -> int:
        """Number of channels; 3 are RGB."""
        return 1 if self.pixels.ndim == 2 else self.pixels.shape[2]

    def region(self, left: int, top: int, right: int, bottom: int) -> Float32Array:
        part = self.pixels[top:bottom, left:right]
        full = 1.0 if part.dtype == np.float32 else float(np.iinfo(part.dtype).max)
        scaled: Float32Array = part.astype(np.float32) / np.float32(full)
        return scaled[:, :, None] if scaled.ndim == 2 else scaled


@dataclass(frozen=True)
class EndlessTexture:
    """Ground of any size that never repeats: the mean of periodic layers whose periods have no common multiple."""

    size: tuple[int, int]  # width and height, texels
    seed: int
    channels: int = 3  # 1 for grey, 3 for RGB

    def region(self, left: int, top: int, right: int, bottom: int) -> Float32Array:
        x, y = np.arange(left, right), np.arange(top, bottom)
        layers = [_periodic_ground(period, (self.seed, period), self.channels) for period in LAYER_PERIODS]
        total = np.zeros((len(y), len(x), self.channels), dtype=np.float32)
        for layer, period in zip(layers, LAYER_PERIODS, strict=True):
            total += layer.take(y % period, axis=0).take(x % period, axis=1)
        # The mean of n layers has 1/sqrt(n) of their contrast: give it back.
        count, grey = len(layers), np.float32(0.5)
        total -= count * grey
        total *= np.float32(1.0 / np.sqrt(count))
        total += grey
        return np.clip(total, 0.0, 1.0, out=total)


def ground(size: tuple[int, int], seed: int, channels: int = 3) -> Texture:
    """Ground as an aerial photograph or a floor shows it: patches that hide one another, at all scales, and grain.

    Dead leaves (polygons, ellipses and streaks with sizes distributed as r⁻³, later ones on top), the usual model for
    the statistics of natural images, under a 1/f grain. More than 16 megapixels are an :class:`EndlessTexture`.
    """
    if min(size) < 1:
        raise ArgumentError(f"ground has at least 1 x 1 texel, not {size[0]} x {size[1]}")
    if size[0] * size[1] > 16_000_000:
        return EndlessTexture(size, seed, channels)
    rng = np.random.default_rng(seed)
    return ImageTexture(_grained(_dead_leaves(rng, size, channels, wrap=False), rng))


def blank(size: tuple[int, int]) -> Texture:
    """No texture at all."""
    return ImageTexture(np.full((size[1], size[0]), 0.5, dtype=np.float32))


def gradient(size: tuple[int, int]) -> Texture:
    """Smooth shading without a single corner: a sky, or a white wall."""
    x = np.linspace(0.2, 0.6, size[0], dtype=np.float32)
    y = np.linspace(0.0, 0.3, size[1], dtype=np.float32)
    return ImageTexture(y[:, None] + x)


def repeated(size: tuple[int, int], seed: int, period: int = 96) -> Texture:
    """One tile over and over: rich in corners, yet every match is ambiguous."""
    tile = _periodic_ground(period, (seed, period), 3)
    rows, columns = -(-size[1] // period), -(-size[0] // period)
    return ImageTexture(np.tile(tile, (rows, columns, 1))[: size[1], : size[0]].copy())


@lru_cache(maxsize=len(LAYER_PERIODS))  # 51 MB for the largest of them, in RGB
def _periodic_ground(period: int, seed: tuple[int, int], channels: int) -> Float32Array:
    """Ground of ``period`` x ``period`` texels that continues across its borders."""
    rng = np.random.default_rng(seed)
    ground = _grained(_dead_leaves(rng, (period, period), channels, wrap=True), rng)
    ground.setflags(write=False)
    return ground


def _dead_leaves(
    rng: np.random.Generator, size: tuple[int, int], channels: int, *, wrap: bool, cover: float = 3.0
) -> UInt8Array:
    """Overlapping patches that cover the image ``cover`` times; with ``wrap``, also across its borders."""
    width, height = size
    smallest, largest = _MIN_RADIUS, max(6.0, min(_MAX_RADIUS, min(size) / 6.0))
    mean_area = np.pi * 2.0 * np.log(largest / smallest) / (smallest**-2 - largest**-2)
    count = int(np.ceil(cover * width * height / mean_area))
    # Inverse of the cumulative distribution of r⁻³.
    radius = 1.0 / np.sqrt(smallest**-2 - rng.random(count) * (smallest**-2 - largest**-2))
    center = rng.random((count, 2)) * size
    colour = _palette(rng, count, channels)
    places, owner = _wrapped(center, _STREAK_LENGTH * radius, size) if wrap else (center, np.arange(count))
    leaves = _leaf_outlines(rng, radius)

    canvas = np.empty((height, width, channels), dtype=np.uint8)
    canvas[:] = np.median(colour, axis=0)
    shifts = np.rint(places * 2**_SUBPIXEL_BITS).astype(np.int32)
    values = colour.tolist()
    for leaf, shift in zip(owner.tolist(), shifts, strict=True):
        cv2.fillPoly(canvas, [leaves[leaf] + shift], values[leaf], cv2.LINE_AA, _SUBPIXEL_BITS)
    return canvas


def _palette(rng: np.random.Generator, count: int, channels: int) -> FloatArray:
    """Colours of patches: a few materials, each with its own spread of brightness."""
    materials = rng.uniform(*_MATERIAL_GREY, (_MATERIALS, 1)) + rng.normal(0.0, _TINT, (_MATERIALS, channels))
    colour = materials[rng.integers(len(materials), size=count)] + rng.normal(0.0, _PATCH_SPREAD, (count, 1))
    return np.clip(colour, *_PATCH_GREY)


def _leaf_outlines(rng: np.random.Generator, radius: FloatArray) -> list[Int32Array]:
    """Outlines around the origin: polygons of 3-7 corners, ellipses, and streaks like roads and joints.

    In units of ``2 ** -_SUBPIXEL_BITS`` texels, as OpenCV draws them.
    """
    count = len(radius)
    polygon, ellipse, streak = range(3)
    kind = rng.choice(3, size=count, p=_KINDS)
    corners = np.where(kind == polygon, rng.integers(3, 8, count), np.where(kind == ellipse, _ELLIPSE_CORNERS, 4))
    irregular = np.where(kind == polygon, _IRREGULAR, 0.0)
    flat = np.where(kind == streak, _STREAK_WIDTH, rng.uniform(*_FLATNESS, count))
    long = np.where(kind == streak, _STREAK_LENGTH, 1.0) * radius
    turn = rng.uniform(0.0, np.pi, count)
    c, s = np.cos(turn), np.sin(turn)
    axes = np.stack([np.stack([c, s], axis=-1), np.stack([-s, c], axis=-1) * flat[:, None]], axis=-2)
    axes *= (long * 2**_SUBPIXEL_BITS)[:, None, None]

    outlines: list[Int32Array] = [np.empty((0, 2), dtype=np.int32)] * count
    for n in np.unique(corners):
        which = np.flatnonzero(corners == n)
        jitter = irregular[which, None] * rng.uniform(-1.0, 1.0, (len(which), n))
        around = 2.0 * np.pi * (np.arange(n) + 0.5 + jitter) / n
        points = np.stack([np.cos(around), np.sin(around)], axis=-1) @ axes[which]
        for leaf, outline in zip(which.tolist(), np.rint(points).astype(np.int32), strict=True):
            outlines[leaf] = outline
    return outlines


def _wrapped(center: FloatArray, reach: FloatArray, size: tuple[int, int]) -> tuple[FloatArray, IntArray]:
    """All places at which leaves are drawn so that they continue across the borders, and the leaf of each."""
    shifts = np.array([(dx, dy) for dx in (-1.0, 0.0, 1.0) for dy in (-1.0, 0.0, 1.0)]) * size
    places = center[:, None, :] + shifts
    touching = ((places > -reach[:, None, None]) & (places < np.array(size) + reach[:, None, None])).all(axis=-1)
    owner, shift = np.nonzero(touching)
    return places[owner, shift], owner


def _grained(patches: UInt8Array, rng: np.random.Generator, strength: float = 0.05) -> Float32Array:
    """Patches with periodic 1/f texture over them, in [0, 1]."""
    height, width = patches.shape[:2]
    frequency = np.hypot(np.fft.fftfreq(height)[:, None], np.fft.rfftfreq(width)[None, :])
    frequency[0, 0] = np.inf
    white = rng.standard_normal((height, width), dtype=np.float32)
    grain = np.fft.irfft2(np.fft.rfft2(white) / frequency, s=(height, width))
    grain = (strength * grain / grain.std()).astype(np.float32)
    image: Float32Array = patches.astype(np.float32) / np.float32(255.0) + grain[:, :, None]
    return np.clip(image, 0.0, 1.0, out=image)
