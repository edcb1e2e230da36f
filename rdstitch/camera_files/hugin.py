"""Hugin's project files: the lens of an image line, panotools' polynomial with a, b, c and the field of view v.

``r_d = a r⁴ + b r³ + c r² + (1 - a - b - c) r`` with r the undistorted radius in halves of the shorter side: the scale
is kept there and not at the centre, so that the focal length that v implies is not the one at the centre. For fisheyes
the undistorted radius is that of an equidistant one.
"""

import math
import re
from typing import Annotated

import numpy as np
from msgspec import Meta, Struct

from rdstitch.arrays import FloatArray
from rdstitch.camera import Camera
from rdstitch.camera_files.lens_fit import CameraFile, fitted_camera
from rdstitch.camera_files.lens_models import CLOSE, LensFit, LensSamples
from rdstitch.camera_files.writing import comments
from rdstitch.errors import ArgumentError
from rdstitch.records import Side, convert

_RECTILINEAR, _CIRCULAR_FISHEYE, _FISHEYE = 0, 2, 3
_POWERS = (4, 3, 2)  # of r, whose coefficients are a, b and c
_PARAMETER = re.compile(r"([A-Za-z]+)(\"[^\"]*\"|\S*)")
HEAD = """# hugin project file
#hugin_ptoversion 2
"""


def is_hugin(text: str) -> bool:
    """Whether text looks like a project file."""
    return re.search(r"^(?:[pimo] |# hugin)", text, re.MULTILINE) is not None


class _Image(Struct, kw_only=True):
    """The parameters of an image line that describe its lens."""

    f: int
    w: Side
    h: Side
    v: Annotated[float, Meta(gt=0.0, lt=180.0, description="field of view, degrees")]
    a: float = 0.0
    b: float = 0.0
    c: float = 0.0
    d: float = 0.0
    e: float = 0.0


def read_hugin(text: str, file: str) -> CameraFile:
    """The lens of the first image, to which λ is fitted."""
    image = next((line for line in text.splitlines() if line.startswith("i ")), None)
    if image is None:
        raise ArgumentError("has no image line, and so no lens")
    lens = convert(dict(_PARAMETER.findall(image[2:])), _Image, file, strict=False)
    if lens.f not in (_RECTILINEAR, _CIRCULAR_FISHEYE, _FISHEYE):
        raise ArgumentError("f: only rectilinear lenses (f0) and fisheyes (f2, f3) are known here")
    size, fisheye = (lens.w, lens.h), lens.f != _RECTILINEAR
    center = (size[0] - 1) / 2 + lens.d, (size[1] - 1) / 2 + lens.e
    # Tangents of the half field of view for a rectilinear lens, angles for a fisheye.
    half_view, unit = math.radians(lens.v) / 2, min(size) / 2
    focal = size[0] / 2 / (half_view if fisheye else math.tan(half_view))
    linear = 1.0 - lens.a - lens.b - lens.c
    if linear <= 0.0:
        raise ArgumentError("the coefficients of the polynomial must leave a scale above 0 at the centre")
    # The focal length of the undistorted image is larger by what the polynomial takes away at the centre.
    at_center, bend = focal * linear, np.arctan if fisheye else np.positive

    def forward(points: FloatArray) -> FloatArray:
        rays = (points - center) / at_center
        radius = np.linalg.norm(rays, axis=1, keepdims=True)
        ideal = bend(radius) * focal / unit
        terms = zip((lens.a, lens.b, lens.c), _POWERS, strict=True)
        bent = (linear * ideal + sum(k * ideal**p for k, p in terms)) * unit
        result: FloatArray = np.where(radius > 0.0, bent / np.maximum(radius, 1e-300), at_center) * rays + center
        return result

    return fitted_camera(forward, "Hugin", size, center, at_center)


def hugin_lens(camera: Camera) -> tuple[str, LensFit]:
    """The parameters f, v, a, b, c, d and e of an image line, and how far they are from the lens.

    By least squares; a fisheye's where that is nearer and a rectilinear lens is not close.
    """
    # Imported late: no other command should wait for SciPy's optimizers.
    from scipy.optimize import brentq

    (width, height), samples = camera.image_size, LensSamples.of(camera)
    size, found = samples.focal / (min(camera.image_size) / 2), []
    for projection, straight in ((_RECTILINEAR, samples.straight), (_FISHEYE, np.arctan(samples.straight))):
        values, fit = samples.fit(straight, (straight[:, None] * size) ** np.array(_POWERS) / size)
        found.append((projection, values.tolist(), fit))
        if fit.largest <= CLOSE:
            break
    projection, values, fit = min(found, key=lambda lens: lens[2].largest)
    # Found are ``r + Σ k r^p`` for the scale of the centre. With it kept at 1 instead, r = s u: s (1 - Σ k / s^p) = 1.
    terms = list(zip(values, _POWERS, strict=True))
    scale = float(brentq(lambda s: s - 1.0 - sum(k / s ** (p - 1) for k, p in terms), 0.2, 5.0))
    a, b, c = (k / scale**p for k, p in terms)
    half_width = width / 2 / (samples.focal * scale)
    view = 2.0 * math.degrees(math.atan(half_width) if projection == _RECTILINEAR else half_width)
    d, e = camera.center[0] - (width - 1) / 2, camera.center[1] - (height - 1) / 2
    return f"w{width} h{height} f{projection} v{view!r} a{a!r} b{b!r} c{c!r} d{d!r} e{e!r} g0 t0", fit


def hugin_project(camera: Camera) -> str:
    """A project with one image of this lens, for "load lens" or as a template."""
    (width, height), (lens, fit) = camera.image_size, hugin_lens(camera)
    view = next(part[1:] for part in lens.split() if part.startswith("v"))
    return (
        f'{HEAD}{comments(camera, fit, "a, b, c")}p f0 w{width} h{height} v{float(view):.6g} n"TIFF_m c:LZW"\nm i0\n'
        f'i {lens} r0 p0 y0 TrX0 TrY0 TrZ0 n"image.jpg"\n'
    )
