"""OpenDroneMap's ``cameras.json``: lens models of OpenSfM, with lengths in units of the longer side."""

import json

from rdstitch.camera import Camera
from rdstitch.camera_files.lens_models import Brown, Fisheye, brown_of, closer_fisheye
from rdstitch.camera_files.own_camera import CameraFile, fitted_lens, own_node
from rdstitch.camera_record import camera_from_record
from rdstitch.records import Record

_KIND = "OpenDroneMap"
_OWN = "rdstitch"
_FISHEYE = "fisheye_opencv"
_MODELS = ("perspective", "brown", "simple_radial", "radial", _FISHEYE)


def is_opendronemap(record: Record) -> bool:
    """Whether JSON looks like a ``cameras.json``."""
    values = record.value.values() if isinstance(record.value, dict) else ()
    return any(isinstance(value, dict) and "projection_type" in value for value in values)


def read_opendronemap(record: Record) -> CameraFile:
    """The one camera of the file; without rdstitch's own node, λ is fitted.

    Raises
    ------
    InputError
        When there are several cameras, a field is missing or wrong, or the model is one that λ cannot describe.
    """
    cameras = record.fields()
    if len(cameras) != 1:
        record.fail(f"has {len(cameras)} cameras; keep the one that took the images")
    ((_, entry),) = cameras.items()
    if (own := entry.get(_OWN)) is not None:
        return CameraFile(camera_from_record(own), _KIND)
    kind = entry["projection_type"].choice(_MODELS)
    size = (entry["width"].side(), entry["height"].side())
    longer = max(size)
    either = entry.get("focal")
    fx, fy = (entry[f"focal_{axis}"].number() if either is None else either.number() for axis in "xy")
    if not (fx > 0.0 and fy > 0.0):
        entry.fail("the focal length must be positive")
    shift = (_or_zero(entry, "c_x"), _or_zero(entry, "c_y"))
    focal = (fx * longer, fy * longer)
    center = ((size[0] - 1) / 2 + shift[0] * longer, (size[1] - 1) / 2 + shift[1] * longer)
    k1, k2, k3, k4, p1, p2 = (_or_zero(entry, name) for name in ("k1", "k2", "k3", "k4", "p1", "p2"))
    lens: Brown | Fisheye = Brown(focal, center, (k1, k2, k3), (p1, p2))
    if kind == _FISHEYE:
        lens = Fisheye(focal, center, (k1, k2, k3, k4))
    return fitted_lens(entry, _KIND, lens, size)


def opendronemap_json(camera: Camera) -> str:
    """The camera as OpenDroneMap takes it with ``--cameras``: Brown's model, or a fisheye's where that is closer."""
    lens, fit = brown_of(camera)
    kind, (k1, k2, k3) = "brown", lens.radial
    coefficients = {"k1": k1, "k2": k2, "p1": 0.0, "p2": 0.0, "k3": k3}
    if (fisheye := closer_fisheye(camera, fit)) is not None:
        kind, fit = _FISHEYE, fisheye[1]
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
        _OWN: own_node(camera, fit),
    }
    return json.dumps({f"v2 unknown unknown {width} {height} {kind} {focal:.4g}": entry}, indent=4) + "\n"


def _or_zero(record: Record, name: str) -> float:
    found = record.get(name)
    return 0.0 if found is None else found.number()
