"""The camera itself within the files of others, by which λ comes back as it was; and what they are written with."""

import json
from typing import Any

from rdstitch.camera_files.lens_models import LensFit
from rdstitch.geometry.camera import Camera
from rdstitch.geometry.camera_record import camera_json

FIELD, COMMENT = "rdstitch", "#rdstitch "  # the field, and the comment

Written = tuple[str, LensFit]
"""A camera file, and how far its model is from the lens."""


def comments(camera: Camera, fit: LensFit, model: str) -> str:
    """Comment lines, the last one with the camera itself."""
    record = json.dumps(embedded_camera(camera, fit))
    return f"# {model}: at most {fit.largest:.3f} pixels from the lens\n{COMMENT}{record}\n"


def embedded_camera(camera: Camera, fit: LensFit) -> dict[str, Any]:
    """The camera, and the residual of the model that was fitted to it; what is not known is left out."""
    known = {key: value for key, value in camera_json(camera).items() if value is not None}
    return {**known, "fit_rms_px": fit.rms, "fit_largest_px": fit.largest}


def as_yaml(content: dict[str, Any], *, opencv: bool = True) -> str:
    """Write numbers, texts, lists and one level of objects; with OpenCV's marks, which other readers do not know.

    What PyYAML makes of lists of lists OpenCV cannot read.
    """
    lines = []
    for key, value in content.items():
        if not isinstance(value, dict):
            lines.append(f"{key}: {_as_yaml_value(value)}")
            continue
        matrix = "type_id" in value
        lines.append(f"{key}: !!opencv-matrix" if matrix and opencv else f"{key}:")
        left_out = ("type_id",) if opencv or not matrix else ("type_id", "dt")
        lines += [f"   {name}: {_as_yaml_value(item)}" for name, item in value.items() if name not in left_out]
    return "\n".join(lines) + "\n"


def _as_yaml_value(value: Any) -> str:
    """A number, text, list or object: YAML 1.1 takes numbers with an exponent, but without a dot, for texts."""
    if isinstance(value, list | tuple):
        return f"[{', '.join(map(_as_yaml_value, value))}]"
    if isinstance(value, dict):
        return f"{{{', '.join(f'{key}: {_as_yaml_value(item)}' for key, item in value.items())}}}"
    text = json.dumps(value)
    return text.replace("e", ".0e") if isinstance(value, float) and "." not in text else text
