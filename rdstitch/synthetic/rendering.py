"""Images of a textured plane, as a camera with known lens and pose sees it.

Every output pixel is the mean of a grid of samples over its area, each traced through the lens to the plane and
interpolated in the texture: as an ideal sensor does it, and without aliasing.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import ArrayLike

from rdstitch.arrays import AnyArray, BoolArray, Float32Array, FloatArray
from rdstitch.errors import ArgumentError, OutputError
from rdstitch.io.write import write_image
from rdstitch.synthetic.lenses import Lens
from rdstitch.synthetic.poses import Poses, fit_to_plane, pixels_of_texels, plane_outline, texels_of_pixels
from rdstitch.synthetic.relief import NOWHERE, Relief
from rdstitch.synthetic.textures import Texture

_PIXELS_PER_STRIP = 400_000
_SIXTEEN_BITS = (".png", ".tif", ".tiff")
_MAX_SAMPLES_PER_SIDE = 6
# A ray that ends so far from a point, texels, does not see it.
_HIDDEN = 0.5
# What cubic interpolation needs around a sample, texels.
_APRON = 3


@dataclass(frozen=True, eq=False)
class Photometry:
    """The way from light to an image."""

    gain: float | FloatArray = 1.0  # exposure, one for all images or one an image; kept as (1,) or (N,)
    vignetting: float = 0.0  # share of the light that is missing at the corners; it grows with the square of the radius
    gamma: float = 1.0  # gain and vignetting act on value ** gamma: 1 on the values themselves, 2.2 in linear light
    blur: float = 0.0  # standard deviation of the lens's blur, pixels
    noise: float = 0.0  # standard deviation of the noise, fraction of full range; 0.01 is 2.5 grey levels of 8 bit
    bits: int = 8  # 8 or 16

    def __post_init__(self) -> None:
        if self.bits not in (8, 16):
            raise ArgumentError(f"images have 8 or 16 bits, not {self.bits}")
        object.__setattr__(self, "gain", np.atleast_1d(np.asarray(self.gain, dtype=np.float64)))
        least = np.array([*np.ravel(self.gain), self.blur, self.noise])
        if not (np.isfinite([*least, self.vignetting, self.gamma]).all() and least.min() >= 0.0 and self.gamma > 0.0):
            raise ArgumentError(f"light must be finite, and no gain, blur or noise below 0, nor gamma 0: {self}")


@dataclass(frozen=True)
class RenderedSequence:
    """Images of a plane, rendered on demand, and their ground truth.

    The coordinates of the texture, texels, are the plane's, see :mod:`rdstitch.synthetic.poses`; the lens is a
    :class:`rdstitch.geometry.camera.Camera` with a focal length, or another one; ``relief`` is the height of the ground
    above the plane, if it is no plane. ``seed`` is of the noise. Of each pixel ``samples`` are taken along each side:
    as many as the texture needs, at least 2, if not given; with 1, large images are rendered faster, and alias a
    little.
    """

    texture: Texture
    lens: Lens
    poses: Poses
    photometry: Photometry = field(default_factory=Photometry)
    relief: Relief | None = None
    seed: int = 0
    samples: int | None = None

    def __post_init__(self) -> None:
        shape = np.shape(self.photometry.gain)
        if shape not in ((1,), (len(self),)):
            raise ArgumentError(f"expected one gain, or one for each of {len(self)} images, not of shape {shape}")

    def __len__(self) -> int:
        return len(self.poses)

    @cached_property
    def _from_plane(self) -> FloatArray:
        return self.poses.from_plane()

    def from_plane(self, index: int) -> FloatArray:
        """Texels to focal-normalized undistorted points of one image, shape (3, 3)."""
        return np.asarray(self._from_plane[index])

    def to_plane(self, index: int, points: ArrayLike) -> FloatArray:
        """Measured pixels (N, 2) of one image to points of the plane, texels; NaN beyond the horizon or the lens."""
        return texels_of_pixels(self.lens, self.from_plane(index), points)

    def to_ground(self, index: int, points: ArrayLike) -> FloatArray:
        """Measured pixels (N, 2) of one image to the texels that they show; :meth:`to_plane` on a plane."""
        return self._on_ground(index, self.to_plane(index, points))

    def ground_to_image(self, index: int, points: ArrayLike) -> FloatArray:
        """Points of the ground, texels (N, 2), to measured pixels of one image; NaN where something hides them."""
        ground = np.asarray(points, dtype=np.float64)
        if self.relief is None:
            return self.to_image(index, ground)
        position, camera_height = self.poses.position[index], float(self.poses.height[index])
        fraction = 1.0 - self.relief.at(ground) / camera_height
        foot = position + (ground - position) / fraction[:, None]
        hidden = np.linalg.norm(self._on_ground(index, foot) - ground, axis=1) > _HIDDEN
        return np.where(hidden[:, None], np.nan, self.to_image(index, foot))

    def to_image(self, index: int, points: ArrayLike) -> FloatArray:
        """Points of the plane, texels (N, 2), to measured pixels of one image, also outside its border.

        NaN where it cannot see them. Relief does not matter: the points lie on the plane.
        """
        return pixels_of_texels(self.lens, self.from_plane(index), points)

    def frame(self, index: int) -> AnyArray:
        """Render one image, uint8 or uint16 (h, w) or RGB (h, w, 3), black where the texture ends."""
        width, height = self.lens.image_size
        settings = self.photometry
        rng = np.random.default_rng((self.seed, index))
        full = 2**settings.bits - 1
        image = np.empty((height, width, self.texture.channels), dtype=np.uint8 if settings.bits == 8 else np.uint16)
        rows = max(1, _PIXELS_PER_STRIP // width)
        for top in range(0, height, rows):
            bottom = min(top + rows, height)
            light = self._light(index, top, bottom)
            if settings.noise > 0.0:
                light += settings.noise * rng.standard_normal(light.shape, dtype=np.float32)
            np.rint(np.clip(light, 0.0, 1.0, out=light) * np.float32(full), out=image[top:bottom], casting="unsafe")
        return image[:, :, 0] if image.shape[2] == 1 else image

    def frames(self) -> list[AnyArray]:
        """Render all images."""
        return [self.frame(index) for index in range(len(self))]

    def write(self, folder: str | Path, name: str = "frame_{:04d}.png") -> list[Path]:
        """Render all images into a folder, one at a time; ``name`` is the format of the file names, with a suffix."""
        paths = []
        for index in range(len(self)):
            path = Path(folder) / name.format(index)
            if self.photometry.bits > 8 and path.suffix.lower() not in _SIXTEEN_BITS:
                raise OutputError(f"{path}: cannot hold images of {self.photometry.bits} bits; use .png or .tif")
            write_image(path, self.frame(index))
            paths.append(path)
        return paths

    def reachable(self) -> BoolArray:
        """Mark the texels that any image shows."""
        width, height = self.texture.size
        mask = np.zeros((height, width), dtype=np.uint8)
        for outline in plane_outline(self.lens, self._from_plane):
            points = outline[np.isfinite(outline).all(axis=1)]
            cv2.fillPoly(mask, [np.rint(points * 16.0).astype(np.int32)], 1, cv2.LINE_8, 4)
        return mask.astype(np.bool_)

    def _light(self, index: int, top: int, bottom: int) -> Float32Array:
        """Rows ``top`` to ``bottom`` of an image without noise: what falls on the sensor."""
        settings = self.photometry
        width, height = self.lens.image_size
        # Blur needs the rows beyond the strip.
        apron = int(np.ceil(4.0 * settings.blur))
        light = self._sharp(index, top - apron, bottom + apron)
        gain = np.broadcast_to(settings.gain, (len(self),))[index]
        u, v = np.arange(width) - self.lens.center[0], np.arange(top - apron, bottom + apron) - self.lens.center[1]
        radius2 = 4.0 * (u**2 + v[:, None] ** 2) / (width**2 + height**2)
        factor = (gain * np.maximum(1.0 - settings.vignetting * radius2, 0.0)) ** (1.0 / settings.gamma)
        light *= factor[:, :, None].astype(np.float32)
        if apron == 0:
            return light
        blurred = cv2.GaussianBlur(light, (0, 0), settings.blur, borderType=cv2.BORDER_REPLICATE)
        return np.asarray(blurred, dtype=np.float32).reshape(light.shape)[apron:-apron]

    def _sharp(self, index: int, top: int, bottom: int) -> Float32Array:
        """Rows ``top`` to ``bottom`` of the plane as a perfect lens and sensor see it, in [0, 1]."""
        u, v = np.arange(-1, self.lens.image_size[0] + 1), np.arange(top - 1, bottom + 1)
        wide = self.to_plane(index, np.stack(np.meshgrid(u, v), axis=-1))
        foot = wide[1:-1, 1:-1]
        # Within a pixel the lens and the perspective are linear to a few 1e-4 pixels.
        along = (wide[1:-1, 2:] - wide[1:-1, :-2]) / 2.0
        down = (wide[2:, 1:-1] - wide[:-2, 1:-1]) / 2.0
        count = self.samples or _samples_per_side(along, down)
        offsets = (np.arange(count) + 0.5) / count - 0.5
        total = np.zeros((*foot.shape[:2], self.texture.channels), dtype=np.float32)
        for dv in offsets:
            for du in offsets:
                total += _sample(self.texture, self._on_ground(index, foot + du * along + dv * down))
        return np.divide(total, np.float32(count**2), out=total)

    def _on_ground(self, index: int, foot: FloatArray) -> FloatArray:
        """Texels (..., 2) that rays of an image show which would meet the plane at ``foot``."""
        if self.relief is None:
            return foot
        return self.relief.seen_from(self.poses.position[index], float(self.poses.height[index]), foot)


def _samples_per_side(along: FloatArray, down: FloatArray) -> int:
    """Samples along each side of a pixel, so that they are no further apart than texels nearly everywhere."""
    longest = np.maximum(np.hypot(*np.moveaxis(along, -1, 0)), np.hypot(*np.moveaxis(down, -1, 0)))
    longest = longest[np.isfinite(longest)]
    if not len(longest):
        return 1
    return int(np.clip(np.ceil(np.quantile(longest, 0.9)), 2, _MAX_SAMPLES_PER_SIDE))


def _sample(texture: Texture, place: FloatArray) -> Float32Array:
    """Texture interpolated at texels (h, w, 2), shape (h, w, channels); 0 outside and at NaN."""
    # NaN, a ray that meets nothing, is sent where nothing is, and does not count for the region that is needed.
    axes = [np.ascontiguousarray(place[..., k]) for k in (0, 1)]
    low, high = [], []
    for coordinate, size in zip(axes, texture.size, strict=True):
        least, most = np.fmin.reduce(coordinate, axis=None), np.fmax.reduce(coordinate, axis=None)
        if not (least < size and most > -1.0):
            return np.zeros((*place.shape[:2], texture.channels), dtype=np.float32)
        low.append(max(int(least) - _APRON, 0))
        high.append(min(int(most) + _APRON + 2, size))
    part = texture.region(low[0], low[1], high[0], high[1])
    x, y = (np.nan_to_num(axis - start, nan=float(NOWHERE)) for axis, start in zip(axes, low, strict=True))
    samples = cv2.remap(
        part, x.astype(np.float32), y.astype(np.float32), cv2.INTER_CUBIC, borderMode=cv2.BORDER_CONSTANT
    )
    return np.asarray(samples, dtype=np.float32).reshape(*place.shape[:2], texture.channels)


def sequence_over(
    plane: Texture | Callable[[tuple[int, int]], Texture],
    lens: Lens,
    poses: Poses,
    *,
    photometry: Photometry | None = None,
    relief: Relief | Callable[[tuple[int, int]], Relief] | None = None,
    seed: int = 0,
    margin: int = 16,
) -> RenderedSequence:
    """Images of a plane that is made as large as they need it; the poses may lie anywhere and are moved.

    ``plane`` makes the plane for a given size, such as ``lambda size: ground(size, seed=1)``, or is a texture, on which
    the poses are centred. ``relief`` are heights, or what makes them for the size of the plane, such as ``lambda size:
    bumps(size, 1, height=40.0)``. Around what the images show ``margin`` texels are left.
    """
    moved, size = fit_to_plane(lens, poses, margin)
    settings = Photometry() if photometry is None else photometry
    if callable(plane):
        texture = plane(size)
    else:
        texture, spare = plane, np.array(plane.size) - size
        if (spare < 0).any():
            raise ArgumentError(f"the texture has {plane.size} texels, the images need {size}")
        moved = moved.moved(spare // 2)
    return RenderedSequence(texture, lens, moved, settings, relief(texture.size) if callable(relief) else relief, seed)
