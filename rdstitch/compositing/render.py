"""One tile of the output: which images contribute where, and their samples blended."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import combinations
from typing import Any

import cv2
import numpy as np

from rdstitch.arrays import AnyArray, BoolArray, Float32Array, Int32Array, IntArray, UInt8Array
from rdstitch.compositing.blender import MultibandBlender, margin, per_channel, rounding_constant
from rdstitch.compositing.boxes import Box, aligned, bounds, cut, grown, intersection, without
from rdstitch.compositing.image_cache import ImageCache
from rdstitch.compositing.photometric import Exposure, full_scale
from rdstitch.compositing.resample import border_weight, sample, sample_opacity
from rdstitch.compositing.seam_finder import NO_OWNER, SeamMap
from rdstitch.compositing.warp import Geometry, Warp, locate
from rdstitch.options.composite_options import CompositeOptions


@dataclass(frozen=True, eq=False)
class Layer:
    """One image's weight on a part of the canvas."""

    index: int  # of the image
    box: Box  # part of the canvas: x0, y0, x1, y1, pixels, end exclusive
    weight: Float32Array  # (h, w), float32: 0 where the image contributes nothing
    geometry: Geometry  # of the same part

    def part(self, box: Box) -> "Layer":
        """The same for a box within this one."""
        return Layer(self.index, box, cut(self.weight, self.box, box), self.geometry.on(box))

    def weighted_part(self, box: Box) -> "Layer | None":
        """The smallest part that holds all of the weight on ``box``; None where there is none."""
        common = intersection(self.box, box)
        if common is None:
            return None
        held = bounds(cut(self.weight, self.box, common), common)
        return None if held is None else self.part(held)


@dataclass(frozen=True)
class Renderer:
    """Everything that is needed to compute any tile of the output, in any order."""

    warps: Sequence[Warp]
    images: ImageCache
    exposure: Exposure
    seams: SeamMap | None
    options: CompositeOptions
    bands: int  # of the multi-band blending
    channels: int
    dtype: np.dtype[Any]  # of the images' samples and of the output

    def tile(self, box: Box) -> tuple[AnyArray, BoolArray]:
        """Samples (h, w, C) and coverage (h, w) of one box of the canvas.

        What a pixel gets does not depend on the box.
        """
        blended = self.options.blend == "multiband"
        around = self.support(box)
        layers = [part for layer in self._layers(around) if (part := layer.weighted_part(around)) is not None]
        covered = np.zeros((box[3] - box[1], box[2] - box[0]), dtype=np.bool_)
        for layer in layers:
            if (common := intersection(layer.box, box)) is not None:
                cut(covered, box, common)[...] |= cut(layer.weight, layer.box, common) > 0
        pixels = np.zeros((*covered.shape, self.channels), dtype=self.dtype)
        zone = self._contact_zone(layers, box) if blended else None
        for rest in without(box, zone):
            self._paste(layers, rest, cut(pixels, box, rest))
        if zone is not None:
            cv2.copyTo(self._multiband(layers, zone), _as_mask(cut(covered, box, zone)), cut(pixels, box, zone))
        return pixels, covered

    def shown(self, box: Box) -> set[int]:
        """Find the images that a tile takes samples from, but for those where the seam map misses a pixel."""
        around = self.support(box)
        reaching = set(self._reaching(around))
        if self.seams is None:
            return reaching
        owners = set(self.seams.owners(around))
        # Where nobody owns anything, masks decide who covers it.
        masked = {index for index in reaching if NO_OWNER in owners and self.images.masked(index)}
        return reaching & (owners | masked)

    def part(self, box: Box, shares: int) -> tuple["Renderer", tuple[int, ...]]:
        """What the tiles of a box need, which it gives the same samples; and the images that are left in it.

        It takes one of so many shares of the memory.
        """
        around = self.support(box)
        chosen = self._reaching(around)
        part = replace(
            self,
            warps=[self.warps[index] for index in chosen],
            images=self.images.part(chosen, self.images.limit // shares),
            exposure=self.exposure.part(chosen),
            seams=None if self.seams is None else self.seams.part(around, chosen),
        )
        return part, tuple(chosen)

    def _reaching(self, box: Box) -> list[int]:
        """The images whose bounds have pixels in common with a box."""
        low, high = self._bounds[:, :2], self._bounds[:, 2:]
        common = np.minimum(high, box[2:]) > np.maximum(low, box[:2])
        chosen: list[int] = np.flatnonzero(common.all(axis=1)).tolist()
        return chosen

    @cached_property
    def _bounds(self) -> IntArray:
        """Boxes of all images, (N, 4): tiles look at all of them."""
        return np.array([warp.box for warp in self.warps], dtype=np.intp).reshape(-1, 4)

    def layer(self, index: int, box: Box) -> tuple[AnyArray, BoolArray, BoolArray]:
        """One image on its own in a box: samples (h, w, C), what it covers, and what of that the composite shows."""
        geometry = locate(self.warps[index], box)
        covered, opacity = geometry.inside, self._opacity(index, geometry)
        if opacity is not None:
            covered = covered & (opacity > 0)
        mask = np.zeros(covered.shape, dtype=np.bool_)
        for layer in self.owners(box):
            if layer.index == index:
                cut(mask, box, layer.box)[...] |= layer.weight > 0
        samples = self._samples(Layer(index, box, covered.astype(np.float32), geometry), box)
        samples[~covered] = 0
        return samples, covered, mask

    def owners(self, box: Box) -> list[Layer]:
        """The images of a box with the weights (h, w) that their samples have in it, which add up to 1."""
        layers = self._layers(box)
        total = np.zeros((box[3] - box[1], box[2] - box[0]), dtype=np.float32)
        for layer in layers:
            cut(total, box, layer.box)[...] += layer.weight
        np.maximum(total, np.finfo(np.float32).tiny, out=total)
        shares = [replace(layer, weight=np.divide(layer.weight, cut(total, box, layer.box))) for layer in layers]
        return [part for layer in shares if (part := layer.weighted_part(box)) is not None]

    def _contact_zone(self, layers: Sequence[Layer], box: Box) -> Box | None:
        """The part of a box in which blending can mix images; elsewhere it would return the only one there."""
        supports = [self._blend_support(layer.box) for layer in layers]
        shared = [common for pair in combinations(supports, 2) if (common := intersection(*pair)) is not None]
        parts = [part for common in shared if (part := intersection(common, box)) is not None]
        if not parts:
            return None
        x0, y0, x1, y1 = zip(*parts, strict=True)
        return min(x0), min(y0), max(x1), max(y1)

    def support(self, box: Box) -> Box:
        """The box whose samples a box depends on."""
        return self._blend_support(box) if self.options.blend == "multiband" else box

    def _blend_support(self, box: Box) -> Box:
        """The box from which weights reach a box through multi-band blending."""
        return aligned(grown(box, margin(self.bands)), 1 << self.bands)

    def _paste(self, layers: Sequence[Layer], box: Box, pixels: AnyArray) -> None:
        """Fill ``pixels``, which are those of ``box``, with the layers, or with their weighted mean."""
        parts = [part for layer in layers if (part := layer.weighted_part(box)) is not None]
        if self.options.blend != "feather":
            # One owner per pixel: a product and a quotient would cost the last bit.
            for part in parts:
                cv2.copyTo(self._samples(part, part.box), _as_mask(part.weight > 0), cut(pixels, box, part.box))
            return
        total, weights = np.zeros(pixels.shape, dtype=np.float32), np.zeros(pixels.shape[:2], dtype=np.float32)
        for part in parts:
            cut(total, box, part.box)[...] += self._samples(part, part.box) * per_channel(part.weight, self.channels)
            cut(weights, box, part.box)[...] += part.weight
        total /= per_channel(np.where(weights > 0, weights, np.float32(1.0)), self.channels)
        pixels[...] = self._as_samples(total)

    def _multiband(self, layers: Sequence[Layer], box: Box) -> AnyArray:
        """Blend in bands, with the margin around the box that they need."""
        outer = self._blend_support(box)
        constant = rounding_constant(full_scale(self.dtype), self.dtype.kind == "u")
        blender = MultibandBlender(outer, self.bands, self.channels, constant)
        for layer in layers:
            part, common = intersection(self._blend_support(layer.box), outer), intersection(layer.box, outer)
            if part is None or common is None:
                continue
            weight = np.zeros((part[3] - part[1], part[2] - part[0]), dtype=np.float32)
            cut(weight, part, common)[...] = cut(layer.weight, layer.box, common)
            blender.add(part, self._samples(layer, part).astype(np.float32), weight)
        return self._as_samples(cut(blender.result(), outer, box))

    def _as_samples(self, values: Float32Array) -> AnyArray:
        if self.dtype.kind != "u":
            return values.astype(self.dtype)
        return np.clip(np.rint(values), 0, np.float32(full_scale(self.dtype))).astype(self.dtype)

    def _samples(self, layer: Layer, box: Box) -> AnyArray:
        """Resampled and exposure-corrected samples (h, w, C) of one image; mirrored content outside of it."""
        geometry = layer.geometry.on(box)
        image = self.images.get(layer.index)
        pixels = sample(image, geometry, self.options.interpolation)
        return self.exposure.correct(layer.index, geometry, pixels.reshape(*geometry.shape, self.channels))

    def _layers(self, box: Box) -> list[Layer]:
        if self.seams is None and self.options.blend != "none":
            return list(self._bordered(box))
        return self._owned(box)

    def _bordered(self, box: Box, wanted: BoolArray | None = None) -> Iterator[Layer]:
        """Every image that covers part of a box, or of what is wanted of it, with weights that fall to its border."""
        for index in self._reaching(box):
            part = intersection(self.warps[index].box, box)
            assert part is not None
            geometry = self._placed(index, part, box)
            inside = geometry.inside if wanted is None else geometry.inside & cut(wanted, box, part)
            if (shown := bounds(inside, part)) is None:
                continue
            geometry = geometry.on(shown)
            weight = border_weight(geometry)
            if wanted is not None:
                weight[~cut(wanted, box, shown)] = 0.0
            opacity = self._opacity(index, geometry)
            yield Layer(index, shown, weight if opacity is None else weight * opacity, geometry)

    def _placed(self, index: int, part: Box, box: Box) -> Geometry:
        """The geometry of an image on its part of a box, with a lattice for all that blending can need of it there."""
        return locate(self.warps[index], intersection(self.support(part), box) or part).on(part)

    def _opacity(self, index: int, geometry: Geometry) -> Float32Array | None:
        if not self.images.masked(index):
            return None
        return sample_opacity(self.images.get(index), geometry)

    def _owned(self, box: Box) -> list[Layer]:
        """Layers where each pixel has one owner, or, for feathering along a seam, shares of its owners.

        The owner is the image with the largest share in the seam map among those that cover the pixel; where the map,
        being coarse, has none of them, the one whose border is farthest.
        """
        shape = (box[3] - box[1], box[2] - box[0])
        layers = list(self._shared(box))
        if len(layers) == 1 and layers[0].box == box and (layers[0].weight == 1).all():
            return layers
        owner, best = np.full(shape, NO_OWNER, dtype=np.int32), np.zeros(shape, dtype=np.float32)
        for layer in layers:
            _assign(owner, best, box, layer)
        soft = layers if self.options.blend == "feather" else []
        missing = owner == NO_OWNER
        if (left_over := bounds(missing, box)) is not None:
            best[...] = 0.0
            for layer in self._bordered(left_over, cut(missing, box, left_over)):
                _assign(owner, best, box, layer)
                layers.append(layer)
        if self.options.blend == "feather":
            owner[~missing] = NO_OWNER
        return soft + [_only_owned(owner, box, layer) for layer in layers]

    def _shared(self, box: Box) -> Iterator[Layer]:
        """Images that own part of a box in the seam map, with their shares where they cover it."""
        for index in [] if self.seams is None else self.seams.owners(box):
            part = intersection(self.warps[index].box, box) if index != NO_OWNER else None
            if part is None or self.seams is None:
                continue
            weight = self.seams.weights(index, part)
            if (shown := bounds(weight, part)) is None:
                continue
            # Of many images that overlap each owns little of a tile; a view would hold the whole.
            weight, geometry = cut(weight, part, shown).copy(), self._placed(index, shown, box)
            if not geometry.filled:
                weight[~geometry.inside] = 0.0
            if (opacity := self._opacity(index, geometry)) is not None:
                weight[opacity == 0] = 0.0
            if (layer := Layer(index, shown, weight, geometry).weighted_part(shown)) is not None:
                yield layer


def _assign(owner: Int32Array, best: Float32Array, box: Box, layer: Layer) -> None:
    """Give a layer's image the pixels where its weight is the largest so far."""
    previous = cut(best, box, layer.box)
    better = layer.weight > previous
    np.copyto(previous, layer.weight, where=better)
    np.copyto(cut(owner, box, layer.box), layer.index, where=better)


def _only_owned(owner: Int32Array, box: Box, layer: Layer) -> Layer:
    """The layer with weight 1 where its image owns the pixels, and 0 elsewhere."""
    owned = cut(owner, box, layer.box) == layer.index
    # An image may have a layer from the seam map and one for what the map left over: each gets its own pixels.
    owned &= layer.weight > 0
    return replace(layer, weight=owned.astype(np.float32))


def _as_mask(chosen: BoolArray) -> UInt8Array:
    """Not 0 where chosen, as OpenCV takes it."""
    return chosen.view(np.uint8)
