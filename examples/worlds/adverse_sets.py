"""Rendered sets with what real images suffer from: bodies, vehicles, borders, blur, odd lenses and shutters, dirt.

Each is a :class:`rdstitch.synthetic.RenderedSequence`, so that the truth is known, and is judged as the other sets are;
see :mod:`examples.worlds.trust_sets`.
"""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from rdstitch.arrays import FloatArray
from rdstitch.geometry.camera import Camera
from rdstitch.synthetic import ImageTexture, Photometry, RenderedSequence, grid_poses, ground, repeated, sequence_over

ADVERSE = (
    "body", "vehicle", "banner", "round border", "curved border", "blurred", "off centre", "crops", "rolling shutter",
    "cylinder", "dirt", "bit rot",
)  # fmt: skip
"""Kinds of sets. A right result, a warning that names the place, or a refusal: each is honest."""

SOLVABLE_ADVERSE = ("body", "vehicle", "banner", "round border", "curved border", "blurred")
"""Kinds of which a person would make an image."""

Surface = Callable[[FloatArray], FloatArray]


def _unchanged(index: int, pixels: NDArray[np.uint8]) -> NDArray[np.uint8]:
    return pixels


@dataclass(frozen=True)
class AlteredSequence(RenderedSequence):
    """Images of a surface, altered after they were taken.

    ``alter``: takes the index of an image and its pixels to other pixels of the same shape. ``shutter``: how far the
    camera moves while an image is read out from its first to its last row, texels; shape (N, 2). ``offset``: where the
    corner of each image lies in the uncropped one, pixels; shape (N, 2).
    """

    alter: Callable[[int, NDArray[np.uint8]], NDArray[np.uint8]] = _unchanged
    height: Surface | None = None  # height of the ground over places (..., 2), all in texels; smooth
    shutter: FloatArray = field(default_factory=lambda: np.zeros((1, 2)))
    offset: FloatArray = field(default_factory=lambda: np.zeros((1, 2)))
    dispensable: frozenset[int] = frozenset()  # images without which the set is solved, too

    def frame(self, index: int) -> NDArray[np.uint8]:
        return self.alter(index, super().frame(index))

    def to_plane(self, index: int, points: ArrayLike) -> FloatArray:
        measured = np.asarray(points, dtype=np.float64)
        foot = super().to_plane(index, measured + self._of(self.offset, index))
        foot = foot + self._moved(index, measured[..., 1])
        if self.height is None:
            return foot
        position, above = self.poses.position[index], self.poses.height[index]
        place = foot
        for _ in range(12):
            place = position + (foot - position) * (1.0 - self.height(place)[..., None] / above)
        return place

    def to_image(self, index: int, points: ArrayLike) -> FloatArray:
        place = np.asarray(points, dtype=np.float64)
        if self.height is not None:
            position, above = self.poses.position[index], self.poses.height[index]
            place = position + (place - position) / (1.0 - self.height(place)[..., None] / above)
        seen = super().to_image(index, place)
        for _ in range(12):
            seen = super().to_image(index, place - self._moved(index, seen[..., 1]))
        return seen - self._of(self.offset, index)

    def _moved(self, index: int, row: FloatArray) -> FloatArray:
        share = row / self.lens.image_size[1] - 0.5
        moved: FloatArray = share[..., None] * self._of(self.shutter, index)
        return moved

    @staticmethod
    def _of(values: FloatArray, index: int) -> FloatArray:
        own: FloatArray = values[index % len(values)]
        return own


@dataclass(frozen=True)
class RottenSequence(AlteredSequence):
    """Images of which one has flipped bits in its JPEG file."""

    rotten: int = 0  # index of that image
    flips: int = 1  # bits that are flipped

    def write(self, folder: str | Path, name: str = "frame_{:04d}.jpg") -> list[Path]:
        paths = super().write(folder, name)
        data = bytearray(paths[self.rotten].read_bytes())
        rng = np.random.default_rng((self.seed, self.rotten, self.flips))
        begin = data.rfind(b"\xff\xda") + 14
        for place in rng.integers(begin, len(data) - 2, self.flips).tolist():
            data[place] ^= 1 << int(rng.integers(8))
        paths[self.rotten].write_bytes(bytes(data))
        return paths


def adverse_set(kind: str, seed: int) -> RenderedSequence:
    """A random set of one of :data:`ADVERSE`."""
    rng = np.random.default_rng((seed, ADVERSE.index(kind), 78))
    size = (400, 300)
    lens = Camera(size, distortion=float(rng.uniform(-0.3, 0.0)), focal=float(rng.uniform(0.8, 1.4) * size[0]))
    if kind == "off centre":
        angle, far = rng.uniform(0.0, 2.0 * np.pi), lens.scale * rng.uniform(0.05, 0.2)
        x, y = np.array(lens.center) + far * np.array([np.cos(angle), np.sin(angle)])
        lens = replace(lens, center=(float(x), float(y)))
    count = 6 if kind == "blurred" else int(rng.integers(3, 7))
    tilt = tuple(rng.uniform(-0.1, 0.1, 2).tolist())
    poses = grid_poses(
        lens, count, 1, overlap=float(rng.uniform(0.45, 0.65)), yaw=0.15, shift=0.05, tilt=(tilt[0], tilt[1]), seed=seed
    )
    plane = partial(repeated, period=int(rng.integers(60, 120))) if kind == "dirt" else ground
    taken = sequence_over(
        partial(plane, seed=seed), lens, poses, photometry=Photometry(vignetting=0.1, noise=0.01), seed=seed, margin=120
    )
    altered = AlteredSequence(taken.texture, taken.lens, taken.poses, taken.photometry, seed=seed)
    return _ALTERATIONS[kind](altered, rng)


def _region(size: tuple[int, int], share: float, rng: np.random.Generator) -> NDArray[np.bool_]:
    """A strip along one side of the image, or one of its corners, of a share of its area."""
    width, height = size
    u, v = np.meshgrid(np.arange(width) / width, np.arange(height) / height)
    corner = (u < np.sqrt(share)) & (v < np.sqrt(share))
    regions: list[NDArray[np.bool_]] = [v > 1.0 - share, v < share, u > 1.0 - share, u < share, corner]
    return regions[int(rng.integers(len(regions)))]


def _body(altered: AlteredSequence, rng: np.random.Generator) -> RenderedSequence:
    """A part of the robot in every image."""
    region = _region(altered.lens.image_size, float(rng.uniform(0.15, 0.4)), rng)
    return replace(altered, alter=_pasted(altered.lens.image_size, region, rng))


def _banner(altered: AlteredSequence, rng: np.random.Generator) -> RenderedSequence:
    """A logo and a line of data in every image."""
    width, height = altered.lens.image_size
    region = np.zeros((height, width), dtype=np.bool_)
    across, down = rng.uniform(0.4, 0.9) * width, rng.uniform(0.1, 0.3) * height
    left, top = rng.uniform(0, width - across), rng.uniform(0, height - down)
    region[int(top) : int(top + down), int(left) : int(left + across)] = True
    return replace(altered, alter=_pasted((width, height), region, rng))


def _pasted(
    size: tuple[int, int], region: NDArray[np.bool_], rng: np.random.Generator
) -> Callable[[int, NDArray[np.uint8]], NDArray[np.uint8]]:
    """The same texture over a region of every image, with noise of its own in each."""
    texture = (ground(size, int(rng.integers(1 << 30))).region(0, 0, *size)[:, :, 0] * 255.0).astype(np.float32)
    seed = int(rng.integers(1 << 30))

    def paste(index: int, pixels: NDArray[np.uint8]) -> NDArray[np.uint8]:
        noise = np.random.default_rng((seed, index)).normal(0.0, 2.5, region.shape)
        shown = np.clip(texture + noise, 0, 255).astype(np.uint8)
        mask = region if pixels.ndim == 2 else region[:, :, None]
        return np.where(mask, shown if pixels.ndim == 2 else shown[:, :, None], pixels)

    return paste


def _vehicle(altered: AlteredSequence, rng: np.random.Generator) -> RenderedSequence:
    """A part of every image shows another plane, which moves little and otherwise."""
    size = altered.lens.image_size
    region = _region(size, float(rng.uniform(0.15, 0.4)), rng)
    slow = altered.poses.position.mean(axis=0) + 0.15 * (altered.poses.position - altered.poses.position.mean(axis=0))
    sway = rng.normal(0.0, 0.04, slow.shape) * altered.poses.height[:, None]
    poses = replace(altered.poses, position=slow + sway)
    other = sequence_over(
        partial(ground, seed=int(rng.integers(1 << 30))),
        altered.lens,
        poses,
        photometry=altered.photometry,
        seed=altered.seed + 1,
        margin=60,
    )

    def cover(index: int, pixels: NDArray[np.uint8]) -> NDArray[np.uint8]:
        mask = region if pixels.ndim == 2 else region[:, :, None]
        return np.where(mask, other.frame(index), pixels)

    return replace(altered, alter=cover)


def _round_border(altered: AlteredSequence, rng: np.random.Generator) -> RenderedSequence:
    """Black outside a circle, as behind a microscope or a circular fisheye."""
    width, height = altered.lens.image_size
    u, v = np.meshgrid(np.arange(width) - width / 2, np.arange(height) - height / 2)
    return replace(altered, alter=_blackened(np.hypot(u, v) > rng.uniform(0.48, 0.6) * min(width, height) * 1.1))


def _curved_border(altered: AlteredSequence, rng: np.random.Generator) -> RenderedSequence:
    """Black beyond a curve on two sides, as images have that were undistorted before."""
    width, height = altered.lens.image_size
    u, v = np.meshgrid(np.linspace(-1, 1, width), np.linspace(-1, 1, height))
    bend = rng.uniform(0.1, 0.25)
    return replace(altered, alter=_blackened(np.abs(v) > 1.0 - bend * (1.0 - u**2)))


def _blackened(outside: NDArray[np.bool_]) -> Callable[[int, NDArray[np.uint8]], NDArray[np.uint8]]:
    def blacken(index: int, pixels: NDArray[np.uint8]) -> NDArray[np.uint8]:
        altered = pixels.copy()
        altered[outside] = 0
        return altered

    return blacken


def _blurred(altered: AlteredSequence, rng: np.random.Generator) -> RenderedSequence:
    """One image out of focus."""
    which, sigma = int(rng.integers(len(altered))), float(rng.uniform(4.0, 8.0))

    def blur(index: int, pixels: NDArray[np.uint8]) -> NDArray[np.uint8]:
        return np.asarray(cv2.GaussianBlur(pixels, (0, 0), sigma), dtype=np.uint8) if index == which else pixels

    return replace(altered, alter=blur, dispensable=frozenset({which}))


def _crops(altered: AlteredSequence, rng: np.random.Generator) -> RenderedSequence:
    """Images cut from larger ones, each elsewhere, so that the lens's axis is not at one place in them."""
    far = 0.05 * float(np.hypot(*altered.lens.image_size))
    return replace(altered, offset=rng.uniform(-far, far, (len(altered), 2)))


def _rolling_shutter(altered: AlteredSequence, rng: np.random.Generator) -> RenderedSequence:
    """The camera moves on while its rows are read, by up to a tenth of the image, not always equally fast."""
    speed = rng.uniform(0.03, 0.1) * altered.lens.image_size[0]
    angle = rng.uniform(0.0, 2.0 * np.pi)
    pace = rng.uniform(0.5, 1.0, (len(altered), 1))
    return replace(altered, shutter=speed * pace * np.array([[np.cos(angle), np.sin(angle)]]))


def _cylinder(altered: AlteredSequence, rng: np.random.Generator) -> RenderedSequence:
    """A wall that is slightly curved along the way."""
    middle = float(altered.poses.position[:, 0].mean())
    reach = max(float(np.ptp(altered.poses.position[:, 0])), float(altered.lens.image_size[0]))
    depth = float(rng.uniform(0.05, 0.15)) * float(altered.poses.height.mean())

    def height(place: FloatArray) -> FloatArray:
        bulge: FloatArray = -depth * np.clip((place[..., 0] - middle) / (0.5 * reach), -1.5, 1.5) ** 2
        return bulge

    return replace(altered, height=height)


def _dirt(altered: AlteredSequence, rng: np.random.Generator) -> RenderedSequence:
    """Equal tiles, each with a stain of its own: drawn on the plane, so that they move with it."""
    width, height = altered.texture.size
    pixels = altered.texture.region(0, 0, width, height).copy()
    for _ in range(width * height // 40_000):
        place = (int(rng.integers(width)), int(rng.integers(height)))
        cv2.circle(pixels, place, int(rng.integers(2, 6)), [float(rng.uniform(0, 1))] * pixels.shape[2], -1)
    return replace(altered, texture=ImageTexture(pixels[:, :, 0] if pixels.shape[2] == 1 else pixels))


def _bit_rot(altered: AlteredSequence, rng: np.random.Generator) -> RenderedSequence:
    """A few flipped bits in one JPEG file."""
    own = {name: getattr(altered, name) for name in ("texture", "lens", "poses", "photometry", "seed")}
    return RottenSequence(**own, rotten=int(rng.integers(len(altered))), flips=int(2 ** rng.integers(0, 7)))


_ALTERATIONS: dict[str, Callable[[AlteredSequence, np.random.Generator], RenderedSequence]] = {
    "body": _body,
    "vehicle": _vehicle,
    "banner": _banner,
    "round border": _round_border,
    "curved border": _curved_border,
    "blurred": _blurred,
    "off centre": lambda altered, rng: altered,
    "crops": _crops,
    "rolling shutter": _rolling_shutter,
    "cylinder": _cylinder,
    "dirt": _dirt,
    "bit rot": _bit_rot,
}
