"""Camera files of text: COLMAP's, Kalibr's and those of ROS, which are read as OpenCV's are."""

import re
from collections.abc import Sequence

from rdstitch.camera import Camera
from rdstitch.camera_files.lens_models import Brown, Fisheye, brown_of, closer_fisheye, least_brown_of, rational_of
from rdstitch.camera_files.opencv import parse_yaml
from rdstitch.camera_files.own_camera import CameraFile, comments, fitted_lens
from rdstitch.records import Record, parse_json

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

_KALIBR = {"none": 0, "radtan": 4, "equi": 4}
"""Kalibr's models of distortion: how many of OpenCV's coefficients."""

_COLMAP_LINE = re.compile(r"\s*\d+\s+([A-Z_]+)\s+(\d+)\s+(\d+)\s+(\S.*)")
_KALIBR_CAMERA = re.compile(r"^cam\d+:", re.MULTILINE)


def is_colmap(text: str) -> bool:
    """Whether the first line that is no comment is a camera of COLMAP."""
    return any(_COLMAP_LINE.fullmatch(line) for line in _colmap_lines(text)[:1])


def _colmap_lines(text: str) -> list[str]:
    return [line for line in text.splitlines() if line.strip() and not line.lstrip().startswith("#")]


def read_colmap(text: str, file: str) -> CameraFile:
    """The camera of a ``cameras.txt``, to which λ is fitted.

    Raises
    ------
    InputError
        When there are several, or the model is one that λ cannot describe.
    """
    cameras = [found for line in _colmap_lines(text) if (found := _COLMAP_LINE.fullmatch(line))]
    model, width, height, values = cameras[0].groups()
    numbers = parse_json(f"[{', '.join(values.split())}]", file).value
    record = Record(file, "", {"MODEL": model, "SIZE": [int(width), int(height)], "PARAMS": numbers})
    if len(cameras) > 1:
        record.fail(f"holds {len(cameras)} cameras; keep the line of the one that took the images")
    focals, coefficients = _COLMAP[record["MODEL"].choice(_COLMAP)]
    given = record["PARAMS"]
    values = given.numbers(focals + 2 + coefficients)
    # COLMAP's pixels have their centres at halves.
    intrinsics = (values[0], values[focals - 1], values[focals] - 0.5, values[focals + 1] - 0.5)
    return _fitted(record, "COLMAP", record["SIZE"], intrinsics, values[focals + 2 :], fisheye="FISHEYE" in model)


def is_kalibr(text: str) -> bool:
    """Whether the text is a chain of cameras."""
    return _KALIBR_CAMERA.search(text) is not None


def read_kalibr(text: str, file: str) -> CameraFile:
    """The camera of a chain of one, to which λ is fitted.

    Raises
    ------
    InputError
        When there are several, or the model is one that λ cannot describe.
    """
    # Rows of matrices say where the camera is.
    lines = ("" if line.lstrip().startswith("- ") else line for line in text.splitlines())
    chain = parse_yaml("\n".join(lines), file)
    cameras = [camera for name, camera in chain.fields().items() if _KALIBR_CAMERA.match(f"{name}:")]
    if len(cameras) > 1:
        chain.fail(f"holds {len(cameras)} cameras; keep the one that took the images")
    camera = cameras[0]
    camera["camera_model"].choice(("pinhole",))
    model = camera["distortion_model"].choice(_KALIBR)
    fx, fy, cx, cy = camera["intrinsics"].numbers(4)
    coefficients = camera["distortion_coeffs"].numbers(_KALIBR[model]) if _KALIBR[model] else ()
    return _fitted(camera, "Kalibr", camera["resolution"], (fx, fy, cx, cy), coefficients, fisheye=model == "equi")


def _fitted(
    record: Record,
    kind: str,
    size: Record,
    intrinsics: tuple[float, float, float, float],
    coefficients: Sequence[float],
    *,
    fisheye: bool,
) -> CameraFile:
    """The camera of a focal length and centre along x and y, and OpenCV's coefficients."""
    fx, fy, cx, cy = intrinsics
    if not min(fx, fy) > 0.0:
        record.fail("expected positive focal lengths")
    lens: Brown | Fisheye = Brown.of_opencv((fx, fy), (cx, cy), coefficients)
    if fisheye:
        lens = Fisheye((fx, fy), (cx, cy), tuple(coefficients))
    return fitted_lens(record, kind, lens, size.size())


def colmap_text(camera: Camera) -> str:
    """The camera as COLMAP reads it: FULL_OPENCV, or OPENCV_FISHEYE where that is closer to the lens."""
    rational, fit = rational_of(camera)
    k1, k2, k3 = rational.radial
    model, values = "FULL_OPENCV", (k1, k2, 0.0, 0.0, k3, *rational.denominator)
    if (fisheye := closer_fisheye(camera, fit, close=0.0)) is not None:
        model, values, fit = "OPENCV_FISHEYE", fisheye[0].coefficients, fisheye[1]
    (width, height), focal = camera.image_size, rational.mean_focal
    # COLMAP's pixels have their centres at halves.
    numbers = (focal, focal, camera.center[0] + 0.5, camera.center[1] + 0.5, *values)
    return (
        comments(camera, fit, model)
        + "# CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]\n"
        + f"1 {model} {width} {height} {' '.join(map(repr, map(float, numbers)))}\n"
    )


def camera_chain_yaml(camera: Camera) -> str:
    """The camera as Kalibr writes it: "radtan", which has k1 and k2 only, or "equi" where that is closer."""
    brown, fit = brown_of(camera, terms=2)
    model, values = "radtan", (*brown.radial[:2], 0.0, 0.0)
    if (fisheye := closer_fisheye(camera, fit)) is not None:
        model, values, fit = "equi", fisheye[0].coefficients, fisheye[1]
    (width, height), (cx, cy), focal = camera.image_size, camera.center, brown.mean_focal
    return (
        comments(camera, fit, model) + "cam0:\n  camera_model: pinhole\n"
        f"  intrinsics: [{focal!r}, {focal!r}, {cx!r}, {cy!r}]\n"
        f"  distortion_model: {model}\n  distortion_coeffs: [{', '.join(map(repr, values))}]\n"
        f"  resolution: [{width}, {height}]\n  rostopic: /camera/image_raw\n"
    )


def camera_info_yaml(camera: Camera) -> str:
    """The camera as ``camera_info_manager`` reads it; whichever of its three models is close to the lens."""
    brown, fit = least_brown_of(camera)
    (k1, k2, k3), focal = brown.radial, brown.mean_focal
    model, values = "plumb_bob", [k1, k2, 0.0, 0.0, k3]
    if brown.denominator:
        model, values = "rational_polynomial", [*values, *brown.denominator]
    if (fisheye := closer_fisheye(camera, fit)) is not None:
        model, values, fit = "equidistant", list(fisheye[0].coefficients), fisheye[1]
    (width, height), (cx, cy) = camera.image_size, camera.center
    matrix = [focal, 0.0, cx, 0.0, focal, cy, 0.0, 0.0, 1.0]
    return (
        comments(camera, fit, model)
        + f"image_width: {width}\nimage_height: {height}\ncamera_name: camera\n"
        + _matrix("camera_matrix", 3, matrix)
        + f"distortion_model: {model}\n"
        + _matrix("distortion_coefficients", 1, values)
        + _matrix("rectification_matrix", 3, [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0])
        + _matrix("projection_matrix", 3, [*matrix[:3], 0.0, *matrix[3:6], 0.0, *matrix[6:], 0.0])
    )


def _matrix(name: str, rows: int, data: Sequence[float]) -> str:
    values = ", ".join(map(repr, map(float, data)))
    return f"{name}:\n  rows: {rows}\n  cols: {len(data) // rows}\n  data: [{values}]\n"
