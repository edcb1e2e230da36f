"""Tiles, their order, the cache and the number of workers never show in the result."""

import functools
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from examples.worlds.compositing_scenes import Scene, place_images, render
from rdstitch.compositing import CompositeOptions
from rdstitch.compositing.blender import MultibandBlender, margin, rounding_constant
from rdstitch.compositing.boxes import aligned, grown
from rdstitch.compositing.preparation import decide, prepare_composite
from rdstitch.compositing.tiles import TiledOutput
from rdstitch.local_alignment import DisplacementField
from rdstitch.synthetic.rendering import Photometry

WAYS = [("multiband", "graphcut"), ("multiband", "none"), ("feather", "none"), ("feather", "voronoi"), ("none", "none")]


@functools.cache
def _scene(bits: int) -> Scene:
    gains = np.linspace(0.8, 1.2, 6)
    return render(
        3, 2, size=(240, 180), photometry=Photometry(gain=gains, vignetting=0.3, noise=0.01, bits=bits), seed=8
    )


@functools.cache
def _prepared(blend: str, seam: str, bits: int) -> tuple[TiledOutput, NDArray[Any], NDArray[np.bool_]]:
    """A composite, and all of it as one tile."""
    scene = _scene(bits)
    options = CompositeOptions(blend=blend, seam=seam, max_memory=2**28)  # type: ignore[arg-type]
    with prepare_composite(decide(scene.images, scene.canvas, options)) as ready:
        return ready, *ready.renderer.tile((0, 0, *scene.canvas.size))


@pytest.mark.parametrize("bits", [8, 16])
@pytest.mark.parametrize(("blend", "seam"), WAYS)
@settings(max_examples=5, deadline=None)
@given(data=st.data())
def test_any_box_is_a_part_of_the_whole(blend: str, seam: str, bits: int, data: st.DataObject) -> None:
    ready, whole, covered = _prepared(blend, seam, bits)
    width, height = ready.size
    x = data.draw(st.integers(0, width - 1))
    y = data.draw(st.integers(0, height - 1))
    box = (x, y, data.draw(st.integers(x + 1, width)), data.draw(st.integers(y + 1, height)))
    pixels, inside = ready.renderer.tile(box)
    np.testing.assert_array_equal(inside, covered[y : box[3], x : box[2]])
    np.testing.assert_array_equal(pixels, whole[y : box[3], x : box[2]])


@pytest.mark.parametrize("seam", ["graphcut", "none"])
def test_any_box_of_locally_aligned_images_is_a_part_of_the_whole(seam: str) -> None:
    scene, rng = _scene(8), np.random.default_rng(5)
    fields = [DisplacementField((240, 180), rng.normal(0.0, 1.5, (6, 8, 2))) for _ in scene.frames]
    options = CompositeOptions(seam=seam, max_memory=2**28)  # type: ignore[arg-type]
    images = place_images(scene.sources, scene.cameras, scene.homographies, displacement=fields)
    with prepare_composite(decide(images, scene.canvas, options)) as ready:
        whole, covered = ready.renderer.tile((0, 0, *scene.canvas.size))
        for x, y in ((3, 7), (130, 64), (200, 90)):
            pixels, inside = ready.renderer.tile((x, y, x + 61, y + 43))
            np.testing.assert_array_equal(inside, covered[y : y + 43, x : x + 61])
            np.testing.assert_array_equal(pixels, whole[y : y + 43, x : x + 61])
        moved, straight = (warp.source_points(np.array([200.0]), np.array([150.0])) for warp in
                           (ready.renderer.warps[0], replace(ready.renderer.warps[0], displacement=None)))  # fmt: skip
    np.testing.assert_allclose(moved, straight + fields[0](straight))
    assert (whole != _prepared("multiband", seam, 8)[1]).any()


@pytest.mark.parametrize("workers", [1, 3])
def test_strips_are_the_whole(workers: int) -> None:
    scene = _scene(8)
    options = CompositeOptions(tile_size=256, workers=workers)
    with prepare_composite(decide(scene.images, scene.canvas, options)) as ready:
        pixels, alpha = (np.concatenate(parts) for parts in zip(*ready.strips(), strict=True))
    _, whole, covered = _prepared("multiband", "graphcut", 8)
    np.testing.assert_array_equal(pixels, whole)
    np.testing.assert_array_equal(alpha > 0, covered)


@settings(max_examples=25, deadline=None)
@given(bands=st.integers(1, 4), seed=st.integers(0, 1000))
def test_one_image_is_not_changed_by_blending(bands: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    constant = rounding_constant(255.0, True)
    box = aligned(grown((0, 0, 48, 32), margin(bands)), 1 << bands)
    pixels = rng.integers(0, 256, (box[3] - box[1], box[2] - box[0], 3)).astype(np.float32)
    weight = np.zeros(pixels.shape[:2], np.float32)
    inner = np.s_[-box[1] : 32 - box[1], -box[0] : 48 - box[0]]
    weight[inner] = 1.0
    blender = MultibandBlender(box, bands, 3, constant)
    blender.add(box, pixels.copy(), weight)
    np.testing.assert_array_equal(blender.result()[inner], pixels[inner])


@settings(max_examples=25, deadline=None)
@given(bands=st.integers(1, 4), seed=st.integers(0, 1000))
def test_blend_lies_between_constant_images(bands: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    size = 16 << bands
    low, high = sorted(rng.uniform(0, 255, 2))
    left = (rng.random((size, size)) < 0.5).astype(np.float32)
    blender = MultibandBlender((0, 0, size, size), bands, 1, rounding_constant(255.0, True))
    for value, weight in ((low, left), (high, 1 - left)):
        blender.add((0, 0, size, size), np.full((size, size, 1), value, np.float32), weight)
    result = blender.result()
    assert result.min() >= low - 0.2
    assert result.max() <= high + 0.2
