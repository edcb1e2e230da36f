"""Files of COLMAP, OpenDroneMap and Kalibr: read as records, written as the nearest of their lens models."""

import json
import math
import re
from collections.abc import Sequence
from typing import Annotated, Any, Literal

from msgspec import Meta, Struct

from rdstitch.camera_files.embedded_camera import FIELD, Written, as_yaml, comments, embedded_camera
from rdstitch.camera_files.lens_models import (
    FISHEYE,
    POLYNOMIAL,
    RATIONAL,
    TWO_TERMS,
    CameraFile,
    fitted_camera,
    kind_of,
    nearest_model,
)
from rdstitch.errors import ArgumentError
from rdstitch.geometry.camera import Camera
from rdstitch.geometry.lens_model import LensModel
from rdstitch.system.records import Side, Size, convert

_COLMAP = {
    "SIMPLE_PINHOLE": (1, 0),
    "PINHOLE": (2, 0),
    "SIMPLE_RADIAL": (1, 1),
    "RADIAL": (1, 2),
    "OPENCV": (2, 4),
    "FULL_OPENCV": (2, 8),
    "SIMPLE_RADIAL_FISHEYE": (1, 1),
    "RADIAL_FISHEYE": (1, 2),
    "OPENCV_FISHEYE": (2, 4),
    "SIMPLE_FISHEYE": (1, 0),
    "FISHEYE": (2, 0),
    "SIMPLE_DIVISION": (1, 1),
    "DIVISION": (2, 1),
}
"""COLMAP's models: how many focal lengths, and how many of OpenCV's coefficients, in its order, or λ."""

_COLMAP_LINE = re.compile(r"\s*\d+\s+([A-Z_]+)\s+(\d+)\s+(\d+)\s+(\S.*)")


def colmap_cameras(text: str) -> list[tuple[str, ...]]:
    """Model, width, height and parameters of the cameras in the text, if it is a ``cameras.txt``."""
    lines = [line for line in text.splitlines() if line.strip() and not line.lstrip().startswith("#")]
    matches = [_COLMAP_LINE.fullmatch(line) for line in lines]
    return [match.groups() for match in matches if match] if matches[:1] != [None] else []


def read_colmap(camera: Sequence[str], file: str) -> CameraFile:
    """A camera of a ``cameras.txt``, to which λ is fitted."""
    model, width, height, given = camera
    if model not in _COLMAP:
        raise ArgumentError(f"MODEL: expected one of {', '.join(_COLMAP)}, not {model}")
    focals, coefficients = _COLMAP[model]
    values = convert(given.split(), list[float], file, "PARAMS", strict=False)
    if len(values) != focals + 2 + coefficients:
        raise ArgumentError(f"PARAMS: expected {focals + 2 + coefficients} numbers, not {len(values)}")
    size = convert((width, height), tuple[int, int], file, "SIZE", strict=False)
    # COLMAP's pixels have their centres at halves.
    focal, center = (values[0], values[focals - 1]), (values[focals] - 0.5, values[focals + 1] - 0.5)
    if "DIVISION" in model:
        if not math.isclose(*focal, rel_tol=1e-6):
            one = f"a division model needs one focal length for x and y, not {focal[0]:g}, {focal[1]:g}"
            raise ArgumentError(f"PARAMS: {one}")
        plain = Camera(size, center=center, focal=focal[0], focal_source="file")
        return CameraFile(plain.with_coefficients(values[-1] * (plain.scale / focal[0]) ** 2), "COLMAP")
    lens = LensModel(focal, center, tuple(values[focals + 2 :]), kind_of("FISHEYE" in model))
    return fitted_camera(lens, "COLMAP", size)


def colmap_text(camera: Camera) -> Written:
    """Write a camera as COLMAP reads it: FULL_OPENCV, or OPENCV_FISHEYE where that is closer to the lens."""
    names = {RATIONAL: "FULL_OPENCV", FISHEYE: "OPENCV_FISHEYE"}
    lens, fit, model = nearest_model(camera, names, close=0.0)
    # COLMAP's pixels have their centres at halves.
    numbers = (*camera.image_size, *lens.focal, *(value + 0.5 for value in lens.center), *lens.coefficients)
    heading = f"{comments(camera, fit, model)}# CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]\n"
    return f"{heading}1 {model} {' '.join(map(repr, numbers))}\n", fit


_COEFFICIENTS = {False: ("k1", "k2", "p1", "p2", "k3"), True: ("k1", "k2", "k3", "k4")}
"""OpenSfM's names, of usual lenses and of fisheyes, in OpenCV's order."""


class _OpenDroneMap(Struct, kw_only=True):
    """Lens models of OpenSfM, with lengths in units of the longer side."""

    projection_type: Literal["perspective", "brown", "simple_radial", "radial", "fisheye", "fisheye_opencv"]
    width: Side
    height: Side
    focal: float | None = None
    focal_x: float | None = None
    focal_y: float | None = None
    c_x: float = 0.0
    c_y: float = 0.0
    k1: float = 0.0
    k2: float = 0.0
    k3: float = 0.0
    k4: float = 0.0
    p1: float = 0.0
    p2: float = 0.0

    def __post_init__(self) -> None:
        for name in ("focal_x", "focal_y") if self.focal is None else ():
            if getattr(self, name) is None:
                raise ValueError(f"{name} is missing")


def read_opendronemap(entry: Any, file: str, name: str) -> CameraFile:
    """The one camera of a ``cameras.json``, to which λ is fitted."""
    record = convert(entry, _OpenDroneMap, file, name)
    size, longer = (record.width, record.height), max(record.width, record.height)
    fx, fy = (record.focal or value or 0.0 for value in (record.focal_x, record.focal_y))
    focal = (fx * longer, fy * longer)
    center = ((size[0] - 1) / 2 + record.c_x * longer, (size[1] - 1) / 2 + record.c_y * longer)
    fisheye = record.projection_type.startswith("fisheye")  # they differ by how many coefficients they have
    k = tuple(getattr(record, name) for name in _COEFFICIENTS[fisheye])
    return fitted_camera(LensModel(focal, center, k, kind_of(fisheye)), "OpenDroneMap", size)


def opendronemap_json(camera: Camera) -> Written:
    """Write a camera as OpenDroneMap takes it with ``--cameras``."""
    lens, fit, kind = nearest_model(camera, {POLYNOMIAL: "brown", FISHEYE: "fisheye_opencv"})
    (width, height), longer = camera.image_size, max(camera.image_size)
    fx, fy = (value / longer for value in lens.focal)
    entry = {
        "projection_type": kind,
        "width": width,
        "height": height,
        "focal_x": fx,
        "focal_y": fy,
        "c_x": (lens.center[0] - (width - 1) / 2) / longer,
        "c_y": (lens.center[1] - (height - 1) / 2) / longer,
        **dict(zip(_COEFFICIENTS[lens.fisheye], lens.coefficients, strict=True)),
        FIELD: embedded_camera(camera, fit),
    }
    return json.dumps({f"v2 unknown unknown {width} {height} {kind} {fx:.4g}": entry}, indent=4) + "\n", fit


class _Kalibr(Struct, kw_only=True):
    camera_model: Literal["pinhole"]
    distortion_model: Literal["none", "radtan", "equi"]
    intrinsics: tuple[float, float, float, float]
    distortion_coeffs: Annotated[list[float], Meta(max_length=4)] = []
    resolution: Size

    def __post_init__(self) -> None:
        if self.distortion_model != "none" and len(self.distortion_coeffs) != 4:
            raise ValueError("expected 4 distortion_coeffs")


def read_kalibr(entry: Any, file: str, name: str) -> CameraFile:
    """The one camera of a chain, to which λ is fitted."""
    record = convert(entry, _Kalibr, file, name, strict=False)
    k = () if record.distortion_model == "none" else tuple(record.distortion_coeffs)
    fx, fy, cx, cy = record.intrinsics
    lens = LensModel((fx, fy), (cx, cy), k, kind_of(record.distortion_model == "equi"))
    return fitted_camera(lens, "Kalibr", record.resolution)


def camera_chain_yaml(camera: Camera) -> Written:
    """Write a camera as Kalibr does: "radtan", which has k1 and k2 only, or "equi" where that is closer."""
    lens, fit, model = nearest_model(camera, {TWO_TERMS: "radtan", FISHEYE: "equi"})
    entry = {
        "camera_model": "pinhole",
        "intrinsics": [*lens.focal, *lens.center],
        "distortion_model": model,
        "distortion_coeffs": list(lens.coefficients),
        "resolution": list(camera.image_size),
        "rostopic": "/camera/image_raw",
    }
    return comments(camera, fit, model) + as_yaml({"cam0": entry}, opencv=False), fit
