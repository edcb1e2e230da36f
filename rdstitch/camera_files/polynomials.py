"""Polynomials of the undistorted radius r in halves of the shorter side: Hugin's project files, lensfun's profiles.

Hugin has ``r_d = a r⁴ + b r³ + c r² + (1 - a - b - c) r`` and the field of view v. The scale is kept at r = 1, not at
the centre, so that the focal length that v implies is not the one at the centre. For fisheyes the undistorted radius is
that of an equidistant one.

lensfun, the database that darktable, RawTherapee and others read, has ``poly3``, ``r_d = r (1 - k + k r²)``; ``poly5``,
``r_d = r (1 + k1 r² + k2 r⁴)``; and Hugin's as ``ptlens``. Focal lengths are millimetres; the crop factor says on what
film.
"""

import math
import re
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Annotated

import numpy as np
from msgspec import Meta, Struct

from rdstitch.arrays import FloatArray
from rdstitch.camera_files.embedded_camera import Written, comments
from rdstitch.camera_files.lens_models import CLOSE, CameraFile, LensFit, LensSamples, fitted_camera
from rdstitch.errors import ArgumentError
from rdstitch.geometry.camera import Camera
from rdstitch.geometry.lens_model import LensKind, LensModel
from rdstitch.system.records import Side, convert, parse_xml

_RECTILINEAR, _CIRCULAR_FISHEYE, _FISHEYE = 0, 2, 3
_FILM = math.hypot(36.0, 24.0)  # mm, at crop factor 1
_TERMS = {"poly3": {"k1": 3}, "poly5": {"k1": 3, "k2": 5}, "ptlens": {"a": 4, "b": 3, "c": 2}}  # powers by their names
_HUGIN = tuple(_TERMS["ptlens"].values())
_PARAMETER = re.compile(r"([A-Za-z]+)(\"[^\"]*\"|\S*)")
HEAD = """# hugin project file
#hugin_ptoversion 2
"""


def is_hugin(text: str) -> bool:
    """Check whether text looks like a project file."""
    return re.search(r"^(?:[pimo] |# hugin)", text, re.MULTILINE) is not None


class _Image(Struct, kw_only=True):
    """The parameters of an image line that describe its lens."""

    f: int
    w: Side
    h: Side
    v: Annotated[float, Meta(gt=0.0, le=360.0, description="horizontal field of view, degrees")]
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
    if not fisheye and lens.v >= 180.0:
        raise ArgumentError(f"v: a rectilinear lens sees less than 180 degrees, not {lens.v:g}")
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
    at_center = focal * linear
    powers = range(2, max(terms, default=1) + 1)
    coefficients = tuple(terms.get(p, 0.0) * (focal / unit) ** p * unit / at_center for p in powers)
    lens = LensModel((at_center, at_center), center, coefficients, "fisheye polynomial" if fisheye else "polynomial")
    return fitted_camera(lens, kind, size)


def hugin_lens(camera: Camera) -> tuple[dict[str, float], LensFit]:
    """The size and lens of an image line by Hugin's names, and how far that is from the lens."""
    width, height = camera.image_size
    lens, fit = fitted_polynomial(camera, _HUGIN)
    scale, (a, b, c) = kept_at_unit(terms_in(lens, min(width, height) / 2, _HUGIN), _HUGIN)
    half_width, fisheye = width / 2 / (lens.mean_focal * scale), lens.kind != "polynomial"
    view = 2.0 * math.degrees(half_width if fisheye else math.atan(half_width))
    projection = _FISHEYE if fisheye else _RECTILINEAR
    d, e = camera.center[0] - (width - 1) / 2, camera.center[1] - (height - 1) / 2
    size: dict[str, float] = {"w": width, "h": height, "f": projection, "v": view}
    return {**size, "a": a, "b": b, "c": c, "d": d, "e": e, "g": 0, "t": 0}, fit


def image_line(values: Mapping[str, float]) -> str:
    """Values by Hugin's names as an image line has them."""
    return " ".join(f"{name}{value!r}" for name, value in values.items())


def hugin_project(camera: Camera) -> Written:
    """A project with one image of this lens, for "load lens" or as a template."""
    lens, fit = hugin_lens(camera)
    panorama = " ".join(f"{name}{lens[name]:.6g}" for name in "fwhv")
    image = f'i {image_line(lens)} r0 p0 y0 TrX0 TrY0 TrZ0 n"image.jpg"'
    return f'{HEAD}{comments(camera, fit, "a, b, c")}p {panorama} n"TIFF_m c:LZW"\nm i0\n{image}\n', fit


def fitted_polynomial(camera: Camera, powers: tuple[int, ...]) -> tuple[LensModel, LensFit]:
    """The polynomial of a camera by least squares; a fisheye's where that is nearer and the other one is not close."""
    focal = camera.with_guessed_focal().focal
    assert focal is not None
    base, fits = LensModel((focal, focal), camera.center, (), "polynomial"), []
    samples = LensSamples.of(camera, base)
    kinds: tuple[tuple[LensKind, FloatArray], ...] = (
        ("polynomial", samples.undistorted),
        ("fisheye polynomial", np.arctan(samples.undistorted)),
    )
    for kind, ideal in kinds:
        terms = dict(zip(powers, samples.fit(ideal, powers).tolist(), strict=True))
        lens = replace(base, coefficients=tuple(terms.get(p, 0.0) for p in range(2, max(powers) + 1)), kind=kind)
        fits.append((lens, samples.compare(lens)))
    return fits[0] if fits[0][1].largest <= CLOSE else min(fits, key=lambda fit: fit[1].largest)


def terms_in(lens: LensModel, unit: float, powers: tuple[int, ...]) -> tuple[float, ...]:
    """K of ``r_d = r + Σ k r^p`` of the undistorted radius, or of a fisheye's angle, in ``unit`` pixels."""
    size = lens.mean_focal / unit
    return tuple(lens.coefficients[p - 2] / size ** (p - 1) for p in powers)


def kept_at_unit(terms: tuple[float, ...], powers: tuple[int, ...]) -> tuple[float, tuple[float, ...]]:
    """How much larger the undistorted image is with the scale kept at r = 1, ``1 - Σ k`` at the centre; and k.

    r = s u, where s (1 - Σ k) = 1, and k are those given over s^p.
    """
    # Imported late: no other command should wait for SciPy's optimizers.
    from scipy.optimize import newton

    of_powers = list(zip(terms, powers, strict=True))
    # Near 1: far from it the powers have roots of their own.
    scale = float(newton(lambda s: s - 1.0 - sum(k / s ** (p - 1) for k, p in of_powers), 1.0))
    return scale, tuple(k / scale**p for k, p in of_powers)


def read_lensfun(text: str, file: str, image_size: Callable[[], tuple[int, int]] | None) -> CameraFile:
    """Fit λ to the only lens of a file at its only focal length; the crop factor is that of the images."""
    root = parse_xml(text, file)
    if root.tag == "opencv_storage":
        raise ArgumentError("is OpenCV's in XML, which is not read; save it as YAML or JSON, by a name like camera.yml")
    if not (lenses := list(root.iter("lens"))):
        raise ArgumentError("is XML, but no lens of lensfun's database")
    profiles = [(lens, item) for lens in lenses for item in lens.iter("distortion")]
    if len(profiles) != 1:
        what = f"{len(lenses)} lenses with {len(profiles)} distortions"
        raise ArgumentError(f"holds {what}; keep the one lens, and of it the one focal length, of the images")
    if image_size is None:
        raise ArgumentError("has no image size")
    (lens, values), size = profiles[0], image_size()
    model, kind = values.get("model", ""), (lens.findtext("type") or "rectilinear").strip().lower()
    if model not in _TERMS or kind not in ("rectilinear", "fisheye"):
        known = ", ".join(_TERMS)
        raise ArgumentError(f"only rectilinear lenses and fisheyes by {known} are known here, not {kind} {model}")
    try:
        terms = {power: float(values.get(name, "0")) for name, power in _TERMS[model].items()}
        nominal = values.get("focal", "")
        length = float(values.get("real-focal", nominal)) * float(lens.findtext("cropfactor") or "1")
        center_at = lens.find("center")
        shift = [0.0 if center_at is None else float(center_at.get(name, "0")) for name in "xy"]
    except ValueError as error:
        raise ArgumentError(f"{model}: {error}") from error
    unit, focal = (min(size) - 1) / 2, length / _FILM * math.hypot(*size)
    if not (math.isfinite(focal) and focal > 0.0 and all(map(math.isfinite, (*terms.values(), *shift)))):
        raise ArgumentError(f"{model}: expected a positive focal length, and finite numbers")
    linear = 1.0 if model == "poly5" else 1.0 - sum(terms.values())
    center = (size[0] - 1) / 2 + shift[0] * unit, (size[1] - 1) / 2 + shift[1] * unit
    return read_polynomial("lensfun", terms, linear, size, center, unit, focal, fisheye=kind == "fisheye")


def lensfun_xml(camera: Camera) -> Written:
    """A database of one lens, by the simplest of the three models that is close to it, else the nearest.

    Maker, model, mount and crop factor are for the user to fill in: a camera file does not know them.
    """
    (width, height), unit = camera.image_size, (min(camera.image_size) - 1) / 2
    fits = [(model, *fitted_polynomial(camera, tuple(terms.values()))) for model, terms in _TERMS.items()]
    close = (one for one in fits if one[2].largest <= CLOSE)
    model, lens, fit = next(close, None) or min(fits, key=lambda one: one[2].largest)
    powers = tuple(_TERMS[model].values())
    scale, terms = 1.0, terms_in(lens, unit, powers)
    if model != "poly5":
        scale, terms = kept_at_unit(terms, powers)
    values = " ".join(f'{name}="{value:.9g}"' for name, value in zip(_TERMS[model], terms, strict=True))
    x, y = ((c - (n - 1) / 2) / unit for c, n in zip(camera.center, (width, height), strict=True))
    focal = lens.mean_focal * scale / math.hypot(width, height) * _FILM
    text = f"""<!--
{comments(camera, fit, model)}-->
<lensdatabase version="1">
  <lens>
    <maker>Unknown</maker>
    <model>Unknown lens</model>
    <mount>Generic</mount>
    <cropfactor>1</cropfactor>
    <aspect-ratio>{max(width, height) / min(width, height):.6g}</aspect-ratio>
    <type>{"rectilinear" if lens.kind == "polynomial" else "fisheye"}</type>
    <center x="{x:.9g}" y="{y:.9g}"/>
    <calibration>
      <distortion model="{model}" focal="{focal:.6g}" {values}/>
    </calibration>
  </lens>
</lensdatabase>
"""
    return text, fit
