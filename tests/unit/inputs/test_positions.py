"""GPS positions as metres east and north."""

from pathlib import Path

import numpy as np

from rdstitch.camera import Camera
from rdstitch.inputs.measurements import positions_of
from rdstitch.inputs.source import Source
from rdstitch.io.metadata import GpsPosition, Metadata


def _source(gps: GpsPosition | None) -> Source:
    return Source(Path("image.jpg"), Metadata((640, 480), gps=gps), Camera((640, 480)))


def test_distances_are_those_on_the_ground_at_any_place() -> None:
    """Also across the date line, and where a degree of longitude is short; east and north are where they should be."""
    west, east = GpsPosition(70.0, 179.9995), GpsPosition(70.0, -179.9995, 120.0)
    north = GpsPosition(70.001, 179.9995)
    one, two, three = positions_of([_source(west), _source(east), _source(north)])
    assert np.isclose(np.linalg.norm(one - two), 111_195 * 0.001 * np.cos(np.radians(70.0)), rtol=1e-3)
    assert np.isclose(np.linalg.norm(one - three), 111.195, rtol=1e-3)
    assert two[0] - one[0] > 30.0
    assert three[1] - one[1] > 110.0


def test_an_image_without_gps_is_nowhere() -> None:
    places = positions_of([_source(None), _source(GpsPosition(1.0, 2.0))])
    assert np.isnan(places[0]).all()
    assert np.isfinite(places[1]).all()
    assert positions_of([]).shape == (0, 2)
