"""What a composite may take when nobody says it."""

import numpy as np
import pytest

from rdstitch.compositing.masked_pixels import OPACITY_BYTES
from rdstitch.compositing.options import CompositeOptions
from rdstitch.compositing.plan import DEFAULT_MEMORY, CompositePlan, plan_composite
from rdstitch.errors import LimitError
from rdstitch.process_memory import usual_bound
from tests.compositing_scenes import render


def _planned(max_memory: int | None = None, *, masked: bool = False) -> CompositePlan:
    scene = render(3, 1)
    options = CompositeOptions(workers=2, max_memory=max_memory)
    return plan_composite(scene.cameras, scene.canvas, options, masked=masked)


def test_the_usual_limit_leaves_room_for_the_libraries_and_the_registered_pictures() -> None:
    plan = _planned()
    assert (plan.tile_size, plan.workers) == (512, 2)
    assert plan.memory_bytes <= DEFAULT_MEMORY <= usual_bound(0) - 190e6


def test_what_else_the_process_holds_does_not_matter() -> None:
    before = _planned()
    held = np.ones(600_000_000, dtype=np.uint8)
    assert _planned() == before
    del held


def test_less_memory_means_smaller_tiles_on_fewer_threads() -> None:
    plenty, tight = _planned(), _planned(40 * 2**20)
    assert tight.tile_size * tight.workers < plenty.tile_size * plenty.workers
    assert tight.memory_bytes <= 40 * 2**20 < plenty.memory_bytes + plenty.cache_bytes
    with pytest.raises(LimitError, match="raise --max-memory"):
        _planned(2**20)


def test_pictures_with_transparent_parts_take_more() -> None:
    plain, masked = (_planned(masked=some) for some in (False, True))
    width, height = render(3, 1).cameras[0].image_size
    # Two while one is prepared, and all three in the cache.
    assert masked.memory_bytes - plain.memory_bytes == (2 + 3) * OPACITY_BYTES * width * height
