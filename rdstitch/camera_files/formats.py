"""Files of OpenCV, ROS, OpenDroneMap, Kalibr and COLMAP: read as records, written as the nearest of their lens models.

OpenCV's own reader is not used: it says on standard error what it does not like, and crashes on some of it. What is
written has the division model as a comment or a field besides.
"""

import json
import re
from collections.abc import Callable, Sequence
from contextlib import nullcontext, suppress
from typing import Annotated, Any, Literal

from msgspec import Meta, Struct

from rdstitch.camera_files.lens_models import CameraFile, LensFit, Written, fitted_camera, nearest_model
from rdstitch.errors import ArgumentError
from rdstitch.geometry.camera import Camera
from rdstitch.geometry.camera_record import camera_json
from rdstitch.geometry.lens_model import LensKind, LensModel
from rdstitch.system.records import Count, Side, Size, convert

OWN, OWN_COMMENT = "rdstitch", "#rdstitch "
"""The field, and the comment, with the division model: by it λ comes back as it was."""

ImageSize = Callable[[], tuple[int, int]]
"""Gives width and height, pixels, where a file does not say them."""

_ALIASES = {
    **dict.fromkeys(("cameraMatrix", "Camera_Matrix", "K", "k"), "camera_matrix"),
    **dict.fromkeys(("distCoeffs", "dist_coeffs", "Distortion_Coefficients", "D", "d"), "distortion_coefficients"),
    **dict.fromkeys(("image_Width", "width"), "image_width"),
    **dict.fromkeys(("image_Height", "height"), "image_height"),
}
"""Names in files of OpenCV's samples and in messages of ROS 1 and 2, and what OpenCV's calibration calls the same."""

_WIDE = 0.9  # half diagonals in focal lengths: fisheyes begin there, at 84 degrees by the usual model
_ASYMMETRIC, _TIMES_CLOSER = 0.005, 4.0  # half diagonals off every symmetric lens, and times the fisheye's error
_OFF_CENTER = 0.15  # of the image's sides: principal points lie nearer to the middle

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
}
"""COLMAP's models: how many focal lengths, and how many of OpenCV's coefficients, in its order."""

_COLMAP_LINE = re.compile(r"\s*\d+\s+([A-Z_]+)\s+(\d+)\s+(\d+)\s+(\S.*)")


class _Matrix(Struct):
    """A matrix of FileStorage: its shape and its values in one list."""

    rows: Count
    cols: Count
    data: Annotated[list[float], Meta(max_length=100)]

    def __post_init__(self) -> None:
        if self.rows * self.cols != len(self.data):
            raise ValueError("the shape is not what it should be")


class _OpenCV(Struct, kw_only=True):
    """Brown's model with up to 8 coefficients, or that of ``cv2.fisheye`` with 4."""

    camera_matrix: _Matrix
    distortion_coefficients: _Matrix
    image_width: Side | None = None
    image_height: Side | None = None
    distortion_model: Literal["plumb_bob", "rational_polynomial", "equidistant", "fisheye"] | None = None
    fisheye_model: Count | None = None

    @property
    def is_fisheye(self) -> bool | None:
        """Whether the coefficients are those of the fisheye model; None where nothing says."""
        if self.distortion_model is not None:
            return self.distortion_model in ("equidistant", "fisheye")
        return None if self.fisheye_model is None else self.fisheye_model > 0


class _OpenDroneMap(Struct, kw_only=True):
    """Lens models of OpenSfM, with lengths in units of the longer side."""

    projection_type: Literal["perspective", "brown", "simple_radial", "radial", "fisheye_opencv"]
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


class _Kalibr(Struct, kw_only=True):
    camera_model: Literal["pinhole"]
    distortion_model: Literal["none", "radtan", "equi"]
    intrinsics: tuple[float, float, float, float]
    distortion_coeffs: Annotated[list[float], Meta(max_length=4)] = []
    resolution: Size

    def __post_init__(self) -> None:
        if self.distortion_model != "none" and len(self.distortion_coeffs) != 4:
            raise ValueError("expected 4 distortion_coeffs")


def is_opencv(content: Any) -> bool:
    """Check whether plain values look like OpenCV's."""
    return isinstance(content, dict) and any(_ALIASES.get(name, name) == "camera_matrix" for name in content)


def read_opencv(content: dict[str, Any], file: str, image_size: ImageSize | None = None) -> CameraFile:
    """The camera of a FileStorage, to which λ is fitted.

    Four coefficients may be Brown's or those of ``cv2.fisheye``, and only a mark says which. Where there is none they
    are Brown's, unless they clearly make a fisheye.
    """
    named = {_ALIASES.get(name, name): value for name, value in content.items()}
    for name, rows in (("camera_matrix", 3), ("distortion_coefficients", 1)):
        if isinstance(values := named.get(name), list):  # as ``ros2 topic echo`` prints them
            named[name] = {"rows": rows, "cols": len(values) // rows, "data": values}
    record = convert(named, _OpenCV, file, strict=False)
    matrix, k = record.camera_matrix, tuple(record.distortion_coefficients.data)
    if (matrix.rows, matrix.cols) != (3, 3):
        raise ArgumentError("camera_matrix: expected 3 rows of 3")
    fx, skew, cx, _, fy, cy = matrix.data[:6]
    if not (fx > 0.0 and fy > 0.0 and abs(skew) < 1e-6 * fx):
        raise ArgumentError("camera_matrix: expected positive focal lengths and no skew")
    size = _size(record, (cx, cy), image_size)

    def read(*, fisheye: bool) -> CameraFile:
        lens = LensModel((fx, fy), (cx, cy), k if fisheye else k[:8], _kind(fisheye))
        return fitted_camera(lens, "OpenCV", size, "distortion_coefficients: ")

    if record.is_fisheye:
        if len(k) != 4:
            raise ArgumentError("distortion_coefficients: expected the 4 coefficients of a fisheye")
        return read(fisheye=True)
    if len(k) not in (0, 4, 5, 8, 12, 14) or any(k[8:]):
        raise ArgumentError(
            "distortion_coefficients: expected 4, 5 or 8; thin prisms and tilted sensors are not known here"
        )
    if record.is_fisheye is not None or len(k) != 4 or not any(k):
        return read(fisheye=False)
    brown = other = None
    with suppress(ArgumentError):
        other = read(fisheye=True)
    with suppress(ArgumentError) if other else nullcontext():
        brown = read(fisheye=False)
    if brown is None or (other is not None and _is_rather(other, brown)):
        raise ArgumentError(
            "distortion_coefficients: these 4 make no lens of OpenCV's usual model, but one of cv2.fisheye; if they "
            'are that, add "fisheye_model: 1", else "distortion_model: plumb_bob"'
        )
    return brown


def _kind(fisheye: bool) -> LensKind:
    """The word for a model of OpenCV."""
    return "fisheye" if fisheye else "brown"


def _is_rather(fisheye: CameraFile, brown: CameraFile) -> bool:
    """Check whether coefficients are a fisheye's: these make a symmetric lens of a wide view, Brown's do not."""
    camera, one, other = brown.camera, fisheye.fit, brown.fit
    if camera.focal is None or one is None or other is None:
        return False
    wide = camera.scale > _WIDE * camera.focal
    return wide and other.largest > max(_ASYMMETRIC * camera.scale, _TIMES_CLOSER * one.largest)


def _size(record: _OpenCV, center: tuple[float, float], image_size: ImageSize | None) -> tuple[int, int]:
    """Width and height, of the images where the file does not say them."""
    given = record.image_width, record.image_height
    if given[0] is not None and given[1] is not None:
        return given[0], given[1]
    if image_size is None or given != (None, None):
        raise ArgumentError(f"image_{'width' if given[0] is None else 'height'}: is missing")
    size = image_size()
    if any(abs((c + 0.5) / side - 0.5) > _OFF_CENTER for c, side in zip(center, size, strict=True)):
        raise ArgumentError(
            f"has no image_width and image_height, and its principal point {center[0]:.0f}, {center[1]:.0f} is not "
            f"that of images of {size[0]} x {size[1]} pixels; add the size that it was calibrated for"
        )
    return size


def read_opendronemap(entry: Any, file: str, name: str) -> CameraFile:
    """The one camera of a ``cameras.json``, to which λ is fitted."""
    record = convert(entry, _OpenDroneMap, file, name)
    size, longer = (record.width, record.height), max(record.width, record.height)
    fx, fy = (record.focal or value or 0.0 for value in (record.focal_x, record.focal_y))
    focal = (fx * longer, fy * longer)
    center = ((size[0] - 1) / 2 + record.c_x * longer, (size[1] - 1) / 2 + record.c_y * longer)
    fisheye = record.projection_type == "fisheye_opencv"
    names = ("k1", "k2", "k3", "k4") if fisheye else ("k1", "k2", "p1", "p2", "k3")
    k = tuple(getattr(record, name) for name in names)
    return fitted_camera(LensModel(focal, center, k, _kind(fisheye)), "OpenDroneMap", size)


def read_kalibr(entry: Any, file: str, name: str) -> CameraFile:
    """The one camera of a chain, to which λ is fitted."""
    record = convert(entry, _Kalibr, file, name, strict=False)
    k = () if record.distortion_model == "none" else tuple(record.distortion_coeffs)
    fx, fy, cx, cy = record.intrinsics
    lens = LensModel((fx, fy), (cx, cy), k, _kind(record.distortion_model == "equi"))
    return fitted_camera(lens, "Kalibr", record.resolution)


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
    lens = LensModel(focal, center, tuple(values[focals + 2 :]), _kind("FISHEYE" in model))
    return fitted_camera(lens, "COLMAP", size)


def opencv_text(camera: Camera, *, yaml: bool = True, fisheye: bool = False) -> Written:
    """Write a camera as FileStorage writes YAML or JSON, for the functions of ``cv2.fisheye`` or for the usual ones.

    Those have Brown's model, or the rational one where that is closer.
    """
    lens, fit = nearest_model(camera, *(("fisheye",) if fisheye else ("polynomial", "rational")))
    mark = {"fisheye_model": 1} if fisheye else {}
    content = {**_calibration(camera, lens, **mark), OWN: _own(camera, fit)}
    return "%YAML:1.0\n---\n" + _as_yaml(content) if yaml else json.dumps(content, indent=4) + "\n", fit


def _calibration(camera: Camera, lens: LensModel, **further: Any) -> dict[str, Any]:
    """The fields that FileStorage and ROS share."""
    (width, height), (cx, cy), (fx, fy) = camera.image_size, lens.center, lens.focal
    return {
        "image_width": width,
        "image_height": height,
        **further,
        "camera_matrix": _matrix(3, fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0),
        "distortion_coefficients": _matrix(1, *lens.coefficients),
    }


def _matrix(rows: int, *data: float) -> dict[str, Any]:
    values = [float(value) for value in data]
    return {"type_id": "opencv-matrix", "rows": rows, "cols": len(values) // rows, "dt": "d", "data": values}


def _named(lens: LensModel, fisheye: str, rational: str, other: str) -> str:
    """Choose the name that a format has for a model."""
    return fisheye if lens.fisheye else rational if len(lens.coefficients) > 5 else other


def camera_info_yaml(camera: Camera) -> Written:
    """Write a camera as ``camera_info_manager`` reads it."""
    lens, fit = nearest_model(camera, "polynomial", "rational", "fisheye")
    model = _named(lens, "equidistant", "rational_polynomial", "plumb_bob")
    content = _calibration(camera, lens, camera_name="camera", distortion_model=model)
    matrix = content["camera_matrix"]["data"]
    content["rectification_matrix"] = _matrix(3, 1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0)
    content["projection_matrix"] = _matrix(3, *matrix[:3], 0.0, *matrix[3:6], 0.0, *matrix[6:], 0.0)
    return comments(camera, fit, model) + _as_yaml(content, opencv=False), fit


def camera_chain_yaml(camera: Camera) -> Written:
    """Write a camera as Kalibr does: "radtan", which has k1 and k2 only, or "equi" where that is closer."""
    lens, fit = nearest_model(camera, "two terms", "fisheye")
    model = _named(lens, "equi", "", "radtan")
    entry = {
        "camera_model": "pinhole",
        "intrinsics": [*lens.focal, *lens.center],
        "distortion_model": model,
        "distortion_coeffs": list(lens.coefficients),
        "resolution": list(camera.image_size),
        "rostopic": "/camera/image_raw",
    }
    return comments(camera, fit, model) + _as_yaml({"cam0": entry}, opencv=False), fit


def colmap_text(camera: Camera) -> Written:
    """Write a camera as COLMAP reads it: FULL_OPENCV, or OPENCV_FISHEYE where that is closer to the lens."""
    lens, fit = nearest_model(camera, "rational", "fisheye", close=0.0)
    model = _named(lens, "OPENCV_FISHEYE", "FULL_OPENCV", "")
    # COLMAP's pixels have their centres at halves.
    numbers = (*camera.image_size, *lens.focal, *(value + 0.5 for value in lens.center), *lens.coefficients)
    heading = f"{comments(camera, fit, model)}# CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]\n"
    return f"{heading}1 {model} {' '.join(map(repr, numbers))}\n", fit


def opendronemap_json(camera: Camera) -> Written:
    """Write a camera as OpenDroneMap takes it with ``--cameras``."""
    lens, fit = nearest_model(camera, "polynomial", "fisheye")
    kind = _named(lens, "fisheye_opencv", "", "brown")
    names = ("k1", "k2", "k3", "k4") if lens.fisheye else ("k1", "k2", "p1", "p2", "k3")
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
        **dict(zip(names, lens.coefficients, strict=True)),
        OWN: _own(camera, fit),
    }
    return json.dumps({f"v2 unknown unknown {width} {height} {kind} {fx:.4g}": entry}, indent=4) + "\n", fit


def comments(camera: Camera, fit: LensFit, model: str) -> str:
    """Comment lines, the last one with the camera itself."""
    return f"# {model}: at most {fit.largest:.3f} pixels from the lens\n{OWN_COMMENT}{json.dumps(_own(camera, fit))}\n"


def _own(camera: Camera, fit: LensFit) -> dict[str, Any]:
    """The camera, and the residual of the model that was fitted to it; what is not known is left out."""
    known = {key: value for key, value in camera_json(camera).items() if value is not None}
    return {**known, "fit_rms_px": fit.rms, "fit_largest_px": fit.largest}


def _as_yaml(content: dict[str, Any], *, opencv: bool = True) -> str:
    """Write numbers, texts, lists and one level of objects; with OpenCV's marks, which other readers do not know."""
    lines = []
    for key, value in content.items():
        if not isinstance(value, dict):
            lines.append(f"{key}: {_as_yaml_value(value)}")
            continue
        matrix = "type_id" in value
        lines.append(f"{key}: !!opencv-matrix" if matrix and opencv else f"{key}:")
        left_out = ("type_id",) if opencv or not matrix else ("type_id", "dt")
        lines += [f"   {name}: {_as_yaml_value(item)}" for name, item in value.items() if name not in left_out]
    return "\n".join(lines) + "\n"


def _as_yaml_value(value: Any) -> str:
    """A number, text, list or object: YAML 1.1 takes numbers with an exponent, but without a dot, for texts."""
    if isinstance(value, list | tuple):
        return f"[{', '.join(map(_as_yaml_value, value))}]"
    if isinstance(value, dict):
        return f"{{{', '.join(f'{key}: {_as_yaml_value(item)}' for key, item in value.items())}}}"
    text = json.dumps(value)
    return text.replace("e", ".0e") if isinstance(value, float) and "." not in text else text
