"""One tile of the output: which pictures have a say where, and their samples put together."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rdstitch.compositing.exposure import Exposure, full_scale
from rdstitch.compositing.multiband import MultibandBlender, aligned, grown, margin, rounded, rounding_constant, spread
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
    """One picture's weight on a part of the canvas.

    Attributes
    ----------
    index : int
        Of the picture.
    geometry : Geometry
        Of the part of the canvas.
    weight : ndarray of shape (h, w), float32
        0 where the picture has no say.
    """

    index: int
    geometry: Geometry
    weight: Float32Array

    @property
    def box(self) -> Box:
        """Part of the canvas: x0, y0, x1, y1, px, end exclusive."""
        return self.geometry.box

    def bounds(self) -> Box:
        """Smallest box that holds all of the weight."""
        return _bounds(self.weight, self.box)


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
                np.copyto(_part(total, box, common), self._samples(layer, common), where=(weight > 0)[..., None])
                continue
            _part(total, box, common)[...] += self._samples(layer, common) * spread(weight, self.channels)
            _part(weights, box, common)[...] += weight
        if self.options.blend == "feather":
            total /= spread(np.where(weights > 0, weights, np.float32(1.0)), self.channels)
        return total

    def _multiband(self, layers: Sequence[Layer], outer: Box, box: Box) -> Float32Array:
        """Blend in bands on the outer box; the inner one is right."""
        blender = MultibandBlender(outer, self.bands, self.channels, self._rounding)
        for layer in layers:
            felt = aligned(grown(layer.bounds(), margin(self.bands)), self.bands)
            part = intersection(felt, outer)
            assert part is not None
            weight = np.zeros((part[3] - part[1], part[2] - part[0]), dtype=np.float32)
            common = intersection(part, layer.box)
            assert common is not None
            _part(weight, part, common)[...] = _part(layer.weight, layer.box, common)
            blender.add(part, self._samples(layer, part), weight)
        return np.ascontiguousarray(_part(blender.result(), outer, box))

    @property
    def _rounding(self) -> np.float32:
        """See :func:`rdstitch.compositing.multiband.rounding_constant`."""
        return rounding_constant(full_scale(self.dtype), self.dtype.kind == "u")

    def _samples(self, layer: Layer, box: Box) -> Float32Array:
        """Resampled and exposure-corrected samples (h, w, C) of one picture; mirrored content outside of it."""
        index, warp = layer.index, self.warps[layer.index]
        known = intersection(layer.box, box) == box
        geometry = layer.geometry.part(box) if known else locate(warp, box)
        pixels = sample(warp, self.pictures[index], geometry, self.options.interpolation)
        values = self.exposure.correct(index, warp, box, pixels.reshape(*geometry.inside.shape, self.channels))
        return rounded(values, self._rounding) if self.options.blend == "multiband" else values

    def _layers(self, box: Box) -> list[Layer]:
        """Weights of all pictures that have a say in a box."""
        if self.seams is None and self.options.blend != "none":
            return list(self._bordered(box))
        return self._owned(box)

    def _bordered(self, box: Box) -> Iterator[Layer]:
        """Every picture that covers part of a box, with weights that fall to its border."""
        for index, warp in enumerate(self.warps):
            if (part := intersection(warp.box, box)) is None:
                continue
            geometry = locate(warp, part)
            if geometry.inside.any():
                weight = border_weight(warp, geometry)
                opacity = self._opacity(index, geometry)
                yield Layer(index, geometry, weight if opacity is None else weight * opacity)

    def _opacity(self, index: int, geometry: Geometry) -> Float32Array | None:
        """Opacity of a picture that has a mask."""
        if not self.pictures.masked(index):
            return None
        return sample_opacity(self.warps[index], self.pictures[index], geometry)

    def _owned(self, box: Box) -> list[Layer]:
        """Layers where each px has one owner, or, for feathering along a seam, shares of its owners.

        The owner is the picture with the largest share in the seam map among those that cover the px; where the map,
        being coarse, has none of them, the one whose border is farthest.
        """
        shape = (box[3] - box[1], box[2] - box[0])
        owner, best = np.full(shape, _NOBODY, dtype=np.int32), np.zeros(shape, dtype=np.float32)
        layers = list(self._shared(box))
        for layer in layers:
            _claim(owner, best, box, layer)
        soft = layers if self.options.blend == "feather" else []
        missing = owner == _NOBODY
        if missing.any():
            best[...] = 0.0
            for layer in self._bordered(_bounds(missing, box)):
                layer.weight[~_part(missing, box, layer.box)] = 0.0
                _claim(owner, best, box, layer)
                layers.append(layer)
        if self.options.blend == "feather":
            owner[~missing] = _NOBODY
        return soft + [piece for layer in layers if (piece := _won(owner, box, layer)) is not None]

    def _shared(self, box: Box) -> Iterator[Layer]:
        """Pictures that own part of a box in the seam map, with their shares where they cover it."""
        if self.seams is None:
            return
        for index in self.seams.owners(box):
            part = intersection(self.warps[index].box, box)
            if part is None:
                continue
            geometry = locate(self.warps[index], part)
            share = self.seams.share(index, part)
            share[~geometry.inside] = 0.0
            if (opacity := self._opacity(index, geometry)) is not None:
                share[opacity == 0] = 0.0
            if share.any():
                yield Layer(index, geometry, share)


def _claim(owner: NDArray[np.int32], best: Float32Array, box: Box, layer: Layer) -> None:
    """Give a layer's picture the px where its weight is the largest so far."""
    previous = _part(best, box, layer.box)
    better = layer.weight > previous
    np.copyto(previous, layer.weight, where=better)
    np.copyto(_part(owner, box, layer.box), layer.index, where=better)


def _won(owner: NDArray[np.int32], box: Box, layer: Layer) -> Layer | None:
    """The layer with weight 1 where its picture owns the px, and 0 elsewhere; None where it owns nothing."""
    owned = _part(owner, box, layer.box) == layer.index
    # A picture may have a layer from the seam map and one for what the map left over: each gets its own px.
    owned &= layer.weight > 0
    if not owned.any():
        return None
    bounds = _bounds(owned, layer.box)
    return Layer(layer.index, layer.geometry.part(bounds), _part(owned, layer.box, bounds).astype(np.float32))


def _bounds(values: NDArray[Any], box: Box) -> Box:
    """Smallest box that holds all values on ``box`` that are not 0."""
    rows, columns = (np.flatnonzero(values.any(axis=axis)) for axis in (1, 0))
    x, y = box[:2]
    return int(x + columns[0]), int(y + rows[0]), int(x + columns[-1] + 1), int(y + rows[-1] + 1)


def _part(values: NDArray[Any], box: Box, part: Box) -> NDArray[Any]:
    """View of the values on ``box`` that lie on ``part``."""
    x, y = part[0] - box[0], part[1] - box[1]
    return values[y : y + part[3] - part[1], x : x + part[2] - part[0]]
