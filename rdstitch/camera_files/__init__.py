"""Camera files: rdstitch's own and those of others, to whose lens models the lens is fitted; each states the residual.

===================================  ==========================================================
``*.json``                           rdstitch's own
``*.yml``, ``*.yaml``                OpenCV's FileStorage as YAML
``opencv.json``, ``*.opencv.json``   OpenCV's FileStorage as JSON
``fisheye.yml``, ``*.fisheye.yml``   OpenCV's FileStorage as YAML, for ``cv2.fisheye``
``camera_info.yaml``                 ROS
``camchain.yaml``                    Kalibr
``cameras.txt``                      COLMAP
``cameras.json``                     OpenDroneMap
``*.pto``                            Hugin
===================================  ==========================================================

What is written follows from the name, as above; what is read is known by its content.
"""

import json
import re
from collections.abc import Callable
from fnmatch import fnmatchcase
from pathlib import Path

from rdstitch.camera import Camera
from rdstitch.camera_files.hugin import hugin_project, is_hugin, read_hugin
from rdstitch.camera_files.lens_fit import LensFit
from rdstitch.camera_files.opencv import (
    ImageSize,
    is_opencv,
    opencv_fisheye_yaml,
    opencv_json,
    opencv_yaml,
    parse_yaml,
    read_opencv,
)
from rdstitch.camera_files.opendronemap import is_opendronemap, opendronemap_json, read_opendronemap
from rdstitch.camera_files.own_camera import CameraFile, read_comments
from rdstitch.camera_files.text_formats import (
    camera_chain_yaml,
    camera_info_yaml,
    colmap_text,
    is_colmap,
    is_kalibr,
    read_colmap,
    read_kalibr,
)
from rdstitch.camera_record import camera_from_record
from rdstitch.errors import OutputError
from rdstitch.io.atomic import text_bytes, write_bytes_atomic
from rdstitch.records import parse_json, read_text

__all__ = ["CAMERA_SUFFIXES", "CameraFile", "LensFit", "export_note", "load_camera", "read_camera_file", "save_camera"]

CAMERA_SUFFIXES = (".json", ".yml", ".yaml", ".pto", ".txt")
"""How names of camera files end, lower case."""

_STATED = re.compile(r"(?<!lambda_)fit_largest_px\"?: ([-+.\de]+)")
"""The residual that files of others state."""


def load_camera(path: str | Path, image_size: tuple[int, int] | None = None) -> Camera:
    """Read a camera file of any known format; see :func:`read_camera_file`, which also gives how well λ fits.

    Parameters
    ----------
    path : path
    image_size : (int, int), optional
        Width and height of the images, pixels, for a file of OpenCV that does not say them.

    Returns
    -------
    Camera

    Raises
    ------
    InputError
        When the file cannot be read, or holds no camera.
    """
    return read_camera_file(path, None if image_size is None else lambda: image_size).camera


def read_camera_file(path: str | Path, image_size: ImageSize | None = None) -> CameraFile:
    """Read a camera file of any known format.

    A file that rdstitch wrote gives back λ exactly; to the lens model of any other, λ is fitted.

    Parameters
    ----------
    path : path
    image_size : callable, optional
        Gives width and height of the images, pixels, for a file of OpenCV that does not say them.

    Raises
    ------
    InputError
        When the file cannot be read, is no camera file, or tells of a lens that λ cannot describe.
    """
    text, file = read_text(path), str(path)
    if text.lstrip().startswith("{"):
        record = parse_json(text, file)
        if is_opencv(record):
            return read_opencv(record, image_size)
        if is_opendronemap(record):
            return read_opendronemap(record)
        return CameraFile(camera_from_record(record), "rdstitch")
    if is_hugin(text):
        return read_hugin(text, file)
    if (own := read_comments(text, file, "rdstitch")) is not None:
        return own
    if is_colmap(text):
        return read_colmap(text, file)
    if is_kalibr(text):
        return read_kalibr(text, file)
    return read_opencv(parse_yaml(text, file), image_size)


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
    write_bytes_atomic(path, text_bytes(camera_file_text(camera, path)))


def camera_file_text(camera: Camera, path: str | Path) -> str:
    """What :func:`save_camera` writes into a file of this name.

    Raises
    ------
    OutputError
        When the name says no format.
    """
    return _writer(Path(path))(camera)


def export_note(camera: Camera, path: str | Path) -> tuple[str, ...]:
    """What the model of a camera file of others costs, one sentence; nothing for rdstitch's own.

    Parameters
    ----------
    path : path
        As :func:`save_camera` takes it.
    """
    largest = _STATED.findall(_writer(Path(path))(camera))
    return tuple(f"{path}: its lens model is at most {float(value):.3f} pixels from the lens" for value in largest[-1:])


def _writer(path: Path) -> Callable[[Camera], str]:
    for pattern, writer in _WRITERS.items():
        if fnmatchcase(path.name.lower(), pattern):
            return writer
    raise OutputError(f"{path}: not the name of a camera file; use one of {' '.join(CAMERA_SUFFIXES)}")


def _own_json(camera: Camera) -> str:
    return json.dumps(camera.as_dict(), indent=2) + "\n"


_WRITERS: dict[str, Callable[[Camera], str]] = {
    "cameras.json": opendronemap_json,
    "opencv.json": opencv_json,
    "*.opencv.json": opencv_json,
    "?*.json": _own_json,
    "camera_info.yml": camera_info_yaml,
    "camera_info.yaml": camera_info_yaml,
    "camchain.yaml": camera_chain_yaml,
    "fisheye.yml": opencv_fisheye_yaml,
    "fisheye.yaml": opencv_fisheye_yaml,
    "*.fisheye.yml": opencv_fisheye_yaml,
    "*.fisheye.yaml": opencv_fisheye_yaml,
    "?*.yml": opencv_yaml,
    "?*.yaml": opencv_yaml,
    "cameras.txt": colmap_text,
    "?*.pto": hugin_project,
}
"""By the name of the file, the first that fits."""
