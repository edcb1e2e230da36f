"""Camera files: rdstitch's own, OpenCV's, OpenDroneMap's and Hugin's; what is not λ is fitted, and the residual told.

===================================  ==========================================================
``*.json``                           rdstitch's own
``*.yml``, ``*.yaml``                OpenCV's FileStorage as YAML
``opencv.json``, ``*.opencv.json``   OpenCV's FileStorage as JSON
``cameras.json``                     OpenDroneMap
``*.pto``                            Hugin
===================================  ==========================================================

What is written follows from the name, as above; what is read is known by its content.
"""

import json
from collections.abc import Callable
from pathlib import Path

from rdstitch.camera import Camera
from rdstitch.camera_files.division import CameraFile
from rdstitch.camera_files.hugin import hugin_project, is_hugin, read_hugin
from rdstitch.camera_files.lens_fit import LensFit
from rdstitch.camera_files.opencv import is_opencv, opencv_json, opencv_yaml, read_opencv
from rdstitch.camera_files.opencv_yaml import parse_yaml
from rdstitch.camera_files.opendronemap import is_opendronemap, opendronemap_json, read_opendronemap
from rdstitch.errors import OutputError
from rdstitch.io.atomic import write_text_atomic
from rdstitch.records import parse_json, read_text

__all__ = ["CAMERA_SUFFIXES", "CameraFile", "LensFit", "load_camera", "read_camera_file", "save_camera"]

CAMERA_SUFFIXES = (".json", ".yml", ".yaml", ".pto")
"""How names of camera files end, lower case."""


def load_camera(path: str | Path) -> Camera:
    """Read a camera file of any known format; see :func:`read_camera_file`, which also tells how well λ fits.

    Parameters
    ----------
    path : path
    """
    return read_camera_file(path).camera


def read_camera_file(path: str | Path) -> CameraFile:
    """Read a camera file of any known format.

    A file that rdstitch wrote gives back λ exactly; to the lens model of any other, λ is fitted.

    Raises
    ------
    InputError
        When the file cannot be read, is no camera file, or tells of a lens that λ cannot describe.
    """
    text, file = read_text(path), str(path)
    if text.lstrip().startswith("{"):
        record = parse_json(text, file)
        if is_opencv(record):
            return read_opencv(record)
        if is_opendronemap(record):
            return read_opendronemap(record)
        return CameraFile(Camera.from_record(record), "rdstitch")
    if is_hugin(text):
        return read_hugin(text, file)
    return read_opencv(parse_yaml(text, file))


def save_camera(camera: Camera, path: str | Path) -> None:
    """Write a camera file; the name says which format.

    Parameters
    ----------
    camera : Camera
    path : path
        ``.json``, ``.yml``, ``.pto``, …; see :mod:`rdstitch.camera_files`.

    Raises
    ------
    OutputError
        When the name says none, or the file cannot be written.
    """
    write_text_atomic(path, camera_file_text(camera, path))


def camera_file_text(camera: Camera, path: str | Path) -> str:
    """What :func:`save_camera` writes into a file of this name.

    Raises
    ------
    OutputError
        When the name says no format.
    """
    return _writer(Path(path))(camera)


def _writer(path: Path) -> Callable[[Camera], str]:
    name = path.name.lower()
    if name == "cameras.json":
        return opendronemap_json
    if name == "opencv.json" or name.endswith(".opencv.json"):
        return opencv_json
    writers = {".json": _own_json, ".yml": opencv_yaml, ".yaml": opencv_yaml, ".pto": hugin_project}
    if path.suffix.lower() not in writers:
        raise OutputError(f"{path}: not the name of a camera file; use one of {' '.join(CAMERA_SUFFIXES)}")
    return writers[path.suffix.lower()]


def _own_json(camera: Camera) -> str:
    return json.dumps(camera.as_dict(), indent=2) + "\n"
