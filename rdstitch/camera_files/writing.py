"""Cameras as others read them: the lens model of each that is nearest, and the division model itself as a comment.

A format is a table of its fields; how it is spelt, as JSON, YAML or lines, is one function for all.
"""

import json
from collections.abc import Sequence
from typing import Any

from rdstitch.camera import Camera
from rdstitch.camera_files.lens_fit import LensFit
from rdstitch.camera_files.lens_models import brown_of, closer_fisheye, fisheye_of, least_brown_of, rational_of

OWN, OWN_COMMENT = "rdstitch", "#rdstitch "
"""The field, and the comment, with the division model: by it λ comes back as it was."""


def own_json(camera: Camera) -> str:
    """A camera file of rdstitch."""
    return json.dumps(camera.as_dict(), indent=2) + "\n"


def opencv_json(camera: Camera) -> str:
    """The camera as FileStorage writes JSON."""
    return json.dumps(_opencv(camera), indent=4) + "\n"


def opencv_yaml(camera: Camera) -> str:
    """The camera as FileStorage writes YAML: Brown's model, or the rational one where 5 coefficients are not close."""
    return "%YAML:1.0\n---\n" + _as_yaml(_opencv(camera))


def opencv_fisheye_yaml(camera: Camera) -> str:
    """The camera for the functions of ``cv2.fisheye``, as FileStorage writes YAML."""
    lens, fit = fisheye_of(camera)
    content = _calibration(camera, lens.mean_focal, lens.coefficients, {"fisheye_model": 1})
    return "%YAML:1.0\n---\n" + _as_yaml({**content, OWN: _own(camera, fit)})


def _opencv(camera: Camera) -> dict[str, Any]:
    brown, fit = least_brown_of(camera)
    k1, k2, k3 = brown.radial
    content = _calibration(camera, brown.mean_focal, (k1, k2, 0.0, 0.0, k3, *brown.denominator), {})
    return {**content, OWN: _own(camera, fit)}


def _calibration(camera: Camera, focal: float, k: Sequence[float], model: dict[str, Any]) -> dict[str, Any]:
    """The fields that FileStorage and ROS share."""
    (width, height), (cx, cy) = camera.image_size, camera.center
    return {
        "image_width": width,
        "image_height": height,
        **model,
        "camera_matrix": _matrix(3, [focal, 0.0, cx, 0.0, focal, cy, 0.0, 0.0, 1.0]),
        "distortion_coefficients": _matrix(1, k),
    }


def _matrix(rows: int, data: Sequence[float]) -> dict[str, Any]:
    values = [float(value) for value in data]
    return {"type_id": "opencv-matrix", "rows": rows, "cols": len(values) // rows, "dt": "d", "data": values}


def camera_info_yaml(camera: Camera) -> str:
    """The camera as ``camera_info_manager`` reads it; whichever of its three models is close to the lens."""
    brown, fit = least_brown_of(camera)
    k1, k2, k3 = brown.radial
    model, values = "plumb_bob", [k1, k2, 0.0, 0.0, k3]
    if brown.denominator:
        model, values = "rational_polynomial", [*values, *brown.denominator]
    if (fisheye := closer_fisheye(camera, fit)) is not None:
        model, values, fit = "equidistant", list(fisheye[0].coefficients), fisheye[1]
    content = _calibration(camera, brown.mean_focal, values, {"camera_name": "camera", "distortion_model": model})
    matrix = content["camera_matrix"]["data"]
    content["rectification_matrix"] = _matrix(3, [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0])
    content["projection_matrix"] = _matrix(3, [*matrix[:3], 0.0, *matrix[3:6], 0.0, *matrix[6:], 0.0])
    return comments(camera, fit, model) + _as_yaml(content, opencv=False)


def camera_chain_yaml(camera: Camera) -> str:
    """The camera as Kalibr writes it: "radtan", which has k1 and k2 only, or "equi" where that is closer."""
    brown, fit = brown_of(camera, terms=2)
    model, values = "radtan", (*brown.radial[:2], 0.0, 0.0)
    if (fisheye := closer_fisheye(camera, fit)) is not None:
        model, values, fit = "equi", fisheye[0].coefficients, fisheye[1]
    entry = {
        "camera_model": "pinhole",
        "intrinsics": [brown.mean_focal, brown.mean_focal, *camera.center],
        "distortion_model": model,
        "distortion_coeffs": list(values),
        "resolution": list(camera.image_size),
        "rostopic": "/camera/image_raw",
    }
    return comments(camera, fit, model) + _as_yaml({"cam0": entry}, opencv=False)


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
        + f"1 {model} {width} {height} {' '.join(repr(float(value)) for value in numbers)}\n"
    )


def opendronemap_json(camera: Camera) -> str:
    """The camera as OpenDroneMap takes it with ``--cameras``: Brown's model, or a fisheye's where that is closer."""
    lens, fit = brown_of(camera)
    kind, (k1, k2, k3) = "brown", lens.radial
    coefficients = {"k1": k1, "k2": k2, "p1": 0.0, "p2": 0.0, "k3": k3}
    if (fisheye := closer_fisheye(camera, fit)) is not None:
        kind, fit = "fisheye_opencv", fisheye[1]
        coefficients = {f"k{i}": k for i, k in enumerate(fisheye[0].coefficients, start=1)}
    (width, height), longer = camera.image_size, max(camera.image_size)
    focal = lens.mean_focal / longer
    entry = {
        "projection_type": kind,
        "width": width,
        "height": height,
        "focal_x": focal,
        "focal_y": focal,
        "c_x": (camera.center[0] - (width - 1) / 2) / longer,
        "c_y": (camera.center[1] - (height - 1) / 2) / longer,
        **coefficients,
        OWN: _own(camera, fit),
    }
    return json.dumps({f"v2 unknown unknown {width} {height} {kind} {focal:.4g}": entry}, indent=4) + "\n"


def comments(camera: Camera, fit: LensFit, model: str) -> str:
    """Comment lines, the last one with the camera itself."""
    return f"# {model}: at most {fit.largest:.3f} pixels from the lens\n{OWN_COMMENT}{json.dumps(_own(camera, fit))}\n"


def _own(camera: Camera, fit: LensFit) -> dict[str, Any]:
    """The camera, and the residual of the model that was fitted to it; what is not known is left out."""
    known = {key: value for key, value in camera.as_dict().items() if value is not None}
    return {**known, "fit_rms_px": fit.rms, "fit_largest_px": fit.largest}


def _as_yaml(content: dict[str, Any], *, opencv: bool = True) -> str:
    """Numbers, texts, lists and one level of objects; with OpenCV's marks, which other readers do not know."""
    lines = []
    for key, value in content.items():
        if not isinstance(value, dict):
            lines.append(f"{key}: {json.dumps(value)}")
            continue
        matrix = "type_id" in value
        lines.append(f"{key}: !!opencv-matrix" if matrix and opencv else f"{key}:")
        left_out = ("type_id",) if opencv or not matrix else ("type_id", "dt")
        lines += [f"   {name}: {json.dumps(item)}" for name, item in value.items() if name not in left_out]
    return "\n".join(lines) + "\n"
