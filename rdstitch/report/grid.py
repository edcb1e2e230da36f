"""What the lens does: a grid before and after undistortion, over a picture."""

import numpy as np
from numpy.typing import NDArray

from rdstitch.arrays import FloatArray
from rdstitch.camera import Camera
from rdstitch.registration import Registration
from rdstitch.report.svg import BLUE, RED, YELLOW, drawing, element, fit_into, path, section
from rdstitch.report.thumbnails import of_source

_LINES, _POINTS = 13, 49
_WIDTH = 430.0


def grid(registration: Registration) -> str:
    """Straight lines as the lens bends them, and the picture's rows and columns as undistortion straightens them."""
    camera = registration.camera
    reference = registration.sources[registration.alignment.reference]
    return section(
        "Lens",
        f"Left: {reference.name}, and straight lines of the scene as the lens bends them. Right: rows and columns of "
        "the picture after undistortion; the red frame is the picture before.",
        element("div", _before(camera, of_source(reference, int(_WIDTH))) + _after(camera), class_="beside"),
    )


def _lines(low: FloatArray, high: FloatArray) -> list[FloatArray]:
    """Rows and columns between two corners, densely sampled."""
    across = [np.linspace(low[k], high[k], _LINES) for k in (0, 1)]
    along = [np.linspace(low[k], high[k], _POINTS) for k in (0, 1)]
    columns = [np.column_stack([np.full(_POINTS, x), along[1]]) for x in across[0]]
    return columns + [np.column_stack([along[0], np.full(_POINTS, y)]) for y in across[1]]


def _before(camera: Camera, picture: str | None) -> str:
    width, height = camera.image_size
    scale = _WIDTH / width
    outline = camera.undistort(camera.outline(16))
    bent = [camera.distort(line) for line in _lines(outline.min(axis=0), outline.max(axis=0))]
    shown = [np.where(_inside(line, camera)[:, None], line, np.nan) for line in bent]
    back = "" if picture is None else element("image", href=picture, width=_WIDTH, height=height * scale)
    parts = [back, *(path((line + 0.5) * scale, stroke=YELLOW, stroke_width=1.4) for line in shown)]
    return drawing(_WIDTH, height * scale, parts, "a grid of straight lines as measured")


def _inside(points: FloatArray, camera: Camera) -> NDArray[np.bool_]:
    with np.errstate(invalid="ignore"):
        within = (points >= -0.5) & (points <= np.array(camera.image_size) - 0.5)
    return within[:, 0] & within[:, 1]


def _after(camera: Camera) -> str:
    width, height = camera.image_size
    corner = np.array([width - 0.5, height - 0.5])
    frame = camera.outline(1)
    straight = [camera.undistort(line) for line in _lines(np.array([-0.5, -0.5]), corner)]
    shift, scale, (wide, high) = fit_into(np.concatenate([*straight, frame]), _WIDTH, 6.0)
    parts = [path((line + shift) * scale, stroke=BLUE) for line in straight]
    parts.append(path((frame + shift) * scale, closed=True, stroke=RED, stroke_width=1.5))
    return drawing(wide, high, parts, "rows and columns after undistortion")
