"""What viewers of panoramas need of a canvas: directions of its pixels, field of view, Photo Sphere XMP."""

import math

import numpy as np

from rdstitch.arrays import FloatArray
from rdstitch.compositing.canvas import Canvas
from rdstitch.compositing.projection import TURN

_PROPERTIES = (
    "FullPanoWidthPixels",
    "FullPanoHeightPixels",
    "CroppedAreaLeftPixels",
    "CroppedAreaTopPixels",
    "CroppedAreaImageWidthPixels",
    "CroppedAreaImageHeightPixels",
)


def directions_on(canvas: Canvas, points: FloatArray) -> FloatArray:
    """Directions (N, 3), of length 1, of canvas pixels (N, 2) of pictures taken by turning on the spot."""
    places = np.column_stack([points, np.ones(len(points))]) @ np.linalg.inv(canvas.matrix).T
    parts = canvas.projection.directions(places[:, 0], places[:, 1])
    directions = np.stack(np.broadcast_arrays(*parts), axis=-1)
    unit: FloatArray = directions / np.linalg.norm(directions, axis=1, keepdims=True)
    return unit


def field_of_view(canvas: Canvas) -> tuple[float, float]:
    """Angles that the middle row and the middle column of a canvas span, radians."""
    width, height = canvas.size
    x, y = (width - 1) / 2, (height - 1) / 2
    if canvas.projection.periodic:
        resolution = math.hypot(canvas.matrix[0, 0], canvas.matrix[1, 0])
        across = width / resolution
    else:
        left, right = directions_on(canvas, np.array([(-0.5, y), (width - 0.5, y)]))
        across = math.acos(float(np.clip(left @ right, -1.0, 1.0)))
    # At a pole, rounding must not lead beyond it.
    top, bottom = directions_on(canvas, np.array([(x, -0.5 + 1e-6), (x, height - 0.5 - 1e-6)]))
    return across, math.acos(float(np.clip(top @ bottom, -1.0, 1.0)))


def center_of_view(canvas: Canvas) -> tuple[float, float]:
    """Longitude, to the right, and latitude, downwards, of the middle of a canvas, radians."""
    width, height = canvas.size
    x, y, z = directions_on(canvas, np.array([((width - 1) / 2, (height - 1) / 2)]))[0]
    return math.atan2(x, z), math.asin(max(-1.0, min(1.0, float(y))))


def photo_sphere_xmp(canvas: Canvas) -> bytes:
    """XMP packet (GPano) by which viewers recognize an equirectangular picture and turn it; empty for others.

    The metadata of Google's Photo Sphere, which also describes pictures that are only a part of the sphere.
    """
    upright = canvas.matrix[0, 1] == 0.0 and canvas.matrix[1, 0] == 0.0
    if canvas.projection.name != "sphere" or not upright:
        return b""
    resolution = float(canvas.matrix[0, 0])
    full_width, full_height = round(TURN * resolution), round(TURN * resolution / 2.0)
    origin = canvas.matrix[:2, 2] + 0.5
    width, height = canvas.size
    left = 0 if canvas.period is not None else min(max(round(full_width / 2 - origin[0]), 0), full_width - width)
    top = min(max(round(full_height / 2 - origin[1]), 0), full_height - height)
    numbers = dict(zip(_PROPERTIES, (full_width, full_height, left, top, width, height), strict=True))
    attributes = " ".join(f'GPano:{name}="{number}"' for name, number in numbers.items())
    return (
        '<?xpacket begin="\ufeff" id="W5M0MpCehiHzreSzNTczkc9d"?>'
        '<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">'
        '<rdf:Description rdf:about="" xmlns:GPano="http://ns.google.com/photos/1.0/panorama/" '
        f'GPano:ProjectionType="equirectangular" GPano:UsePanoramaViewer="True" {attributes}/>'
        '</rdf:RDF></x:xmpmeta><?xpacket end="w"?>'
    ).encode()
