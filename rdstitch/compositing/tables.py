"""A composite as tables: where each image's samples come from and what they count, for one set of images after another.

What depends on the place of the images is computed once. A set then takes one resampling of what is seen of each
image, one product and one sum.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import chain
from typing import Self

import cv2
import numpy as np
from numpy.typing import NDArray

from rdstitch.arrays import AnyArray, Float32Array, UInt8Array
from rdstitch.compositing.boxes import Box, cut
from rdstitch.compositing.canvas import Canvas
from rdstitch.compositing.photometric import DEPTHS, full_scale
from rdstitch.compositing.preparation import decide, prepare_composite
from rdstitch.compositing.resample import INTERPOLATION, TOO_LONG, remap, sample_places
from rdstitch.compositing.source_images import PlacedImage, block_side, smoothed
from rdstitch.errors import ArgumentError, LimitError
from rdstitch.options.composite_options import CompositeOptions


@dataclass(frozen=True, eq=False)
class _Share:
    index: int
    box: Box
    places: tuple[NDArray[np.int16], NDArray[np.uint16]]
    weight: Float32Array
    factors: Float32Array  # (h, w, C): weight times gain, for images with the channels of the first ones


@dataclass(frozen=True, eq=False)
class CompositeTables:
    """Everything about a composite but the samples of its images."""

    alpha: UInt8Array  # (H, W), uint8: 255 where an image lies, else 0
    _sizes: tuple[tuple[int, int], ...]
    _shrinks: tuple[float, ...]
    _shares: tuple[_Share, ...]
    _offset: Float32Array | None  # (H, W, C), share of the full range
    _interpolation: int
    channels: int  # of the images that are there now

    @classmethod
    def of(cls, images: Sequence[PlacedImage], canvas: Canvas, options: CompositeOptions) -> Self:
        """Tables of a canvas, by exposure and seams of the images that are there now.

        Neighbours are feathered along their seams where ``options`` have them blended in bands, which takes longer
        than all the rest; highlights are clipped where it compresses them.
        """
        blend = "feather" if options.blend == "multiband" else options.blend
        options = replace(options, blend=blend, crop="none")
        with prepare_composite(decide(images, canvas, options)) as tiles:
            renderer, box = tiles.renderer, tiles.box
            covered = np.zeros((box[3] - box[1], box[2] - box[0]), dtype=np.uint8)
            exposure, channels = renderer.exposure, renderer.channels
            offset = np.zeros((*covered.shape, channels), dtype=np.float32) if exposure.offset else None
            shares = []
            for layer in renderer.owners(box):
                cut(covered, box, layer.box)[layer.weight > 0] = 255
                factors = exposure.factors(layer.index, layer.geometry) * layer.weight[..., None]
                if offset is not None:
                    part = factors - layer.weight[..., None]
                    cut(offset, box, layer.box)[...] += part * np.float32(exposure.offset)
                (x, y), (x0, y0, x1, y1) = box[:2], layer.box
                places = sample_places(block_side(layer.geometry.warp.shrink), layer.geometry)
                within = (x0 - x, y0 - y, x1 - x, y1 - y)
                shares.append(_Share(layer.index, within, places, layer.weight, factors))
            shrinks = tuple(warp.shrink for warp in renderer.warps)
            kernel = INTERPOLATION[options.interpolation]
            sizes = tuple(image.camera.image_size for image in images)
            if max(*covered.shape, *chain(*sizes)) >= TOO_LONG:
                raise LimitError(f"images and output of tables must have sides below {TOO_LONG} pixels")
            return cls(covered, sizes, shrinks, tuple(shares), offset, kernel, channels)

    def compose(self, images: Sequence[AnyArray]) -> AnyArray:
        """Put a set of images together.

        In the order of those that the tables were made for, (H, W) or (H, W, C), each of the size of its camera. Of
        other bands than these, exposure is left as it is.
        """
        self.check(images)
        first = images[0]
        channels = 1 if first.ndim == 2 else first.shape[2]
        corrected = channels == self.channels
        height, width = self.alpha.shape
        total = np.zeros((height, width * channels), dtype=np.float32)
        if corrected and self._offset is not None:
            total += self._offset.reshape(total.shape) * np.float32(full_scale(first.dtype))
        samples = [smoothed(image, shrink)[0] for image, shrink in zip(images, self._shrinks, strict=True)]
        for share in self._shares:
            x0, y0, x1, y1 = share.box
            factors = share.factors if corrected else np.repeat(share.weight[..., None], channels, axis=2)
            pixels = remap(samples[share.index], *share.places, self._interpolation)
            # OpenCV multiplies samples of any type by fractions, several times faster than numpy.
            pixels, factors = (values.reshape(y1 - y0, -1) for values in (pixels, factors))
            product = cv2.multiply(pixels, factors, dtype=cv2.CV_32F)
            part = total[y0:y1, x0 * channels : x1 * channels]
            cv2.add(part, product, dst=part)
        # Rounded and clipped to the type; the type stubs lack scalars.
        done = cv2.subtract(total, 0.0, dtype=DEPTHS[first.dtype.name])  # type: ignore[call-overload]
        return np.asarray(done).reshape(height, width, *first.shape[2:])

    def check(self, images: Sequence[AnyArray]) -> None:
        """Refuse images that the tables are not for."""
        if len(images) != len(self._sizes):
            raise ArgumentError(f"expected {len(self._sizes)} images, not {len(images)}")
        for number, (image, size) in enumerate(zip(images, self._sizes, strict=True), 1):
            if image.ndim not in (2, 3) or image.shape[1::-1] != size:
                raise ArgumentError(f"image {number} is of shape {image.shape}; its camera has {size[0]} x {size[1]}")
            kind, first = (image.shape[2:], image.dtype), (images[0].shape[2:], images[0].dtype)
            if kind != first or image.dtype.name not in DEPTHS:
                raise ArgumentError(f"image {number} has samples unlike the first, or not uint8, uint16 or float32")
