"""An output that is computed in blocks elsewhere is the one that is computed here."""

import pickle
from collections import Counter
from collections.abc import Generator, Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rdstitch.cache import Cache, Stored
from rdstitch.compositing import CompositeOptions, PlacedImage
from rdstitch.compositing.blocks import Block
from rdstitch.compositing.compositor import compose
from rdstitch.compositing.tiles import OutputStrip
from rdstitch.io import DecodedImage
from rdstitch.synthetic.rendering import Photometry
from tests.compositing_scenes import Scene, render


@pytest.fixture(scope="module")
def scene() -> Scene:
    """Larger than one block of four tiles of 256 pixels a side."""
    gains = np.linspace(0.8, 1.2, 9)
    return render(9, 1, size=(240, 180), photometry=Photometry(gain=gains, vignetting=0.3, noise=0.01), seed=8)


@pytest.mark.parametrize(
    ("blend", "seam", "crop"),
    [("multiband", "graphcut", "auto"), ("feather", "voronoi", "none"), ("feather", "none", "none")],
)
def test_blocks_give_the_same_bytes(scene: Scene, tmp_path: Path, blend: Any, seam: Any, crop: Any) -> None:
    options = CompositeOptions(blend=blend, seam=seam, crop=crop, tile_size=256)
    store, computed, images = Cache.at(tmp_path), [], []

    def elsewhere(blocks: Iterable[Block]) -> Generator[list[Stored[OutputStrip]]]:
        for block in blocks:
            # As a worker in another process has it.
            copy = pickle.loads(pickle.dumps(block))
            computed.append(copy.tiles.box)
            images.append(copy.images)
            yield copy.compute(store)

    here = compose(scene.images, scene.canvas, options)
    shares: list[float] = []
    there = compose(scene.images, scene.canvas, options, shares.append, elsewhere)
    assert len(computed) > 1
    assert min(map(len, images)) < len(scene.frames)
    np.testing.assert_array_equal(there.pixels, here.pixels)
    np.testing.assert_array_equal(there.alpha, here.alpha)
    assert shares == sorted(shares)
    assert shares[-1] == pytest.approx(1.0)
    assert not any(file.is_file() for file in tmp_path.rglob("*")), "strips are removed when they were taken"


@pytest.mark.parametrize(("columns", "rows"), [(12, 1), (3, 24)])
def test_no_image_is_read_for_more_than_two_blocks(columns: int, rows: int, tmp_path: Path) -> None:
    """Once for exposure and seams besides, however little memory a worker has."""
    scene, read, blocks = render(columns, rows, size=(160, 120), scale=0.75), Counter[int](), 0

    def counted(index: int, placed: PlacedImage) -> PlacedImage:
        def load() -> DecodedImage:
            read[index] += 1
            return placed.read()

        return replace(placed, read=load)

    def elsewhere(tasks: Iterable[Block]) -> Generator[list[Stored[OutputStrip]]]:
        for block in tasks:
            nonlocal blocks
            blocks += 1
            # Room for one image.
            renderer = replace(
                block.tiles.renderer, images=block.tiles.renderer.images.part(range(len(block.images)), 1)
            )
            yield replace(block, tiles=replace(block.tiles, renderer=renderer)).compute(Cache.at(tmp_path))

    images = [counted(index, placed) for index, placed in enumerate(scene.images)]
    compose(images, scene.canvas, CompositeOptions(tile_size=256, bands=2, workers=2), elsewhere=elsewhere)
    assert blocks > 2
    assert max(read.values()) <= 1 + 2
