"""What a composite may take when nobody says it."""

import pytest

from rdstitch.compositing import plan as planning
from rdstitch.compositing.masked_pixels import OPACITY_BYTES
from rdstitch.compositing.options import CompositeOptions
from rdstitch.compositing.plan import DEFAULT_MEMORY, CompositePlan, plan_composite
from tests.compositing_scenes import render


def _planned(monkeypatch: pytest.MonkeyPatch, left: int, *, masked: bool = False) -> CompositePlan:
    """The plan of a process that has so much left."""
    scene = render(3, 1)
    monkeypatch.setattr(planning, "memory_left", lambda pictures: left)
    return plan_composite(scene.cameras, scene.canvas, CompositeOptions(workers=2), masked=masked)


def test_it_takes_what_the_process_has_left(monkeypatch: pytest.MonkeyPatch) -> None:
    plenty, tight, none = (_planned(monkeypatch, 2**20 * left) for left in (1000, 80, -50))
    assert (plenty.tile_size, plenty.workers) == (512, 2)
    assert plenty.memory_bytes <= DEFAULT_MEMORY
    assert tight.memory_bytes <= 80 * 2**20 < plenty.memory_bytes + plenty.cache_bytes
    assert (none.tile_size, none.workers) == (256, 1)
    assert none.memory_bytes < tight.memory_bytes


def test_pictures_with_transparent_parts_take_more(monkeypatch: pytest.MonkeyPatch) -> None:
    plain, masked = (_planned(monkeypatch, 2**30, masked=some) for some in (False, True))
    width, height = render(3, 1).cameras[0].image_size
    # Two while one is prepared, and all three in the cache.
    assert masked.memory_bytes - plain.memory_bytes == (2 + 3) * OPACITY_BYTES * width * height
