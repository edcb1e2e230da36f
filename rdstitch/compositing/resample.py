"""The samples, opacity and weight of an image at the pixels of a box of the canvas."""

import cv2
import numpy as np
from numpy.typing import NDArray

from rdstitch.arrays import AnyArray, Float32Array
from rdstitch.compositing.source_images import LoadedImage
from rdstitch.compositing.transparency import OPAQUE
from rdstitch.compositing.warp import Geometry
from rdstitch.options.composite_options import Interpolation

INTERPOLATION: dict[Interpolation, int] = {
    "linear": cv2.INTER_LINEAR,
    "cubic": cv2.INTER_CUBIC,
    "lanczos": cv2.INTER_LANCZOS4,
}
TOO_LONG = 32767  # OpenCV resamples no side as long as this, pixels
_KERNEL_MARGIN = 8  # room around a piece of an image for the kernel of the resampling, pixels
_MIN_WEIGHT = np.float32(1e-6)


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


def sample(image: LoadedImage, geometry: Geometry, interpolation: Interpolation = "cubic") -> AnyArray:
    """Resample an image; content is mirrored outside of it, so that filters find no edge there.

    The image is prepared for ``geometry.warp.shrink``; the result is (h, w) or (h, w, C), in its sample type.
    """
    map_x, map_y = _mirrored(image.reduction, geometry)
    return _remap_whole(image.pixels, map_x, map_y, INTERPOLATION[interpolation])


def sample_places(reduction: int, geometry: Geometry) -> tuple[NDArray[np.int16], NDArray[np.uint16]]:
    """Where :func:`sample` takes pixels from, as ``cv2.remap`` takes it quickest: (h, w, 2), and parts of a pixel."""
    places, parts = cv2.convertMaps(*_mirrored(reduction, geometry), cv2.CV_16SC2)
    return np.asarray(places, dtype=np.int16), np.asarray(parts, dtype=np.uint16)


def sample_opacity(image: LoadedImage, geometry: Geometry) -> Float32Array | None:
    """Opacity (h, w), 0 where the image is masked out; None for an image without a mask."""
    if image.opacity is None:
        return None
    map_x, map_y = _mirrored(image.reduction, geometry)
    opacity = _remap_whole(image.opacity, map_x, map_y, cv2.INTER_LINEAR) * np.float32(1.0 / OPAQUE)
    # The outer half of the last opaque pixel is outside.
    return np.where(opacity >= np.float32(0.5 * image.opacity_step), opacity, np.float32(0.0))


def _mirrored(reduction: int, geometry: Geometry) -> tuple[Float32Array, Float32Array]:
    """Pixels of the image, reduced by so much, all inside it."""
    map_x, map_y = geometry.maps
    if not geometry.inside.all():
        # Mirroring rounds: what is inside keeps its coordinates, whatever else the box holds.
        mirrored = [_mirror(m, n) for m, n in zip((map_x, map_y), geometry.warp.camera.image_size, strict=True)]
        for values, exact in zip(mirrored, (map_x, map_y), strict=True):
            np.copyto(values, exact, where=geometry.inside)
        map_x, map_y = mirrored
    if reduction > 1:
        half, factor = np.float32(0.5), np.float32(reduction)
        map_x, map_y = ((m + half) / factor - half for m in (map_x, map_y))
    return map_x, map_y


def _remap_whole(pixels: AnyArray, map_x: Float32Array, map_y: Float32Array, interpolation: int) -> AnyArray:
    """``cv2.remap`` from an image; of a very long one, from the piece of it that is needed."""
    if max(pixels.shape[:2]) < TOO_LONG:
        return remap(pixels, map_x, map_y, interpolation)
    left, top = (max(0, int(m.min()) - _KERNEL_MARGIN) for m in (map_x, map_y))
    right, bottom = (int(m.max()) + 2 + _KERNEL_MARGIN for m in (map_x, map_y))
    # Whole pixels are subtracted exactly, so the piece does not change the result.
    piece = pixels[top:bottom, left:right]
    return remap(piece, map_x - np.float32(left), map_y - np.float32(top), interpolation)


def remap(piece: AnyArray, map_x: AnyArray, map_y: AnyArray, interpolation: int) -> AnyArray:
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
