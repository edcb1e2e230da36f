"""COLMAP's ``cameras.txt``, with one camera. Its pixels have their centres at halves."""

from rdstitch.camera import Camera
from rdstitch.camera_files.brown import rational_of
from rdstitch.camera_files.comments import comments
from rdstitch.camera_files.fisheye import fisheye_of


def colmap_text(camera: Camera) -> str:
    """The camera as COLMAP reads it: FULL_OPENCV, or OPENCV_FISHEYE where that is closer to the lens."""
    rational, fit = rational_of(camera)
    k1, k2, k3 = rational.radial
    model, values = "FULL_OPENCV", (k1, k2, 0.0, 0.0, k3, *rational.denominator)
    fisheye, fisheye_fit = fisheye_of(camera)
    if fisheye_fit.largest < fit.largest:
        model, values, fit = "OPENCV_FISHEYE", fisheye.coefficients, fisheye_fit
    (width, height), focal = camera.image_size, rational.mean_focal
    numbers = (focal, focal, camera.center[0] + 0.5, camera.center[1] + 0.5, *values)
    return (
        comments(camera, fit, model)
        + "# CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]\n"
        + f"1 {model} {width} {height} {' '.join(map(repr, map(float, numbers)))}\n"
    )
