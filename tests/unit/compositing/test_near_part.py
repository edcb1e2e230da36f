"""Of an image that shows the horizon only the part near the camera is drawn."""

import math

import numpy as np
import pytest

from rdstitch.arrays import FloatArray
from rdstitch.camera import Camera
from rdstitch.compositing.canvas import plan_canvas
from rdstitch.compositing.near_part import NearPart, near_parts
from rdstitch.errors import LimitError
from rdstitch.io.metadata import Metadata
from rdstitch.io.read import DecodedImage
from rdstitch.planar_motion import rotation_from_tilt
from rdstitch.radial_homography import to_plane

LENS = Camera((400, 300), distortion=-0.2, focal=300.0)
FOCAL = 300.0 / LENS.scale


def _image_to_plane(tilt: float) -> FloatArray:
    """Of a camera at height one that looks down, tilted about its x axis, radians."""
    return np.asarray(np.linalg.inv(np.diag([FOCAL, FOCAL, 1.0]) @ rotation_from_tilt((tilt, 0.0))), dtype=np.float64)


def _near(tilt: float, max_stretch: float = 3.0) -> NearPart | None:
    resolution = FOCAL * LENS.scale  # of the image straight from above
    return near_parts([LENS], [_image_to_plane(tilt)], resolution, max_stretch)[0]


def test_an_image_from_above_is_drawn_whole() -> None:
    assert _near(0.0) is None


@pytest.mark.parametrize("tilt", [0.9, 1.2])
def test_nothing_is_drawn_beyond_the_stretch(tilt: float) -> None:
    near = _near(tilt)
    outline = near.outline()
    plane = to_plane(LENS, _image_to_plane(tilt), outline)
    assert np.isfinite(plane).all()
    inside = (np.abs(outline - (199.5, 149.5)) <= (200.1, 150.1)).all(axis=1)
    assert inside.all()
    # Along the line of sight, a pixel of the image at most three times as long as that of one from above.
    steps = np.stack([to_plane(LENS, _image_to_plane(tilt), outline + np.array([0.0, s])) for s in (-0.05, 0.05)])
    along = np.linalg.norm(steps[1] - steps[0], axis=1) / 0.1 * FOCAL * LENS.scale
    finest = float(along.min())
    assert along.max() < 3.0 * max(finest, 1.0) * 1.6  # a little more where the lens itself stretches
    assert along.max() > 2.0


def test_the_mask_is_what_the_outline_encloses() -> None:
    near = _near(1.2)
    whole = DecodedImage(np.full((300, 400), 200, np.uint8), None, Metadata((400, 300)))
    drawn = near.masked(whole).alpha
    x, y = near.outline().T
    area = 0.5 * abs(np.dot(x, np.roll(y, 1)) - np.dot(y, np.roll(x, 1)))
    assert (drawn > 0).sum() == pytest.approx(area, rel=0.01)
    half = near.masked(DecodedImage(np.full((150, 200), 200, np.uint8), None, Metadata((400, 300)))).alpha
    assert (half > 0).sum() * 4 == pytest.approx(area, rel=0.02)


def test_an_image_that_shows_the_horizon_does_not_blow_up_the_canvas() -> None:
    homographies = [_image_to_plane(0.0), _image_to_plane(math.radians(75.0))]
    with pytest.raises(LimitError, match="horizon"):
        plan_canvas([LENS, LENS], homographies, reference=0)
    canvas = plan_canvas([LENS, LENS], homographies, reference=0, max_stretch=3.0)
    assert canvas.near[0] is None
    assert canvas.near[1] is not None
    assert np.prod(canvas.size) < 20 * 400 * 300
