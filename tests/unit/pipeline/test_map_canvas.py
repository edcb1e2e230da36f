"""The canvas of images that are placed."""

import pytest

from rdstitch.errors import LimitError
from rdstitch.options.composite_options import CompositeOptions
from rdstitch.pipeline.composition.map_canvas import output_canvas
from rdstitch.results.placed_images import PlacedImages
from tests.registrations import registration


def test_a_side_of_any_length_is_kept_to_or_refused_as_a_canvas() -> None:
    placed = PlacedImages.of(registration(3), None)
    for side in (5, 100):
        assert max(output_canvas(placed, CompositeOptions(max_size=side)).size) <= side
    with pytest.raises(LimitError, match="the canvas would have 1 x"):
        output_canvas(placed, CompositeOptions(max_size=1))
