"""Ground that is not flat: bumps, buildings and slopes of a given height, seen with true visibility."""

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np

from rdstitch.arrays import BoolArray, Float32Array, FloatArray
from rdstitch.errors import ArgumentError

# A ray moves at most this far over the ground between two levels at which it is tested, texels; but see _MAX_LEVELS.
_TEXELS_PER_LEVEL = 2.0
_MAX_LEVELS = 96
_BISECTIONS = 10
_ROW = 1024
# A place outside every height map, for rays that meet nothing.
NOWHERE = np.float32(-1e6)
# OpenCV resamples from no side as long as this, texels.
_TOO_LONG = 32767


@dataclass(frozen=True, eq=False)
class Relief:
    """Heights above the plane: they give parallax and occlusion, and no homography describes that.

    The texture lies on the ground as seen from straight above: the texel (x, y) is at height ``height[y, x]`` texels;
    outside of the map, at the lowest height of it.
    """

    height: Float32Array

    def __post_init__(self) -> None:
        if self.height.ndim != 2 or not self.height.size or max(self.height.shape) >= _TOO_LONG:
            raise ArgumentError(f"a height map has shape (h, w), up to {_TOO_LONG - 1}, not {self.height.shape}")
        if self.height.dtype != np.float32 or not np.isfinite(self.height).all():
            raise ArgumentError("heights must be finite and float32")

    def at(self, points: FloatArray) -> FloatArray:
        """Heights (N,) at texels (N, 2)."""
        x, y = np.clip(points, 0.0, np.array(self.height.shape[::-1]) - 1.0).T
        column, row = (
            np.minimum(v.astype(np.intp), n - 2) for v, n in zip((x, y), self.height.shape[::-1], strict=True)
        )
        a, b = x - column, y - row
        above, below = ((1.0 - a) * self.height[row + k, column] + a * self.height[row + k, column + 1] for k in (0, 1))
        return np.asarray((1.0 - b) * above + b * below, dtype=np.float64)

    def seen_from(self, position: FloatArray, height: float, foot: FloatArray) -> FloatArray:
        """Texels (..., 2) at which rays first meet the ground, which is interpolated linearly between texels.

        The rays go from a camera over ``position``, ``height`` above the plane, to ``foot`` (..., 2), where they would
        meet the plane; NaN where they do not. Each is tested at levels from the highest point down to the lowest;
        bisection finds where, between the last level above the ground and the first one in it, it meets the ground.
        """
        top, bottom = float(self.height.max()), float(self.height.min())
        if top >= height:
            raise ArgumentError(f"the ground is {top:.0f} texels high, the camera only {height:.0f}")
        if not foot.size:
            return foot
        # In rows that OpenCV can resample, whatever the shape; the last is filled with rays that meet nothing.
        flat = np.full((-(-foot.size // 2 // _ROW), _ROW, 2), np.nan)
        flat.reshape(-1, 2)[: foot.size // 2] = foot.reshape(-1, 2)
        start, along = position.astype(np.float32), (flat - position).astype(np.float32)
        travel = float(np.fmax.reduce(np.abs(along), axis=None, initial=0.0)) * (top - bottom) / height
        steps = int(np.clip(np.ceil(travel / _TEXELS_PER_LEVEL), 1, _MAX_LEVELS))

        def in_ground(level: Float32Array) -> BoolArray:
            places = start + along * (np.float32(1.0) - level / np.float32(height))[..., None]
            places[np.isnan(places)] = NOWHERE
            outside = cv2.BORDER_CONSTANT, (bottom, 0.0, 0.0, 0.0)
            ground = cv2.remap(self.height, places[..., 0], places[..., 1], cv2.INTER_LINEAR, None, *outside)
            return np.asarray(ground >= level)

        above = np.full(flat.shape[:2], top, dtype=np.float32)
        below = np.full(flat.shape[:2], bottom, dtype=np.float32)
        open_rays = np.ones(flat.shape[:2], dtype=np.bool_)
        for level in np.linspace(top, bottom, steps + 1)[:-1].astype(np.float32):
            hit = open_rays & in_ground(np.full(below.shape, level, dtype=np.float32))
            below[hit] = level
            open_rays &= ~hit
            above[open_rays] = level
        for _ in range(_BISECTIONS if top > bottom else 0):
            middle = ((above + below) / 2.0).astype(np.float32)
            hit = in_ground(middle)
            below, above = np.where(hit, middle, below), np.where(hit, above, middle)
        met = position + (flat - position) * (1.0 - below[..., None].astype(np.float64) / height)
        return np.asarray(met.reshape(-1, 2)[: foot.size // 2].reshape(foot.shape))


def bumps(size: tuple[int, int], seed: int, *, height: float, width: int = 200) -> Relief:
    """Smooth bumps at random, the highest ``height`` texels above the lowest point, tops about ``width`` apart."""
    # Noise on a coarse grid, enlarged by cubic interpolation: as smooth as hills are, at any size of the plane.
    rng = np.random.default_rng(seed)
    nodes = rng.random((2 * size[1] // width + 4, 2 * size[0] // width + 4), dtype=np.float32)
    smooth = cv2.GaussianBlur(nodes, (0, 0), 0.7)
    x, y = (np.arange(n, dtype=np.float32) * np.float32(2.0 / width) + np.float32(1.0) for n in size)
    across, down = np.meshgrid(x, y)
    ground = cv2.remap(smooth, across, down, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT)
    # Resampling is in steps of 1/32 node.
    ground = cv2.GaussianBlur(ground, (0, 0), width / 32.0)
    return Relief(_scaled(np.asarray(ground, dtype=np.float32), height))


def buildings(size: tuple[int, int], seed: int, *, height: float, width: int = 60) -> Relief:
    """Flat ground with boxes, between a quarter and the whole of ``height`` high: a town.

    Boxes are from a third of ``width`` texels to ``width`` wide, and cover about a third of the ground.
    """
    rng = np.random.default_rng(seed)
    ground = np.zeros((size[1], size[0]), dtype=np.float32)
    for k in range(max(1, round(0.8 * size[0] * size[1] / width**2))):
        x, y = (int(rng.integers(0, max(1, n - width))) for n in size)
        w, h = (int(n) for n in rng.integers(width // 3, width + 1, 2))
        ground[y : y + h, x : x + w] = height * (1.0 if k == 0 else rng.uniform(0.25, 1.0))
    return Relief(ground)


def slopes(size: tuple[int, int], seed: int, *, height: float, width: int = 400) -> Relief:
    """Parallel ridges and valleys with straight flanks, ``width`` texels apart, in a random direction."""
    rng = np.random.default_rng(seed)
    direction, phase = rng.uniform(0.0, np.pi), rng.random()
    x, y = np.arange(size[0], dtype=np.float32), np.arange(size[1], dtype=np.float32)
    across = (np.cos(direction) * x + np.sin(direction) * y[:, None]) / width + phase
    return Relief(_scaled(np.abs(across - np.rint(across)).astype(np.float32), height))


RELIEFS: dict[str, Callable[..., Relief]] = {"bumps": bumps, "buildings": buildings, "slopes": slopes}
"""Makers of relief by the kind of ground; each takes ``(size, seed, height=...)``."""


def _scaled(ground: Float32Array, height: float) -> Float32Array:
    low, high = float(ground.min()), float(ground.max())
    return ((ground - np.float32(low)) * np.float32(height / max(high - low, 1e-12))).astype(np.float32)
