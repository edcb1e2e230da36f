"""Cameras as others read them: the nearest lens model of each, with the division model as a comment or a field."""

import json
from typing import Any

from rdstitch.camera import Camera
from rdstitch.camera_files.lens_models import LensFit, LensModel, nearest_model

OWN, OWN_COMMENT = "rdstitch", "#rdstitch "
"""The field, and the comment, with the division model: by it λ comes back as it was."""


def opencv_json(camera: Camera) -> str:
    """Write a camera as FileStorage writes JSON: Brown's model, or the rational one where that is closer."""
    return json.dumps(_opencv(camera, "polynomial", "rational"), indent=4) + "\n"


def opencv_yaml(camera: Camera) -> str:
    """Write the same as FileStorage writes YAML."""
    return "%YAML:1.0\n---\n" + _as_yaml(_opencv(camera, "polynomial", "rational"))


def opencv_fisheye_yaml(camera: Camera) -> str:
    """Write a camera for the functions of ``cv2.fisheye``, as FileStorage writes YAML."""
    return "%YAML:1.0\n---\n" + _as_yaml(_opencv(camera, "fisheye", fisheye_model=1))


def _opencv(camera: Camera, *models: str, **further: int) -> dict[str, Any]:
    lens, fit = nearest_model(camera, *models)
    return {**_calibration(camera, lens, **further), OWN: _own(camera, fit)}


def _calibration(camera: Camera, lens: LensModel, **further: Any) -> dict[str, Any]:
    """Give the fields that FileStorage and ROS share."""
    (width, height), (cx, cy), focal = camera.image_size, camera.center, lens.mean_focal
    return {
        "image_width": width,
        "image_height": height,
        **further,
        "camera_matrix": _matrix(3, focal, 0.0, cx, 0.0, focal, cy, 0.0, 0.0, 1.0),
        "distortion_coefficients": _matrix(1, *lens.coefficients),
    }


def _matrix(rows: int, *data: float) -> dict[str, Any]:
    values = [float(value) for value in data]
    return {"type_id": "opencv-matrix", "rows": rows, "cols": len(values) // rows, "dt": "d", "data": values}


def _named(lens: LensModel, fisheye: str, rational: str, other: str) -> str:
    """Choose the name that a format has for a model."""
    return fisheye if lens.fisheye else rational if len(lens.coefficients) > 5 else other


def camera_info_yaml(camera: Camera) -> str:
    """Write a camera as ``camera_info_manager`` reads it."""
    lens, fit = nearest_model(camera, "polynomial", "rational", "fisheye")
    model = _named(lens, "equidistant", "rational_polynomial", "plumb_bob")
    content = _calibration(camera, lens, camera_name="camera", distortion_model=model)
    matrix = content["camera_matrix"]["data"]
    content["rectification_matrix"] = _matrix(3, 1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0)
    content["projection_matrix"] = _matrix(3, *matrix[:3], 0.0, *matrix[3:6], 0.0, *matrix[6:], 0.0)
    return comments(camera, fit, model) + _as_yaml(content, opencv=False)


def camera_chain_yaml(camera: Camera) -> str:
    """Write a camera as Kalibr does: "radtan", which has k1 and k2 only, or "equi" where that is closer."""
    lens, fit = nearest_model(camera, "two terms", "fisheye")
    model = _named(lens, "equi", "", "radtan")
    entry = {
        "camera_model": "pinhole",
        "intrinsics": [*lens.focal, *camera.center],
        "distortion_model": model,
        "distortion_coeffs": list(lens.coefficients),
        "resolution": list(camera.image_size),
        "rostopic": "/camera/image_raw",
    }
    return comments(camera, fit, model) + _as_yaml({"cam0": entry}, opencv=False)


def colmap_text(camera: Camera) -> str:
    """Write a camera as COLMAP reads it: FULL_OPENCV, or OPENCV_FISHEYE where that is closer to the lens."""
    lens, fit = nearest_model(camera, "rational", "fisheye", close=0.0)
    model = _named(lens, "OPENCV_FISHEYE", "FULL_OPENCV", "")
    # COLMAP's pixels have their centres at halves.
    numbers = (*camera.image_size, *lens.focal, *(value + 0.5 for value in camera.center), *lens.coefficients)
    return (
        f"{comments(camera, fit, model)}# CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]\n"
        f"1 {model} {' '.join(map(repr, numbers))}\n"
    )


def opendronemap_json(camera: Camera) -> str:
    """Write a camera as OpenDroneMap takes it with ``--cameras``."""
    lens, fit = nearest_model(camera, "polynomial", "fisheye")
    kind = _named(lens, "fisheye_opencv", "", "brown")
    names = ("k1", "k2", "k3", "k4") if lens.fisheye else ("k1", "k2", "p1", "p2", "k3")
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
        **dict(zip(names, lens.coefficients, strict=True)),
        OWN: _own(camera, fit),
    }
    return json.dumps({f"v2 unknown unknown {width} {height} {kind} {focal:.4g}": entry}, indent=4) + "\n"


def comments(camera: Camera, fit: LensFit, model: str) -> str:
    """Give comment lines, the last one with the camera itself."""
    return f"# {model}: at most {fit.largest:.3f} pixels from the lens\n{OWN_COMMENT}{json.dumps(_own(camera, fit))}\n"


def _own(camera: Camera, fit: LensFit) -> dict[str, Any]:
    """Give the camera, and the residual of the model that was fitted to it; what is not known is left out."""
    known = {key: value for key, value in camera.as_dict().items() if value is not None}
    return {**known, "fit_rms_px": fit.rms, "fit_largest_px": fit.largest}


def _as_yaml(content: dict[str, Any], *, opencv: bool = True) -> str:
    """Write numbers, texts, lists and one level of objects; with OpenCV's marks, which other readers do not know."""
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
