"""Comment lines of text formats: what the model costs, and rdstitch's own camera, so that it comes back exactly."""

import json

from rdstitch.camera import Camera
from rdstitch.camera_files.division import CameraFile, own_node
from rdstitch.camera_files.lens_fit import LensFit
from rdstitch.camera_record import camera_from_record
from rdstitch.records import parse_json

_OWN = "#rdstitch "


def comments(camera: Camera, fit: LensFit, model: str) -> str:
    """Comment lines, the last one with the camera itself."""
    return f"# {model}: at most {fit.largest:.3f} pixels from the lens\n{_OWN}{json.dumps(own_node(camera, fit))}\n"


def read_comments(text: str, file: str, kind: str) -> CameraFile | None:
    """The camera of a comment line; None where there is none."""
    own = next((line for line in text.splitlines() if line.startswith(_OWN)), None)
    if own is None:
        return None
    return CameraFile(camera_from_record(parse_json(own.removeprefix(_OWN), file)), kind)
