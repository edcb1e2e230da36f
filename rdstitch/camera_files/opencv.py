"""Camera files of OpenCV's FileStorage, YAML or JSON: ``camera_matrix``, ``distortion_coefficients`` and the size.

The model is Brown's with 5 coefficients, the rational one with 8 where 5 are not close to the lens, or that of
``cv2.fisheye`` with 4, marked by ``fisheye_model`` as OpenCV's samples do and by ``distortion_model`` as ROS does.
"""

import json
from collections.abc import Sequence
from typing import Any

from rdstitch.camera import Camera
from rdstitch.camera_files.brown import Brown, least_brown_of
from rdstitch.camera_files.division import CameraFile, fitted_camera, own_node
from rdstitch.camera_files.fisheye import Fisheye, fisheye_of
from rdstitch.camera_files.lens_fit import LensFit
from rdstitch.camera_files.opencv_yaml import to_yaml
from rdstitch.camera_record import camera_from_record
from rdstitch.errors import ArgumentError
from rdstitch.records import Record

_KIND = "OpenCV"
_OWN = "rdstitch"
_FISHEYE = ("equidistant", "fisheye")
# The first is what is written; others are found in files of OpenCV's samples and of ROS.
_MATRIX = ("camera_matrix", "cameraMatrix", "Camera_Matrix", "K")
_COEFFICIENTS = ("distortion_coefficients", "distCoeffs", "dist_coeffs", "Distortion_Coefficients", "D")
_WIDTH, _HEIGHT = ("image_width", "image_Width"), ("image_height", "image_Height")


def is_opencv(record: Record) -> bool:
    """Whether JSON looks like OpenCV's."""
    return isinstance(record.value, dict) and any(name in record.value for name in _MATRIX)


def read_opencv(record: Record) -> CameraFile:
    """The camera of a FileStorage; without rdstitch's own node, λ is fitted.

    Raises
    ------
    InputError
        When a field is missing or wrong, or the model is one that λ cannot describe.
    """
    if (own := record.get(_OWN)) is not None:
        return CameraFile(camera_from_record(own), _KIND)
    (fx, skew, cx), (_, fy, cy) = _rows(_first(record, _MATRIX), 3, 3)[:2]
    if not (fx > 0.0 and fy > 0.0 and abs(skew) < 1e-6 * fx):
        _first(record, _MATRIX).fail("expected positive focal lengths and no skew")
    size = (_first(record, _WIDTH).side(), _first(record, _HEIGHT).side())
    given = _first(record, _COEFFICIENTS)
    k = [value for row in _rows(given) for value in row]
    lens: Brown | Fisheye
    if _is_fisheye(record):
        if len(k) != 4:
            given.fail("expected the 4 coefficients of a fisheye")
        lens = Fisheye((fx, fy), (cx, cy), tuple(k))
    else:
        lens = _brown(given, k, (fx, fy), (cx, cy))
    try:
        camera = Camera(size, center=lens.center, focal=lens.mean_focal, focal_source="file")
    except ArgumentError as error:
        record.fail(str(error))
    return fitted_camera(given, _KIND, lens.distort, camera)


def _is_fisheye(record: Record) -> bool:
    """Whether the coefficients are those of the fisheye model."""
    model, flag = record.get("distortion_model"), record.get("fisheye_model")
    if model is not None:
        return model.choice(("plumb_bob", "rational_polynomial", *_FISHEYE)) in _FISHEYE
    return flag is not None and flag.integer(0) > 0


def _brown(given: Record, k: list[float], focal: tuple[float, float], center: tuple[float, float]) -> Brown:
    """Brown's model of OpenCV's coefficients."""
    if len(k) not in (0, 4, 5, 8, 12, 14) or any(k[8:]):
        given.fail("expected 4, 5 or 8 coefficients; thin prisms and tilted sensors are not known here")
    k += [0.0] * (8 - len(k))
    return Brown(focal, center, (k[0], k[1], k[4]), (k[2], k[3]), (k[5], k[6], k[7]))


def opencv_yaml(camera: Camera) -> str:
    """The camera as FileStorage writes YAML."""
    return to_yaml(_content(camera))


def opencv_json(camera: Camera) -> str:
    """The camera as FileStorage writes JSON."""
    return json.dumps(_content(camera), indent=4) + "\n"


def opencv_fisheye_yaml(camera: Camera) -> str:
    """The camera for the functions of ``cv2.fisheye``, as FileStorage writes YAML."""
    lens, fit = fisheye_of(camera)
    return to_yaml(_described(camera, lens, lens.coefficients, fit, {"fisheye_model": 1}))


def _content(camera: Camera) -> dict[str, Any]:
    lens, fit = least_brown_of(camera)
    k1, k2, k3 = lens.radial
    return _described(camera, lens, (k1, k2, 0.0, 0.0, k3, *lens.denominator), fit, {})


def _described(
    camera: Camera, lens: Brown | Fisheye, coefficients: Sequence[float], fit: LensFit, mark: dict[str, int]
) -> dict[str, Any]:
    (fx, fy), (cx, cy) = lens.focal, lens.center
    return {
        "image_width": camera.image_size[0],
        "image_height": camera.image_size[1],
        **mark,
        _MATRIX[0]: _matrix(3, 3, [fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0]),
        _COEFFICIENTS[0]: _matrix(1, len(coefficients), coefficients),
        _OWN: own_node(camera, fit),
    }


def _matrix(rows: int, cols: int, data: Sequence[float]) -> dict[str, Any]:
    return {"type_id": "opencv-matrix", "rows": rows, "cols": cols, "dt": "d", "data": list(data)}


def _first(record: Record, names: Sequence[str]) -> Record:
    """The field by the first of its names that is there."""
    return record[next((name for name in names if record.get(name) is not None), names[0])]


def _rows(record: Record, rows: int | None = None, cols: int | None = None) -> list[tuple[float, ...]]:
    """A matrix; FileStorage and ROS give its shape and its values in one list."""
    high, wide = record["rows"].integer(0), record["cols"].integer(0)
    values = record["data"].numbers()
    if (rows is not None and (high, wide) != (rows, cols)) or high * wide != len(values) or len(values) > 100:
        record.fail("the shape is not what it should be")
    return [values[start : start + wide] for start in range(0, len(values), wide or 1)]
