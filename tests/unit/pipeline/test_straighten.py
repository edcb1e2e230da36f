"""How much straightening may cut away."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from examples.worlds.turns import camera_rotations
from rdstitch.alignment.frames.reference_view import view_rotation
from rdstitch.compositing import CompositeOptions
from rdstitch.geometry.camera import Camera
from rdstitch.pipeline.composition import straighten
from rdstitch.results.placed_images import PlacedImages
from tests.registrations import source


@pytest.mark.parametrize(("projection", "done"), [("plane", False), ("sphere", True)])
def test_no_straightening_that_cuts_most_away(projection: Any, done: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """A camera that looked up by 50 degrees: upright and flat, the top would be stretched without end."""
    lens = Camera((400, 300), 0.0, focal=260.0)
    looks = np.stack([camera_rotations(yaw, 0.0, 0.0)[0] for yaw in (-0.3, 0.0, 0.3)])
    directions = np.swapaxes(looks, 1, 2) @ np.diag([1.0, 1.0, 260.0 / lens.scale])
    placed = PlacedImages([replace(source(f"{k}.jpg"), camera=lens) for k in range(3)], directions, 1, turned=True)
    upwards = view_rotation(CompositeOptions(pitch=-50.0))
    upright: Any = SimpleNamespace(matrix=lambda *_, **__: upwards)
    monkeypatch.setattr(straighten, "_straightening", lambda *_: straighten._Straightening(upright))
    options = CompositeOptions(straighten="auto", projection=projection)
    found, said = straighten.oriented(placed, options)
    assert (found.orientation is not None) == done
    assert [message.code for message in said] == ([] if done else ["not-straightened"])
    assert done or "% of what the images show would be cut away" in said[0].text
