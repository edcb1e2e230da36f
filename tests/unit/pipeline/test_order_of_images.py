"""The order in which images are named decides nothing: neither the reference image, nor the frame, nor a pixel."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import rdstitch
from rdstitch.io import write_image
from tests.compositing_scenes import render

SCENE = render(4, 1, size=(240, 180), overlap=0.5, distortion=-0.15, seed=3)
ORDERS = [(0, 1, 2, 3), (2, 0, 3, 1)]


@pytest.mark.parametrize("make", [rdstitch.pano, rdstitch.mosaic])
def test_of_files_the_result_is_the_same(make: Callable[..., Any], tmp_path: Path) -> None:
    files = [tmp_path / f"{name}.png" for name in ("a2", "a10", "b", "c")]
    for file, frame in zip(files, SCENE.frames, strict=True):
        write_image(file, frame)
    results = [make([files[k] for k in order]) for order in ORDERS]
    references = {r.registration.sources[r.registration.alignment.reference].name for r in results}
    assert len(references) == 1
    for result in results:
        np.testing.assert_array_equal(result.image, results[0].image)


def test_of_arrays_the_reference_is_the_same() -> None:
    options = rdstitch.StitchOptions(dry_run=True)
    results = [rdstitch.mosaic([SCENE.frames[k] for k in order], options=options) for order in ORDERS]
    references = {order[r.registration.alignment.reference] for order, r in zip(ORDERS, results, strict=True)}
    assert len(references) == 1
    sizes = np.array([result.canvas.size for result in results])
    assert np.ptp(sizes, axis=0).max() <= 2
