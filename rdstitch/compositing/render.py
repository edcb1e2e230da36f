"""One tile of the output: which pictures have a say where, and their samples put together."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rdstitch.compositing.exposure import Exposure, full_scale
from rdstitch.compositing.multiband import MultibandBlender, aligned, grown, margin, rounded, rounding_constant
from rdstitch.compositing.options import CompositeOptions
from rdstitch.compositing.pictures import PictureCache
from rdstitch.compositing.seams import SeamMap
from rdstitch.compositing.warp import (
    Box,
    Float32Array,
    Geometry,
    Warp,
    border_weight,
    intersection,
    locate,
    sample,
    sample_opacity,
)

_NOBODY = -1


@dataclass(frozen=True)
class Layer:
    """One picture's weight on a box of the canvas: (h, w), float32, 0 where it has no say."""

    index: int
    box: Box
    weight: Float32Array


@dataclass(frozen=True)
class Renderer:
    """Everything that is needed to compute any tile of the output, in any order.

    Attributes
    ----------
    warps : sequence of Warp
    pictures : PictureCache
    exposure : Exposure
    seams : SeamMap or None
    options : CompositeOptions
    bands : int
        Of the multi-band blending.
    channels : int
    dtype : dtype
        Of the pictures' samples and of the output.
    """

    warps: Sequence[Warp]
    pictures: PictureCache
    exposure: Exposure
    seams: SeamMap | None
    options: CompositeOptions
    bands: int
    channels: int
    dtype: np.dtype[Any]

    def tile(self, box: Box) -> tuple[NDArray[Any], NDArray[np.bool_]]:
        """Samples (h, w, C) and coverage (h, w) of one box of the canvas.

        What a px gets does not depend on the box.
        """
        outer = box
        if self.options.blend == "multiband":
            outer = aligned(grown(box, margin(self.bands)), self.bands)
        layers = self._layers(outer)
        covered = np.zeros((box[3] - box[1], box[2] - box[0]), dtype=np.bool_)
        for layer in layers:
            if (common := intersection(layer.box, box)) is not None:
                _part(covered, box, common)[...] |= _part(layer.weight, layer.box, common) > 0
        if not covered.any():
            return np.zeros((*covered.shape, self.channels), dtype=self.dtype), covered
        if self.options.blend == "multiband" and len(layers) > 1:
            values = self._multiband(layers, outer, box)
        else:
            values = self._mean(layers, box)
        values[~covered] = 0.0
        if self.dtype.kind == "u":
            np.rint(values, out=values)
            np.clip(values, 0, np.float32(full_scale(self.dtype)), out=values)
        return values.astype(self.dtype), covered

    def _mean(self, layers: Sequence[Layer], box: Box) -> Float32Array:
        """Weighted mean of the layers, px by px; of one layer, its samples."""
        shape = (box[3] - box[1], box[2] - box[0])
        total, weights = np.zeros((*shape, self.channels), dtype=np.float32), np.zeros(shape, dtype=np.float32)
        for layer in layers:
            common = intersection(layer.box, box)
            if common is None or not (weight := _part(layer.weight, layer.box, common)).any():
                continue
            if self.options.blend != "feather":
                # One owner per px: a product and a quotient would cost the last bit.
                np.copyto(_part(total, box, common), self._samples(layer.index, common), where=weight[..., None] > 0)
                continue
            _part(total, box, common)[...] += self._samples(layer.index, common) * weight[..., None]
            _part(weights, box, common)[...] += weight
        if self.options.blend == "feather":
            total /= np.where(weights > 0, weights, np.float32(1.0))[..., None]
        return total

    def _multiband(self, layers: Sequence[Layer], outer: Box, box: Box) -> Float32Array:
        """Blend in bands on the outer box; the inner one is right."""
        blender = MultibandBlender(outer, self.bands, self.channels, self._rounding)
        for layer in layers:
            felt = aligned(grown(_bounds(layer), margin(self.bands)), self.bands)
            part = intersection(felt, outer)
            assert part is not None
            weight = np.zeros((part[3] - part[1], part[2] - part[0]), dtype=np.float32)
            common = intersection(part, layer.box)
            assert common is not None
            _part(weight, part, common)[...] = _part(layer.weight, layer.box, common)
            blender.add(part, self._samples(layer.index, part), weight)
        return np.ascontiguousarray(_part(blender.result(), outer, box))

    @property
    def _rounding(self) -> np.float32:
        """See :func:`rdstitch.compositing.multiband.rounding_constant`."""
        return rounding_constant(full_scale(self.dtype), self.dtype.kind == "u")

    def _samples(self, index: int, box: Box) -> Float32Array:
        """Resampled and exposure-corrected samples (h, w, C) of one picture; mirrored content outside of it."""
        warp = self.warps[index]
        map_x, map_y = warp.maps(box)
        width, height = warp.camera.image_size
        inside = (map_x >= -0.5) & (map_x < width - 0.5) & (map_y >= -0.5) & (map_y < height - 0.5)
        geometry = Geometry(box, map_x, map_y, inside)
        pixels = sample(warp, self.pictures[index], geometry, self.options.interpolation)
        values = self.exposure.correct(index, warp, box, pixels.reshape(*inside.shape, self.channels))
        return rounded(values, self._rounding) if self.options.blend == "multiband" else values

    def _layers(self, box: Box) -> list[Layer]:
        """Weights of all pictures that have a say in a box."""
        if self.seams is None and self.options.blend != "none":
            located = [(k, self._located(k, box)) for k in range(len(self.warps))]
            return [Layer(k, found[0].box, found[1]) for k, found in located if found is not None]
        return self._owned_layers(box)

    def _located(self, index: int, box: Box) -> tuple[Geometry, Float32Array] | None:
        """Geometry and border weight of a picture on the part of a box that it can reach."""
        warp = self.warps[index]
        part = intersection(warp.box, box)
        geometry = None if part is None else locate(warp, part)
        if geometry is None:
            return None
        weight = border_weight(warp, geometry)
        if self.pictures.masked(index):
            opacity = sample_opacity(warp, self.pictures[index], geometry)
            weight = weight if opacity is None else weight * opacity
        return geometry, weight

    def _owned_layers(self, box: Box) -> list[Layer]:
        """Layers where each px has one owner, or, for feathering along a seam, shares of its owners.

        The owner is the picture with the largest share in the seam map among those that cover the px; where the map,
        being coarse, has none of them, the one whose border is farthest.
        """
        shape = (box[3] - box[1], box[2] - box[0])
        owner, best = np.full(shape, _NOBODY, dtype=np.int32), np.zeros(shape, dtype=np.float32)
        soft: list[Layer] = []
        for k in self.seams.owners(box) if self.seams is not None else ():
            found = self._located(k, box)
            if found is not None and self.seams is not None:
                part = found[0].box
                share = np.where(found[1] > 0, self.seams.share(k, part), np.float32(0.0))
                _claim(owner, best, box, part, share, k)
                soft.append(Layer(k, part, share))
        missing = owner == _NOBODY
        if missing.any():
            best[...] = 0.0
            left = _bounds(Layer(_NOBODY, box, missing.astype(np.float32)))
            for k in range(len(self.warps)):
                found = self._located(k, left)
                if found is not None:
                    part = found[0].box
                    free = np.where(_part(missing, box, part), found[1], np.float32(0.0))
                    _claim(owner, best, box, part, free, k)
        if self.options.blend == "feather":
            return _with_leftovers(soft, owner, missing, box)
        return [_owned(owner, box, int(k)) for k in np.unique(owner) if k != _NOBODY]


def _claim(owner: NDArray[np.int32], best: Float32Array, box: Box, part: Box, share: Float32Array, index: int) -> None:
    """Give ``index`` the px of ``part`` where its share is the largest so far."""
    previous = _part(best, box, part)
    better = share > previous
    previous[better] = share[better]
    _part(owner, box, part)[better] = index


def _owned(owner: NDArray[np.int32], box: Box, index: int) -> Layer:
    """The px of one owner, on their bounding box."""
    whole = Layer(index, box, (owner == index).astype(np.float32))
    bounds = _bounds(whole)
    return Layer(index, bounds, np.ascontiguousarray(_part(whole.weight, box, bounds)))


def _with_leftovers(soft: list[Layer], owner: NDArray[np.int32], missing: NDArray[np.bool_], box: Box) -> list[Layer]:
    """Shares along the seams, and whole px where the seam map knows no owner."""
    alone = np.where(missing, owner, _NOBODY)
    return [layer for layer in soft if layer.weight.any()] + [
        _owned(alone, box, int(k)) for k in np.unique(alone) if k != _NOBODY
    ]


def _bounds(layer: Layer) -> Box:
    """Bounding box, on the canvas, of where a layer has weight."""
    rows, columns = (np.flatnonzero(layer.weight.any(axis=axis)) for axis in (1, 0))
    x, y = layer.box[:2]
    return int(x + columns[0]), int(y + rows[0]), int(x + columns[-1] + 1), int(y + rows[-1] + 1)


def _part(values: NDArray[Any], box: Box, part: Box) -> NDArray[Any]:
    """View of the values on ``box`` that lie on ``part``."""
    x, y = part[0] - box[0], part[1] - box[1]
    return values[y : y + part[3] - part[1], x : x + part[2] - part[0]]
