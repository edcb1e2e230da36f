"""Camera files: rdstitch's own and those of others, to whose lens models the lens is fitted; each states the residual.

What is read is known by its content, what is written by its name or by ``camera_format``: see docs/formats.md.
"""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from fnmatch import fnmatchcase
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

from rdstitch.camera_files.embedded_camera import COMMENT, FIELD
from rdstitch.camera_files.lens_models import CameraFile, LensFit
from rdstitch.camera_files.opencv import ImageSize, camera_info_yaml, is_opencv, opencv_text, read_opencv
from rdstitch.camera_files.photogrammetry import (
    camera_chain_yaml,
    colmap_cameras,
    colmap_text,
    opendronemap_json,
    read_colmap,
    read_kalibr,
    read_opendronemap,
)
from rdstitch.camera_files.polynomials import hugin_project, is_hugin, lensfun_xml, read_hugin, read_lensfun
from rdstitch.choices import CameraFormat
from rdstitch.errors import ArgumentError, InputError, OutputError
from rdstitch.geometry.camera import Camera
from rdstitch.geometry.camera_record import CameraRecord, camera_json
from rdstitch.options.option import check_parameter
from rdstitch.system.file_access import read_text
from rdstitch.system.outputs import json_bytes, text_bytes, write_bytes_atomic
from rdstitch.system.records import convert, parse_json, parse_yaml

__all__ = [
    "CAMERA_SUFFIXES",
    "CameraFile",
    "LensFit",
    "camera_of_content",
    "export_note",
    "format_of",
    "load_camera",
    "read_camera_file",
    "save_camera",
]

Value = TypeVar("Value")

CAMERA_SUFFIXES = (".json", ".yml", ".yaml", ".pto", ".txt", ".xml")  # how names of camera files end, lower case


def load_camera(path: str | Path, image_size: tuple[int, int] | None = None) -> Camera:
    """Read a camera file of any known format; see :func:`read_camera_file`, which also gives how well λ fits.

    Parameters
    ----------
    path : path
    image_size : (int, int), optional
        Width and height of the images, pixels, for a file of OpenCV or lensfun that does not say them.

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
    """
    text, file = read_text(path), str(path)
    with _naming(file):
        if text.lstrip().startswith("{"):
            return _of_content(parse_json(text, file), file, image_size)
        embedded = next((line for line in text.splitlines() if line.startswith(COMMENT)), None)
        if embedded is not None:
            return _of_record(parse_json(embedded.removeprefix(COMMENT), file), file)
        if text.lstrip().startswith("<"):
            return read_lensfun(text, file, image_size)
        if is_hugin(text):
            return read_hugin(text, file)
        if cameras := colmap_cameras(text):
            return read_colmap(_only(cameras), file)
        return _of_content(parse_yaml(text, file), file, image_size)


def camera_of_content(content: dict[str, Any], file: str) -> CameraFile:
    """The camera of a message of ROS, as plain values, to which λ is fitted."""
    with _naming(file):
        return _of_content(content, file, None)


@contextmanager
def _naming(file: str) -> Iterator[None]:
    """What is wrong with the content is an error that names the file."""
    try:
        yield
    except ArgumentError as error:
        raise InputError(f"{file}: {error}") from error


def _of_content(content: Any, file: str, image_size: ImageSize | None) -> CameraFile:
    """The camera of plain values, whosever they are."""
    if is_opencv(content):
        embedded = content.get(FIELD)
        return read_opencv(content, file, image_size) if embedded is None else _of_record(embedded, file, FIELD)
    entries = content.items() if isinstance(content, dict) else ()
    for key, read in (("projection_type", read_opendronemap), ("camera_model", read_kalibr)):
        if matching := [(name, entry) for name, entry in entries if isinstance(entry, dict) and key in entry]:
            name, entry = _only(matching)
            embedded = entry.get(FIELD)
            return read(entry, file, str(name)) if embedded is None else _of_record(embedded, file, f"{name}.{FIELD}")
    if "format" not in dict(entries):
        raise ArgumentError("is no camera file of a known format")
    return _of_record(content, file)


def _only(cameras: Sequence[Value]) -> Value:
    if len(cameras) > 1:
        raise ArgumentError(f"holds {len(cameras)} cameras; keep the one that took the images")
    return cameras[0]


def _of_record(content: Any, file: str, field: str = "") -> CameraFile:
    """What rdstitch wrote, alone or into the file of others."""
    return CameraFile(convert(content, CameraRecord, file, field, strict=False).camera(), "rdstitch")


def save_camera(camera: Camera, path: str | Path, camera_format: CameraFormat = "auto") -> None:
    """Write a camera file.

    Parameters
    ----------
    camera : Camera
    path : path
        ``.json``, ``.yml``, ``.pto``, …; see :mod:`rdstitch.camera_files`.
    camera_format : str
        One of ``rdstitch.choices.CameraFormat``; "auto": what the name says.

    Raises
    ------
    ArgumentError
        When there is no such format.
    OutputError
        When the name says none, or the file cannot be written.
    """
    write_bytes_atomic(path, text_bytes(camera_file_text(camera, path, camera_format)))


def camera_file_text(camera: Camera, path: str | Path, camera_format: CameraFormat = "auto") -> str:
    """What :func:`save_camera` writes."""
    return _written(camera, path, camera_format)[0]


def format_of(path: str | Path, camera_format: CameraFormat = "auto") -> CameraFormat:
    """The format of a camera file that is written: the one that is wanted, or what its name says."""
    check_parameter("camera_format", CameraFormat, camera_format)
    if camera_format != "auto":
        return camera_format
    file = Path(path)
    name = file.name.lower().removesuffix(".yml")
    name += ".yaml" if name != file.name.lower() else ""
    for each, (patterns, _) in _FORMATS.items():
        if any(fnmatchcase(name, pattern) for pattern in patterns):
            return each
    raise OutputError(
        f"{file}: not the name of a camera file; use one that ends with {' '.join(CAMERA_SUFFIXES)}, or give "
        f"--camera-format ({', '.join(_FORMATS)})"
    )


def export_note(camera: Camera, path: str | Path, camera_format: CameraFormat = "auto") -> tuple[str, ...]:
    """Say what the model of a camera file of others costs, in one sentence; nothing for rdstitch's own."""
    _, fit = _written(camera, path, camera_format)
    return () if fit is None else (f"{path}: its lens model is at most {fit.largest:.3f} pixels from the lens",)


def _written(camera: Camera, path: str | Path, camera_format: CameraFormat) -> tuple[str, LensFit | None]:
    """What is written, and how far the model of it is from the lens where it is not rdstitch's own."""
    return _FORMATS[format_of(path, camera_format)][1](camera)


# Patterns of the names of files, of which ``.yml`` is ``.yaml``, and what is written; the first that fits counts.
_FORMATS: dict[CameraFormat, tuple[tuple[str, ...], Callable[[Camera], tuple[str, LensFit | None]]]] = {
    "opendronemap": (("cameras.json",), opendronemap_json),
    "opencv-json": (("opencv.json", "*.opencv.json"), partial(opencv_text, yaml=False)),
    "rdstitch": (("?*.json",), lambda camera: (json_bytes(camera_json(camera)).decode(), None)),
    "ros": (("camera_info.yaml",), camera_info_yaml),
    "kalibr": (("camchain.yaml",), camera_chain_yaml),
    "fisheye": (("fisheye.yaml", "*.fisheye.yaml"), partial(opencv_text, fisheye=True)),
    "opencv": (("?*.yaml",), opencv_text),
    "colmap": (("cameras.txt",), colmap_text),
    "hugin": (("?*.pto",), hugin_project),
    "lensfun": (("?*.xml",), lensfun_xml),
}
