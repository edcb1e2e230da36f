"""Options that cannot be are refused; those that name files say so."""

import math
from pathlib import Path
from typing import Any

import pytest

from rdstitch import CompositeOptions, StitchOptions
from rdstitch.errors import ArgumentError


@pytest.mark.parametrize("tilt", [(math.nan, 0.0), (2.0, 0.0)])
def test_a_tilt_is_in_radians(tilt: tuple[float, float]) -> None:
    with pytest.raises(ArgumentError, match="radians"):
        StitchOptions(tilt=tilt)


@pytest.mark.parametrize("extent", [(1.0, 2.0, 3.0), (3.0, 0.0, 1.0, 2.0)])
def test_an_extent_has_four_sides_in_their_order(extent: Any) -> None:
    with pytest.raises(ArgumentError, match=r"extent must be (4 numbers|west, south, east and north)"):
        CompositeOptions(extent=extent)


def test_a_grid_to_keep_is_an_input_that_no_output_may_replace(tmp_path: Path) -> None:
    grid = tmp_path / "grid.tif"
    assert grid in StitchOptions(composite=CompositeOptions(like=str(grid))).files
