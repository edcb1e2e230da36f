"""Hugin's project files: the lens of an image line, panotools' polynomial with a, b, c and the field of view v.

``r_d = a r⁴ + b r³ + c r² + (1 - a - b - c) r`` with r the undistorted radius in halves of the shorter side: the scale
is kept there and not at the centre, so that the focal length that v implies is not the one at the centre. For fisheyes
the undistorted radius is that of an equidistant one.
"""

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass
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
    half_view = math.radians(lens.v) / 2
    focal = size[0] / 2 / (half_view if fisheye else math.tan(half_view))
    linear = 1.0 - lens.a - lens.b - lens.c
    terms = {4: lens.a, 3: lens.b, 2: lens.c}
    return read_polynomial("Hugin", terms, linear, size, center, min(size) / 2, focal, fisheye=fisheye)


def read_polynomial(
    kind: str,
    terms: Mapping[int, float],
    linear: float,
    size: tuple[int, int],
    center: tuple[float, float],
    unit: float,
    focal: float,
    *,
    fisheye: bool,
) -> CameraFile:
    """A camera whose λ is fitted to ``r_d = Σ k r^p + linear r``, with ``terms`` k by p, and r in ``unit`` pixels.

    ``focal`` is that of the undistorted image, which is larger by what the polynomial takes away at the centre.
    """
    if linear <= 0.0:
        raise ArgumentError("the coefficients of the polynomial must leave a scale above 0 at the centre")
    at_center, bend = focal * linear, np.arctan if fisheye else np.positive

    def forward(points: FloatArray) -> FloatArray:
        rays = (points - center) / at_center
        radius = np.linalg.norm(rays, axis=1, keepdims=True)
        ideal = bend(radius) * focal / unit
        bent = (linear * ideal + sum(k * ideal**p for p, k in terms.items())) * unit
        result: FloatArray = np.where(radius > 0.0, bent / np.maximum(radius, 1e-300), at_center) * rays + center
        return result

    return fitted_camera(forward, kind, size, center, at_center)


def hugin_lens(camera: Camera) -> tuple[str, LensFit]:
    """The parameters f, v, a, b, c, d and e of an image line, and how far they are from the lens."""
    width, height = camera.image_size
    lens = fitted_polynomial(camera, min(camera.image_size) / 2, (4, 3, 2))
    fit, (scale, (a, b, c)) = lens.fit, lens.moved()
    half_width = width / 2 / (lens.focal * scale)
    view = 2.0 * math.degrees(half_width if lens.fisheye else math.atan(half_width))
    projection = _FISHEYE if lens.fisheye else _RECTILINEAR
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


@dataclass(frozen=True)
class Polynomial:
    """A lens as ``r_d = r + Σ k r^p`` of the undistorted radius (of a fisheye its angle), in ``unit`` pixels."""

    powers: tuple[int, ...]
    coefficients: tuple[float, ...]  # k, for the scale of the centre
    focal: float  # there, pixels
    fisheye: bool
    fit: LensFit

    def moved(self) -> tuple[float, tuple[float, ...]]:
        """How much larger the undistorted image is where the scale is kept at r = 1, ``1 - Σ k`` at the centre; and k.

        r = s u, where s (1 - Σ k) = 1, and k are those found over s^p.
        """
        # Imported late: no other command should wait for SciPy's optimizers.
        from scipy.optimize import brentq

        terms = list(zip(self.coefficients, self.powers, strict=True))
        scale: float = brentq(lambda s: s - 1.0 - sum(k / s ** (p - 1) for k, p in terms), 0.2, 5.0)
        return scale, tuple(k / scale**p for k, p in terms)


def fitted_polynomial(camera: Camera, unit: float, powers: tuple[int, ...]) -> Polynomial:
    """The polynomial of a camera by least squares; a fisheye's where that is nearer and the other one is not close."""
    samples = LensSamples.of(camera)
    size, found = samples.focal / unit, []
    for fisheye, straight in ((False, samples.straight), (True, np.arctan(samples.straight))):
        values, fit = samples.fit(straight, (straight[:, None] * size) ** np.array(powers) / size)
        found.append(Polynomial(powers, tuple(values.tolist()), samples.focal, fisheye, fit))
    return found[0] if found[0].fit.largest <= CLOSE else min(found, key=lambda lens: lens.fit.largest)
