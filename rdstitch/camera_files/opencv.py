"""Files of OpenCV, and of ROS, which look alike: read as records, written as the nearest of their lens models.

OpenCV's own reader is not used: it says on standard error what it does not like, and crashes on some of it.
"""

import json
from collections.abc import Callable
from contextlib import nullcontext, suppress
from typing import Annotated, Any, Literal

from msgspec import Meta, Struct

from rdstitch.camera_files.embedded_camera import FIELD, Written, as_yaml, comments, embedded_camera
from rdstitch.camera_files.lens_models import (
    FISHEYE,
    POLYNOMIAL,
    RATIONAL,
    CameraFile,
    fitted_camera,
    kind_of,
    nearest_model,
)
from rdstitch.errors import ArgumentError
from rdstitch.geometry.camera import Camera
from rdstitch.geometry.lens_model import LensModel
from rdstitch.system.records import Count, Side, convert

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


class _Matrix(Struct):
    """A matrix of FileStorage: its shape and its values in one list."""

    rows: Count
    cols: Count
    data: Annotated[list[float], Meta(max_length=100)]

    def __post_init__(self) -> None:
        if self.rows * self.cols != len(self.data):
            raise ValueError("the shape is not what it should be")


class _Region(Struct):
    """The region of interest of a message of ROS, pixels, of which its images are; zeros stand for the whole image."""

    x_offset: Count = 0
    y_offset: Count = 0
    width: Count = 0
    height: Count = 0


class _OpenCV(Struct, kw_only=True):
    """Brown's model with up to 8 coefficients, or that of ``cv2.fisheye`` with 4."""

    camera_matrix: _Matrix
    distortion_coefficients: _Matrix
    image_width: Side | None = None
    image_height: Side | None = None
    distortion_model: Literal["plumb_bob", "rational_polynomial", "equidistant", "fisheye"] | None = None
    fisheye_model: Count | None = None
    roi: _Region | None = None

    def __post_init__(self) -> None:
        matrix, k = self.camera_matrix, self.coefficients
        if (matrix.rows, matrix.cols) != (3, 3):
            raise ValueError("camera_matrix: expected 3 rows of 3")
        fx, skew, _, _, fy = matrix.data[:5]
        if not (fx > 0.0 and fy > 0.0 and abs(skew) < 1e-6 * fx):
            raise ValueError("camera_matrix: expected positive focal lengths and no skew")
        if self.is_fisheye and len(k) != 4:
            raise ValueError("distortion_coefficients: expected the 4 coefficients of a fisheye")
        if len(k) not in (0, 4, 5, 8, 12, 14) or any(k[8:]):
            raise ValueError(
                "distortion_coefficients: expected 4, 5 or 8; thin prisms and tilted sensors are not known here"
            )

    @property
    def is_fisheye(self) -> bool | None:
        """Whether the coefficients are those of the fisheye model; None where nothing says."""
        if self.distortion_model is not None:
            return self.distortion_model in ("equidistant", "fisheye")
        return None if self.fisheye_model is None else self.fisheye_model > 0

    @property
    def region(self) -> _Region | None:
        """The part of the sensor that images show; None where they show all of it."""
        return self.roi if self.roi and self.roi.width and self.roi.height else None

    @property
    def coefficients(self) -> tuple[float, ...]:
        return tuple(self.distortion_coefficients.data)

    def lens(self, *, fisheye: bool) -> LensModel:
        """The lens, if its coefficients are those of the fisheye model, or of Brown's."""
        fx, _, cx, _, fy, cy = self.camera_matrix.data[:6]
        x, y = (self.region.x_offset, self.region.y_offset) if self.region else (0, 0)
        return LensModel((fx, fy), (cx - x, cy - y), self.coefficients[:8], kind_of(fisheye))


def is_opencv(content: Any) -> bool:
    """Check whether plain values look like OpenCV's."""
    return isinstance(content, dict) and any(_ALIASES.get(name, name) == "camera_matrix" for name in content)


def read_opencv(content: dict[str, Any], file: str, image_size: ImageSize | None = None) -> CameraFile:
    """The camera of a FileStorage, to which λ is fitted.

    Four coefficients may be Brown's or those of ``cv2.fisheye``, and only a mark says which. Where there is none they
    are Brown's, unless they clearly make a fisheye.
    """
    record = _record(content, file)
    size = _size(record, image_size)

    def read(*, fisheye: bool) -> CameraFile:
        return fitted_camera(record.lens(fisheye=fisheye), "OpenCV", size, "distortion_coefficients: ")

    if record.is_fisheye is not None or len(record.coefficients) != 4 or not any(record.coefficients):
        return read(fisheye=bool(record.is_fisheye))
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


def _record(content: dict[str, Any], file: str) -> _OpenCV:
    """Plain values by the names and as the matrices of OpenCV's calibration."""
    named = {_ALIASES.get(name, name): value for name, value in content.items()}
    for name, rows in (("camera_matrix", 3), ("distortion_coefficients", 1)):
        given = named.get(name)
        shape = given if isinstance(given, dict) else {}
        if isinstance(data := shape.get("data", given), list):  # as ``ros2 topic echo`` prints them; or row by row
            values = [value for row in data for value in (row if isinstance(row, list) else [row])]
            named[name] = {"rows": rows, "cols": len(values) // rows, **shape, "data": values}
        elif name in named and not shape:
            raise ArgumentError(f"{name}: expected rows, cols and data, or a list of numbers")
    if not isinstance(named.get("roi"), dict):  # OpenCV's is of the undistorted image
        named.pop("roi", None)
    if named.get("distortion_model") == "":
        raise ArgumentError("distortion_model: is empty, as of a camera that is not calibrated")
    return convert(named, _OpenCV, file, strict=False)


def _is_rather(fisheye: CameraFile, brown: CameraFile) -> bool:
    """Check whether coefficients are a fisheye's: these make a symmetric lens of a wide view, Brown's do not."""
    camera, one, other = brown.camera, fisheye.fit, brown.fit
    if camera.focal is None or one is None or other is None:
        return False
    wide = camera.scale > _WIDE * camera.focal
    return wide and other.largest > max(_ASYMMETRIC * camera.scale, _TIMES_CLOSER * one.largest)


def _size(record: _OpenCV, image_size: ImageSize | None) -> tuple[int, int]:
    """Width and height, of the images where the file does not say them."""
    shown = record.region
    given = (shown.width, shown.height) if shown else (record.image_width, record.image_height)
    if given[0] is not None and given[1] is not None:
        return given[0], given[1]
    if image_size is None or given != (None, None):
        raise ArgumentError(f"image_{'width' if given[0] is None else 'height'}: is missing")
    size, center = image_size(), record.lens(fisheye=False).center
    if any(abs((c + 0.5) / side - 0.5) > _OFF_CENTER for c, side in zip(center, size, strict=True)):
        raise ArgumentError(
            f"has no image_width and image_height, and its principal point {center[0]:.0f}, {center[1]:.0f} is not "
            f"that of images of {size[0]} x {size[1]} pixels; add the size that it was calibrated for"
        )
    return size


def opencv_text(camera: Camera, *, yaml: bool = True, fisheye: bool = False) -> Written:
    """Write a camera as FileStorage writes YAML or JSON, for the functions of ``cv2.fisheye`` or for the usual ones.

    Those have Brown's model, or the rational one where that is closer.
    """
    lens, fit, _ = nearest_model(camera, {FISHEYE: ""} if fisheye else {POLYNOMIAL: "", RATIONAL: ""})
    mark = {"fisheye_model": 1} if fisheye else {}
    content = {**_calibration(camera, lens, **mark), FIELD: embedded_camera(camera, fit)}
    return "%YAML:1.0\n---\n" + as_yaml(content) if yaml else json.dumps(content, indent=4) + "\n", fit


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


def camera_info_yaml(camera: Camera) -> Written:
    """Write a camera as ``camera_info_manager`` reads it."""
    names = {POLYNOMIAL: "plumb_bob", RATIONAL: "rational_polynomial", FISHEYE: "equidistant"}
    lens, fit, model = nearest_model(camera, names)
    content = _calibration(camera, lens, camera_name="camera", distortion_model=model)
    matrix = content["camera_matrix"]["data"]
    content["rectification_matrix"] = _matrix(3, 1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0)
    content["projection_matrix"] = _matrix(3, *matrix[:3], 0.0, *matrix[3:6], 0.0, *matrix[6:], 0.0)
    return comments(camera, fit, model) + as_yaml(content, opencv=False), fit
