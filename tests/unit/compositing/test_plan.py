"""What a composite may take when nobody says it."""

import pytest

from rdstitch.compositing import plan as planning
from rdstitch.compositing.masked_pixels import OPACITY_BYTES
from rdstitch.compositing.options import CompositeOptions
from rdstitch.compositing.plan import CompositePlan, default_memory, plan_composite
from rdstitch.errors import LimitError
from tests.compositing_scenes import render


def _planned(max_memory: int | None = None, *, masked: bool = False) -> CompositePlan:
    scene = render(3, 1)
    options = CompositeOptions(workers=2, max_memory=max_memory)
    return plan_composite(scene.cameras, scene.canvas, options, masked=masked)


@pytest.mark.parametrize(("available", "taken"), [(0, 400 * 2**20), (10**9, 400 * 2**20), (8 * 10**9, 2 * 10**9)])
def test_the_default_is_a_quarter_of_what_is_available(
    available: int, taken: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(planning, "available_memory", lambda: available)
    assert default_memory() == taken
    plan = _planned()
    assert (plan.tile_size, plan.workers) == (512, 2)
    assert plan.memory_bytes <= taken
    assert plan.memory_bytes - len(render(3, 1).cameras) * 10**6 <= taken < plan.cache_bytes + plan.memory_bytes
    assert _planned(40 * 2**20).cache_bytes < plan.cache_bytes


def test_less_memory_means_smaller_tiles_on_fewer_threads() -> None:
    plenty, tight = _planned(), _planned(40 * 2**20)
    assert tight.tile_size * tight.workers < plenty.tile_size * plenty.workers
    assert tight.memory_bytes <= 40 * 2**20 < plenty.memory_bytes + plenty.cache_bytes
    with pytest.raises(LimitError, match="raise --max-memory"):
        _planned(2**20)


def test_images_with_transparent_parts_take_more() -> None:
    plain, masked = (_planned(masked=some) for some in (False, True))
    width, height = render(3, 1).cameras[0].image_size
    # Two while one is prepared, and all three in the cache.
    assert masked.memory_bytes - plain.memory_bytes == (2 + 3) * OPACITY_BYTES * width * height
