"""Camera files of OpenCV's FileStorage, YAML or JSON: ``camera_matrix``, ``distortion_coefficients`` and the size.

The model is Brown's with 5 coefficients, the rational one with 8 where 5 are not close to the lens, or that of
``cv2.fisheye`` with 4, marked by ``fisheye_model`` as OpenCV's samples do and by ``distortion_model`` as ROS does.

OpenCV's own reader is not used: it says on standard error what it does not like, and crashes on some of it.
"""

import json
import re
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

from rdstitch.camera import Camera
from rdstitch.camera_files.lens_fit import LensFit
from rdstitch.camera_files.lens_models import Brown, Fisheye, fisheye_of, least_brown_of
from rdstitch.camera_files.own_camera import CameraFile, fitted_lens, own_node
from rdstitch.camera_record import camera_from_record
from rdstitch.errors import InputError
from rdstitch.records import Record, parse_json

_FIELD = re.compile(r"(?P<indent> *)(?P<key>[^\s:#\[\]{}\"']+) *:(?: +(?P<value>.*))?")
_NUMBER = re.compile(r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?")
_KIND = "OpenCV"
_OWN = "rdstitch"
_FISHEYE = ("equidistant", "fisheye")
# The first is what is written; others are found in files of OpenCV's samples and of ROS.
_MATRIX = ("camera_matrix", "cameraMatrix", "Camera_Matrix", "K")

_COEFFICIENTS = ("distortion_coefficients", "distCoeffs", "dist_coeffs", "Distortion_Coefficients", "D")
_WIDE = 0.9  # half diagonals in focal lengths: fisheyes begin there, at 84 degrees by the usual model
_ASYMMETRIC, _TIMES_CLOSER = 0.005, 4.0  # half diagonals off every symmetric lens, and times the fisheye's error
_OFF_CENTER = 0.15  # of the image's sides: principal points lie nearer to the middle

ImageSize = Callable[[], tuple[int, int]]
"""Gives width and height, pixels, where a file does not say them."""

_WIDTH, _HEIGHT = ("image_width", "image_Width"), ("image_height", "image_Height")


def to_yaml(content: dict[str, Any]) -> str:
    """Numbers, texts, lists and one level of objects as FileStorage writes them."""
    lines = ["%YAML:1.0", "---"]
    for key, value in content.items():
        if not isinstance(value, dict):
            lines.append(f"{key}: {json.dumps(value)}")
            continue
        matrix = value.get("type_id") == "opencv-matrix"
        lines.append(f"{key}: !!opencv-matrix" if matrix else f"{key}:")
        lines.extend(f"   {name}: {json.dumps(item)}" for name, item in value.items() if name != "type_id")
    return "\n".join(lines) + "\n"


def parse_yaml(text: str, file: str) -> Record:
    """What FileStorage wrote, as a record: fields, one level of nested fields, lists of numbers and texts.

    Raises
    ------
    InputError
        When there is anything else in the text; the line is named.
    """
    content: dict[str, Any] = {}
    nested: dict[str, Any] | None = None
    for number, line in _logical_lines(text):
        match = _FIELD.fullmatch(line)
        if match is None:
            raise InputError(f"{file}: line {number}: is not what OpenCV writes as YAML; no camera file?")
        value = (match["value"] or "").strip()
        if match["indent"]:
            if nested is None:
                raise InputError(f"{file}: line {number}: belongs to no field")
            nested[match["key"]] = _value(value, file, number)
        elif value in ("", "!!opencv-matrix"):
            nested = content[match["key"]] = {}
        else:
            nested = None
            content[match["key"]] = _value(value, file, number)
    return Record(file, "", content)


def _logical_lines(text: str) -> list[tuple[int, str]]:
    """Lines with their numbers; lists that go on are one line, comments and document marks none."""
    lines: list[tuple[int, str]] = []
    opened = False
    for number, raw in enumerate(text.splitlines(), start=1):
        line = raw.rstrip()
        if opened:
            lines[-1] = (lines[-1][0], f"{lines[-1][1]} {line.strip()}")
        elif line.strip() and not line.lstrip().startswith(("#", "%", "---", "...")):
            lines.append((number, line))
        else:
            continue
        opened = lines[-1][1].count("[") > lines[-1][1].count("]")
    return lines


def _value(text: str, file: str, number: int) -> Any:
    """A number, a list or a text; JSON's, and numbers like ``1.`` that OpenCV writes."""
    if text.startswith(("[", '"')):
        whole = _NUMBER.sub(lambda found: str(float(found[0])), text) if text.startswith("[") else text
        return parse_json(whole, f"{file}: line {number}").value
    if not _NUMBER.fullmatch(text):
        return text
    return int(text) if re.fullmatch(r"[-+]?\d{1,15}", text) else float(text)


def is_opencv(record: Record) -> bool:
    """Whether JSON looks like OpenCV's."""
    return isinstance(record.value, dict) and any(name in record.value for name in _MATRIX)


def read_opencv(record: Record, image_size: ImageSize | None = None) -> CameraFile:
    """The camera of a FileStorage; without rdstitch's own node, λ is fitted.

    Four coefficients may be Brown's or those of ``cv2.fisheye``, and only a mark says which. Where there is none they
    are Brown's, unless they clearly make a fisheye.

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
    size = _size(record, (cx, cy), image_size)
    given = _first(record, _COEFFICIENTS)
    k = [value for row in _rows(given) for value in row]
    marked = _is_fisheye(record)
    if marked and len(k) != 4:
        given.fail("expected the 4 coefficients of a fisheye")
    lens = Fisheye((fx, fy), (cx, cy), tuple(k)) if marked else _brown(given, k, (fx, fy), (cx, cy))
    read = partial(fitted_lens, record, _KIND, size=size, model=given)
    if marked is not None or len(k) != 4 or not any(k):
        return read(lens)
    try:
        fisheye = read(Fisheye((fx, fy), (cx, cy), tuple(k)))
    except InputError:
        return read(lens)
    try:
        found = read(lens)
    except InputError:
        found = None
    if found is None or _is_rather(fisheye, found):
        given.fail(
            "these 4 coefficients make no lens of OpenCV's usual model, but one of cv2.fisheye; if they are that, add "
            '"fisheye_model: 1", else "distortion_model: plumb_bob"'
        )
    return found


def _is_rather(fisheye: CameraFile, brown: CameraFile) -> bool:
    """Whether coefficients are a fisheye's: these make a symmetric lens of a wide field of view, Brown's do not."""
    camera, one, other = brown.camera, fisheye.fit, brown.fit
    assert camera.focal is not None
    assert one is not None
    assert other is not None
    wide = camera.half_diagonal > _WIDE * camera.focal
    return wide and other.largest > max(_ASYMMETRIC * camera.half_diagonal, _TIMES_CLOSER * one.largest)


def _size(record: Record, center: tuple[float, float], image_size: ImageSize | None) -> tuple[int, int]:
    """Width and height, of the images where the file does not say them."""
    if image_size is None or any(record.get(name) is not None for name in (*_WIDTH, *_HEIGHT)):
        return _first(record, _WIDTH).side(), _first(record, _HEIGHT).side()
    size = image_size()
    if any(abs((c + 0.5) / side - 0.5) > _OFF_CENTER for c, side in zip(center, size, strict=True)):
        record.fail(
            f"has no image_width and image_height, and its principal point {center[0]:.0f}, {center[1]:.0f} is not "
            f"that of images of {size[0]} x {size[1]} pixels; add the size that it was calibrated for"
        )
    return size


def _is_fisheye(record: Record) -> bool | None:
    """Whether the coefficients are those of the fisheye model; None where nothing says."""
    model, flag = record.get("distortion_model"), record.get("fisheye_model")
    if model is not None:
        return model.choice(("plumb_bob", "rational_polynomial", *_FISHEYE)) in _FISHEYE
    return None if flag is None else flag.integer(0) > 0


def _brown(given: Record, k: list[float], focal: tuple[float, float], center: tuple[float, float]) -> Brown:
    """Brown's model of OpenCV's coefficients."""
    if len(k) not in (0, 4, 5, 8, 12, 14) or any(k[8:]):
        given.fail("expected 4, 5 or 8 coefficients; thin prisms and tilted sensors are not known here")
    return Brown.of_opencv(focal, center, k[:8])


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
