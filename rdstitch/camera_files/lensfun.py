"""Profiles of lensfun, the lens database that darktable, RawTherapee and others read.

Its models are polynomials of the undistorted radius in halves of the shorter side: ``poly3``,
``r_d = r (1 - k + k r²)``; ``poly5``, ``r_d = r (1 + k1 r² + k2 r⁴)``; and Hugin's with a, b and c as ``ptlens``. Focal
lengths are millimetres; the crop factor says on what film.
"""

import math
from collections.abc import Callable

from rdstitch.camera import Camera
from rdstitch.camera_files.hugin import fitted_polynomial, read_polynomial
from rdstitch.camera_files.lens_fit import CameraFile
from rdstitch.camera_files.lens_models import CLOSE
from rdstitch.camera_files.writing import comments
from rdstitch.errors import ArgumentError
from rdstitch.records import parse_xml

_FILM = math.hypot(36.0, 24.0)  # mm, at crop factor 1
_MODELS = {"poly3": (3,), "poly5": (3, 5), "ptlens": (4, 3, 2)}
_NAMES = {"poly3": ("k1",), "poly5": ("k1", "k2"), "ptlens": ("a", "b", "c")}
_TYPES = {"rectilinear": False, "fisheye": True}


def read_lensfun(text: str, file: str, image_size: Callable[[], tuple[int, int]] | None) -> CameraFile:
    """Fit λ to the only lens of a file at its only focal length; the crop factor is that of the images."""
    lenses = list(parse_xml(text, file).iter("lens"))
    found = [(lens, item) for lens in lenses for item in lens.iter("distortion")]
    if len(found) != 1:
        what = f"{len(lenses)} lenses with {len(found)} distortions"
        raise ArgumentError(f"holds {what}; keep the one lens, and of it the one focal length, of the images")
    if image_size is None:
        raise ArgumentError("has no image size")
    (lens, values), size = found[0], image_size()
    model, kind = values.get("model", ""), (lens.findtext("type") or "rectilinear").strip().lower()
    if model not in _MODELS or kind not in _TYPES:
        known = ", ".join(_MODELS)
        raise ArgumentError(f"only rectilinear lenses and fisheyes by {known} are known here, not {kind} {model}")
    try:
        terms = {p: float(values.get(name, "0")) for p, name in zip(_MODELS[model], _NAMES[model], strict=True)}
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
    return read_polynomial("lensfun", terms, linear, size, center, unit, focal, fisheye=_TYPES[kind])


def lensfun_xml(camera: Camera) -> str:
    """A database of one lens, by the simplest of the three models that is close to it, else the nearest.

    Maker, model, mount and crop factor are for the user to fill in: a camera file does not know them.
    """
    (width, height), unit = camera.image_size, (min(camera.image_size) - 1) / 2
    fits = [(name, fitted_polynomial(camera, unit, powers)) for name, powers in _MODELS.items()]
    close = [found for found in fits if found[1].fit.largest <= CLOSE]
    model, lens = close[0] if close else min(fits, key=lambda found: found[1].fit.largest)
    scale, moved = (1.0, lens.coefficients) if model == "poly5" else lens.moved()
    values = " ".join(f'{name}="{value:.9g}"' for name, value in zip(_NAMES[model], moved, strict=True))
    x, y = ((c - (n - 1) / 2) / unit for c, n in zip(camera.center, (width, height), strict=True))
    focal = lens.focal * scale / math.hypot(width, height) * _FILM
    return f"""<!--
{comments(camera, lens.fit, model)}-->
<lensdatabase version="1">
  <lens>
    <maker>Unknown</maker>
    <model>Unknown lens</model>
    <mount>Generic</mount>
    <cropfactor>1</cropfactor>
    <aspect-ratio>{max(width, height) / min(width, height):.6g}</aspect-ratio>
    <type>{"fisheye" if lens.fisheye else "rectilinear"}</type>
    <center x="{x:.9g}" y="{y:.9g}"/>
    <calibration>
      <distortion model="{model}" focal="{focal:.6g}" {values}/>
    </calibration>
  </lens>
</lensdatabase>
"""
