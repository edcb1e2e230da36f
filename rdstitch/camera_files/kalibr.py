"""Kalibr's camera chain in YAML, with one camera."""

from rdstitch.camera import Camera
from rdstitch.camera_files.brown import CLOSE, brown_of
from rdstitch.camera_files.comments import comments
from rdstitch.camera_files.fisheye import fisheye_of


def camera_chain_yaml(camera: Camera) -> str:
    """The camera as Kalibr writes it: "radtan", which has k1 and k2 only, or "equi" where that is closer."""
    brown, fit = brown_of(camera, terms=2)
    model, values = "radtan", (*brown.radial[:2], 0.0, 0.0)
    fisheye, fisheye_fit = fisheye_of(camera)
    if fit.largest > CLOSE and fisheye_fit.largest < fit.largest:
        model, values, fit = "equi", fisheye.coefficients, fisheye_fit
    (width, height), (cx, cy), focal = camera.image_size, camera.center, brown.mean_focal
    return (
        comments(camera, fit, model) + "cam0:\n  camera_model: pinhole\n"
        f"  intrinsics: [{focal!r}, {focal!r}, {cx!r}, {cy!r}]\n"
        f"  distortion_model: {model}\n  distortion_coeffs: [{', '.join(map(repr, values))}]\n"
        f"  resolution: [{width}, {height}]\n  rostopic: /camera/image_raw\n"
    )
