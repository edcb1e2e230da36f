"""An output that is computed in blocks elsewhere is the one that is computed here."""

import pickle
from collections.abc import Generator, Iterable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rdstitch.cache import Cache
from rdstitch.compositing import CompositeOptions
from rdstitch.compositing.blocks import Block
from rdstitch.compositing.compositor import compose
from rdstitch.compositing.tiles import OutputStrip
from rdstitch.stored import Stored
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
