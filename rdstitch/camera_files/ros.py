"""ROS: the ``camera_info`` that drivers load and publish, in YAML."""

from collections.abc import Sequence

from rdstitch.camera import Camera
from rdstitch.camera_files.brown import CLOSE, least_brown_of
from rdstitch.camera_files.comments import comments
from rdstitch.camera_files.fisheye import fisheye_of


def camera_info_yaml(camera: Camera) -> str:
    """The camera as ``camera_info_manager`` reads it; whichever of its three models is close to the lens."""
    brown, fit = least_brown_of(camera)
    fisheye, fisheye_fit = fisheye_of(camera)
    (k1, k2, k3), focal = brown.radial, brown.mean_focal
    model, values = "plumb_bob", [k1, k2, 0.0, 0.0, k3]
    if brown.denominator:
        model, values = "rational_polynomial", [*values, *brown.denominator]
    if fit.largest > CLOSE and fisheye_fit.largest < fit.largest:
        model, values, fit = "equidistant", list(fisheye.coefficients), fisheye_fit
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
