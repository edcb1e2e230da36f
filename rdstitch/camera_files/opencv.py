"""Camera files of OpenCV's FileStorage, YAML or JSON: ``camera_matrix``, ``distortion_coefficients`` and the size."""

import json
from collections.abc import Sequence
from typing import Any

from rdstitch.camera import Camera
from rdstitch.camera_files.brown import Brown, brown_of
from rdstitch.camera_files.division import CameraFile, fitted_camera, own_node
from rdstitch.camera_files.opencv_yaml import to_yaml
from rdstitch.errors import ArgumentError
from rdstitch.records import Record

_KIND = "OpenCV"
_OWN = "rdstitch"
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
        return CameraFile(Camera.from_record(own), _KIND)
    (fx, skew, cx), (_, fy, cy) = _rows(_first(record, _MATRIX), 3, 3)[:2]
    if not (fx > 0.0 and fy > 0.0 and abs(skew) < 1e-6 * fx):
        _first(record, _MATRIX).fail("expected positive focal lengths and no skew")
    size = (_first(record, _WIDTH).side(), _first(record, _HEIGHT).side())
    given = _first(record, _COEFFICIENTS)
    k = [value for row in _rows(given) for value in row]
    if len(k) not in (0, 4, 5, 8, 12, 14) or any(k[8:]):
        given.fail("expected 4, 5 or 8 coefficients; thin prisms and tilted sensors are not known here")
    k += [0.0] * (8 - len(k))
    lens = Brown((fx, fy), (cx, cy), (k[0], k[1], k[4]), (k[2], k[3]), (k[5], k[6], k[7]))
    try:
        camera = Camera(size, center=lens.center, focal=lens.mean_focal, focal_source="file")
    except ArgumentError as error:
        record.fail(str(error))
    return fitted_camera(given, _KIND, lens.distort, camera)


def opencv_yaml(camera: Camera) -> str:
    """The camera as FileStorage writes YAML."""
    return to_yaml(_content(camera))


def opencv_json(camera: Camera) -> str:
    """The camera as FileStorage writes JSON."""
    return json.dumps(_content(camera), indent=4) + "\n"


def _content(camera: Camera) -> dict[str, Any]:
    lens, fit = brown_of(camera)
    (fx, fy), (cx, cy), (k1, k2, k3) = lens.focal, lens.center, lens.radial
    return {
        "image_width": camera.image_size[0],
        "image_height": camera.image_size[1],
        _MATRIX[0]: _matrix(3, 3, [fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0]),
        _COEFFICIENTS[0]: _matrix(1, 5, [k1, k2, 0.0, 0.0, k3]),
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
