"""Pictures of a textured plane, as a camera with known lens and pose sees it.

Every output pixel is the mean of a grid of samples over its area, each traced through the lens to the plane and
interpolated in the texture: as an ideal sensor does it, and without aliasing.
"""

from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from rdstitch.camera import FloatArray
from rdstitch.errors import ArgumentError, OutputError
from rdstitch.synthetic.lenses import Lens
from rdstitch.synthetic.poses import Poses, plane_outline, to_picture, to_plane
from rdstitch.synthetic.textures import Picture, Texture

_SAMPLES_PER_STRIP = 1_000_000
_MAX_SUPERSAMPLE = 6
# What cubic interpolation needs around a sample, texels.
_APRON = 3


@dataclass(frozen=True)
class Photometry:
    """How light becomes a picture.

    Attributes
    ----------
    gain : float or ndarray of shape (N,)
        Exposure, one for all pictures or one a picture.
    vignetting : float
        Share of the light that is missing at the corners; it grows with the square of the radius.
    gamma : float
        Gain and vignetting act on ``value ** gamma``: 1 on the values themselves, 2.2 in linear light.
    blur : float
        Standard deviation of the lens's blur, px.
    noise : float
        Standard deviation of the noise, in units of full range; 0.01 is 2.5 grey levels of 8 bit.
    bits : int
        8 or 16.
    """

    gain: float | FloatArray = 1.0
    vignetting: float = 0.0
    gamma: float = 1.0
    blur: float = 0.0
    noise: float = 0.0
    bits: int = 8

    def __post_init__(self) -> None:
        """Check the bit depth."""
        if self.bits not in (8, 16):
            raise ArgumentError(f"pictures have 8 or 16 bits, not {self.bits}")


@dataclass(frozen=True)
class Relief:
    """Ground that is not flat: it gives parallax, and no homography describes it.

    Attributes
    ----------
    height : ndarray of shape (h, w), float32
        Height above the plane in texels, for each texel of the texture.
    steps : int
        Levels at which rays look for the ground, between the highest point and the plane.
    """

    height: NDArray[np.float32]
    steps: int = 16


@dataclass(frozen=True)
class Sequence:
    """Pictures of a plane, rendered when asked for, and the truth about them.

    Attributes
    ----------
    texture : Texture
        The plane. Its coordinates, texels, are the plane's; see :mod:`rdstitch.synthetic.poses`.
    lens : Lens
        Of all pictures; a :class:`rdstitch.camera.Camera` with a focal length, or another lens.
    poses : Poses
    photometry : Photometry
    relief : Relief, optional
        Height of the ground; a plane if not given.
    seed : int
        Of the noise.
    """

    texture: Texture
    lens: Lens
    poses: Poses
    photometry: Photometry = field(default_factory=Photometry)
    relief: Relief | None = None
    seed: int = 0

    def __len__(self) -> int:
        """Number of pictures."""
        return len(self.poses)

    @cached_property
    def _from_plane(self) -> FloatArray:
        return self.poses.from_plane()

    def from_plane(self, index: int) -> FloatArray:
        """Texels to focal-normalized undistorted points of one picture, shape (3, 3)."""
        return np.asarray(self._from_plane[index])

    def to_plane(self, index: int, points: ArrayLike) -> FloatArray:
        """Measured px (N, 2) of one picture to texels; NaN beyond the horizon or the lens."""
        return to_plane(self.lens, self.from_plane(index), points)

    def to_picture(self, index: int, points: ArrayLike) -> FloatArray:
        """Texels (N, 2) to measured px of one picture, also outside its border; NaN where it cannot see them."""
        return to_picture(self.lens, self.from_plane(index), points)

    def frame(self, index: int) -> NDArray[Any]:
        """Render one picture.

        Returns
        -------
        ndarray of shape (h, w) or (h, w, 3)
            uint8 or uint16; RGB. Black where the texture ends.
        """
        width, height = self.lens.image_size
        supersample = self._supersample(index)
        rows = max(1, _SAMPLES_PER_STRIP // (width * supersample**2))
        picture = np.concatenate(
            [self._strip(index, top, min(top + rows, height), supersample) for top in range(0, height, rows)]
        )
        return self._expose(index, picture)

    def frames(self) -> list[NDArray[Any]]:
        """Render all pictures."""
        return [self.frame(index) for index in range(len(self))]

    def write(self, folder: str | Path, name: str = "frame_{:04d}.png") -> list[Path]:
        """Render all pictures into a folder, one at a time.

        Parameters
        ----------
        folder : path
            Must exist.
        name : str
            Format of the file names, with the suffix of the file type.

        Raises
        ------
        OutputError
            When a picture cannot be written.
        """
        paths = []
        for index in range(len(self)):
            path = Path(folder) / name.format(index)
            picture = self.frame(index)
            bgr = picture if picture.ndim == 2 else np.ascontiguousarray(picture[:, :, ::-1])
            done, encoded = cv2.imencode(path.suffix, bgr)
            if not done:
                raise OutputError(f"{path}: cannot be encoded")
            try:
                path.write_bytes(encoded.tobytes())
            except OSError as error:
                raise OutputError(f"{path}: cannot be written: {error.strerror or error}") from error
            paths.append(path)
        return paths

    def reachable(self, scale: float = 1.0) -> NDArray[np.bool_]:
        """Which texels any picture shows.

        Parameters
        ----------
        scale : float
            Size of the mask in units of the texture's size.

        Returns
        -------
        ndarray of shape (h, w), bool
        """
        width, height = (max(1, round(n * scale)) for n in self.texture.size)
        mask = np.zeros((height, width), dtype=np.uint8)
        for outline in plane_outline(self.lens, self._from_plane):
            points = (outline[np.isfinite(outline).all(axis=1)] + 0.5) * scale - 0.5
            cv2.fillPoly(mask, [np.rint(points * 16.0).astype(np.int32)], 1, cv2.LINE_8, 4)
        return mask.astype(np.bool_)

    def _supersample(self, index: int) -> int:
        """Samples along each side of a pixel, so that they are no further apart than texels nearly everywhere."""
        width, height = self.lens.image_size
        u, v = np.meshgrid(np.linspace(0.0, width - 2.0, 9), np.linspace(0.0, height - 2.0, 7))
        points = np.stack([u, v], axis=-1).reshape(-1, 2)
        here = self.to_plane(index, points)
        step = np.stack([self.to_plane(index, points + d) - here for d in ((1.0, 0.0), (0.0, 1.0))])
        length = np.linalg.norm(step, axis=-1)
        length = length[np.isfinite(length)]
        if not len(length):
            raise ArgumentError(f"picture {index} sees nothing of the plane")
        return int(np.clip(np.ceil(np.quantile(length, 0.9)), 2, _MAX_SUPERSAMPLE))

    def _strip(self, index: int, top: int, bottom: int, supersample: int) -> Picture:
        """Rows ``top`` to ``bottom`` of a picture before exposure, in [0, 1]."""
        width = self.lens.image_size[0]
        inside = (np.arange(supersample) + 0.5) / supersample - 0.5
        u = (np.arange(width)[:, None] + inside).ravel()
        v = (np.arange(top, bottom)[:, None] + inside).ravel()
        points = np.stack(np.meshgrid(u, v), axis=-1)
        place = self.to_plane(index, points) if self.relief is None else self._on_relief(index, points, self.relief)
        samples = _sample(self.texture, place)
        return _area_mean(samples, supersample)

    def _on_relief(self, index: int, points: FloatArray, relief: Relief) -> FloatArray:
        """Where rays meet the ground: the first level, from the top, that is below it."""
        foot = self.to_plane(index, points)
        position, height = self.poses.position[index], self.poses.height[index]
        ground_height = np.ascontiguousarray(relief.height, dtype=np.float32)
        place = foot.copy()
        found = np.zeros(foot.shape[:-1], dtype=np.bool_)
        for level in np.linspace(float(relief.height.max()), 0.0, relief.steps, endpoint=False):
            at_level = position + (foot - position) * (1.0 - level / height)
            x, y = (np.nan_to_num(at_level[..., k], nan=-1e6).astype(np.float32) for k in (0, 1))
            under = cv2.remap(ground_height, x, y, cv2.INTER_NEAREST, borderValue=(0.0,))
            hit = ~found & (under >= level)
            place[hit] = at_level[hit]
            found |= hit
        return place

    def _expose(self, index: int, picture: Picture) -> NDArray[Any]:
        """Gain, vignetting, blur, noise and rounding."""
        settings = self.photometry
        height, width, channels = picture.shape
        gain = np.broadcast_to(np.asarray(settings.gain, dtype=np.float64), (len(self),))[index]
        u, v = np.arange(width) - self.lens.center[0], np.arange(height) - self.lens.center[1]
        radius2 = 4.0 * (u**2 + v[:, None] ** 2) / (width**2 + height**2)
        light = (gain * (1.0 - settings.vignetting * radius2)) ** (1.0 / settings.gamma)
        picture = picture * light[:, :, None].astype(np.float32)
        if settings.blur > 0.0:
            blurred = cv2.GaussianBlur(picture, (0, 0), settings.blur, borderType=cv2.BORDER_REFLECT)
            picture = np.asarray(blurred, dtype=np.float32).reshape(picture.shape)
        if settings.noise > 0.0:
            rng = np.random.default_rng((self.seed, index))
            picture = picture + settings.noise * rng.standard_normal(picture.shape, dtype=np.float32)
        full = 2**settings.bits - 1
        rounded = np.rint(np.clip(picture, 0.0, 1.0) * np.float32(full))
        exposed: NDArray[Any] = rounded.astype(np.uint8 if settings.bits == 8 else np.uint16)
        return exposed[:, :, 0] if channels == 1 else exposed


def _sample(texture: Texture, place: FloatArray) -> Picture:
    """Texture interpolated at texels (h, w, 2), shape (h, w, channels); 0 outside and at NaN."""
    width, height = texture.size
    finite = np.isfinite(place).all(axis=-1)
    inside = finite & ((place >= -0.5) & (place <= np.array([width, height]) - 0.5)).all(axis=-1)
    if not inside.any():
        return np.zeros((*place.shape[:2], texture.channels), dtype=np.float32)
    within = place[inside]
    low = np.maximum(np.floor(within.min(axis=0)).astype(int) - _APRON, 0)
    high = np.minimum(np.ceil(within.max(axis=0)).astype(int) + _APRON + 1, (width, height))
    part = texture.region(int(low[0]), int(low[1]), int(high[0]), int(high[1]))
    x, y = (np.where(inside, place[..., k] - low[k], 0.0).astype(np.float32) for k in (0, 1))
    samples = cv2.remap(part, x, y, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
    samples = samples.reshape(*place.shape[:2], texture.channels)
    samples[~inside] = 0.0
    return samples.astype(np.float32, copy=False)


def _area_mean(samples: Picture, factor: int) -> Picture:
    """Mean over ``factor`` x ``factor`` blocks."""
    height, width, channels = samples.shape
    mean = cv2.resize(samples, (width // factor, height // factor), interpolation=cv2.INTER_AREA)
    return np.asarray(mean, dtype=np.float32).reshape(height // factor, width // factor, channels)
