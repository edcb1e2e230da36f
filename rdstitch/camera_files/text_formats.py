"""COLMAP, Kalibr and ROS: camera files of text, which are written; what comes back is rdstitch's own camera in them."""

from collections.abc import Sequence

from rdstitch.camera import Camera
from rdstitch.camera_files.lens_models import brown_of, closer_fisheye, least_brown_of, rational_of
from rdstitch.camera_files.own_camera import comments


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
