"""Hugin's project files: the lens of an image line, panotools' polynomial with a, b, c and the field of view v.

``r_d = a r⁴ + b r³ + c r² + (1 - a - b - c) r`` with r the undistorted radius in halves of the shorter side: the scale
is kept there and not at the centre, so that the focal length that v tells is not the one at the centre.
"""

import json
import math
import re

import numpy as np

from rdstitch.arrays import FloatArray
from rdstitch.camera import Camera
from rdstitch.camera_files.division import CameraFile, fitted_camera, own_node
from rdstitch.camera_files.lens_fit import fit_polynomial
from rdstitch.errors import ArgumentError, InputError
from rdstitch.records import Record, parse_json

_KIND = "Hugin"
_OWN = "#rdstitch "
_POWERS = (4, 3, 2)
_RECTILINEAR = 0
_PARAMETER = re.compile(r"([A-Za-z]+)(\"[^\"]*\"|\S*)")
_HEAD = """# hugin project file
#hugin_ptoversion 2
"""


def is_hugin(text: str) -> bool:
    """Whether text looks like a project file."""
    return re.search(r"^(?:[pimo] |# hugin)", text, re.MULTILINE) is not None


def read_hugin(text: str, file: str) -> CameraFile:
    """The lens of the first image; without rdstitch's own line, λ is fitted.

    Raises
    ------
    InputError
        When there is no image, a parameter is wrong, or the lens is no rectilinear one.
    """
    lines = text.splitlines()
    for line in lines:
        if line.startswith(_OWN):
            return CameraFile(Camera.from_record(parse_json(line.removeprefix(_OWN), file)), _KIND)
    image = next((line for line in lines if line.startswith("i ")), None)
    if image is None:
        raise InputError(f"{file}: has no image line, and so no lens")
    lens = Record(file, "the first image", {name: _number(value) for name, value in _PARAMETER.findall(image[2:])})
    if lens["f"].integer() != _RECTILINEAR:
        lens["f"].fail("only rectilinear lenses (f0) are known here, no fisheyes")
    size = (lens["w"].side(), lens["h"].side())
    a, b, c, d, e = (0.0 if lens.get(name) is None else lens[name].number() for name in "abcde")
    view = lens["v"].number()
    if not 0.0 < view < 180.0:
        lens["v"].expected("a field of view between 0 and 180 degrees")
    center, unit = ((size[0] - 1) / 2 + d, (size[1] - 1) / 2 + e), min(size) / 2
    linear = 1.0 - a - b - c
    if linear <= 0.0:
        lens.fail("a + b + c must be below 1")

    def forward(points: FloatArray) -> FloatArray:
        # The file's undistorted picture is larger by what the polynomial takes away at the centre.
        ideal = (points - center) / (unit * linear)
        radius = np.linalg.norm(ideal, axis=1, keepdims=True)
        bent: FloatArray = ideal * (((a * radius + b) * radius + c) * radius + linear) * unit + center
        return bent

    try:
        focal = size[0] / 2 / math.tan(math.radians(view) / 2) * linear
        camera = Camera(size, center=center, focal=focal, focal_source="file")
    except ArgumentError as error:
        lens.fail(str(error))
    return fitted_camera(lens, _KIND, forward, camera)


def hugin_project(camera: Camera) -> str:
    """A project with one image of this lens, for "load lens" or as a template."""
    # Imported late: no other command should wait for SciPy's optimizers.
    from scipy.optimize import brentq

    (width, height), unit = camera.image_size, min(camera.image_size) / 2
    found, fit = fit_polynomial(camera, unit, _POWERS)
    # The scale moves from the centre to r = 1: r = s u, where s (1 - a - b - c) = 1 and a = found / s⁴ and so on.
    scale: float = brentq(
        lambda s: s - 1.0 - sum(k / s ** (p - 1) for k, p in zip(found, _POWERS, strict=True)), 0.2, 5.0
    )
    a, b, c = (float(k / scale**p) for k, p in zip(found, _POWERS, strict=True))
    focal = camera.with_focal().focal
    assert focal is not None
    view = 2.0 * math.degrees(math.atan(width / 2 / (focal * scale)))
    d, e = camera.center[0] - (width - 1) / 2, camera.center[1] - (height - 1) / 2
    own = json.dumps(own_node(camera, fit))
    lens = f"v{view!r} a{a!r} b{b!r} c{c!r} d{d!r} e{e!r} g0 t0"
    return (
        f'{_HEAD}{_OWN}{own}\np f0 w{width} h{height} v{view:.6g} n"TIFF_m c:LZW"\nm i0\n'
        f'i w{width} h{height} f{_RECTILINEAR} {lens} r0 p0 y0 TrX0 TrY0 TrZ0 n"picture.jpg"\n'
    )


def _number(text: str) -> float | str:
    """A parameter's value; what is no number stays a text, to be complained about where it matters."""
    try:
        return float(text)
    except ValueError:
        return text
