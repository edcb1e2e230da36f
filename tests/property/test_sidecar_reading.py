"""Random damage to sidecars, camera files and other records is refused by name."""

import json
import re
import tempfile
from collections.abc import Callable
from importlib.metadata import PackageNotFoundError
from pathlib import Path
from typing import Any

import cv2
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rdstitch.camera_files import load_camera, save_camera
from rdstitch.errors import InputError
from rdstitch.geometry.camera import Camera
from rdstitch.geometry.camera_record import camera_json
from rdstitch.options.stitch_options import StitchOptions
from rdstitch.sidecar.read import read_sidecar
from rdstitch.sidecar.write import versions
from rdstitch.system.records import parse_json, to_jsonable
from tests.damaged_texts import damaged, damaged_text

_IMAGE = {
    "name": "a.jpg",
    "path": "flight/a.jpg",
    "size": [400, 300],
    "center_px": [199.5, 149.5],
    "lambda": -0.2,
    "coefficients": [-0.2, 0.0, 0.0],
    "focal_px": 380.0,
    "focal_source": "exif",
    "used": True,
    "reason": "",
    "to_plane": [[1.0, 0.0, 0.1], [0.0, 1.0, 0.2], [0.0, 0.01, 1.0]],
}
_LEFT_OUT = {**_IMAGE, "name": "b.jpg", "used": False, "reason": "no overlap", "to_plane": None}
_UNREAD = {"name": "c.jpg", "path": "c.jpg", "size": None, "used": False, "reason": "is damaged"}
GOOD: dict[str, Any] = {
    "format": "rdstitch sidecar",
    "version": 2,
    "lambda": -0.2,
    "lambda_std": 0.001,
    "lambda_px": -3.2e-6,
    "lambda_focal": -0.46,
    "lambda_known": False,
    "camera": camera_json(Camera((400, 300), -0.2, focal=380.0, focal_source="exif")),
    "tilt_deg": None,
    "focal_px": 380.0,
    "focal_source": "exif",
    "model": "similarity",
    "model_reason": "it is enough",
    "rms_px": 0.5,
    "reference": "a.jpg",
    "output": {"file": "out.tif", "size": [400, 300], "plane_to_output": _IMAGE["to_plane"]},
    "images": [_IMAGE, _LEFT_OUT, _UNREAD],
    "pairs": [],
    "verdict": {"ok": True},
    "options": to_jsonable(StitchOptions()),
    "seed": 0,
    "versions": {"rdstitch": "0.1.0"},
}


def _write(folder: str | Path, content: bytes, name: str = "out.tif.json") -> Path:
    file = Path(folder) / name
    file.write_bytes(content)
    return file


PLACE = {"crs": "EPSG:32631", "pixel_to_map": [[0.1, 0.0, 4e5], [0.0, -0.1, 5e6]]}


def _sidecar(file: Path) -> None:
    saved = read_sidecar(file)
    assert saved.images[saved.reference].to_plane is not None


def _camera(file: Path) -> None:
    assert load_camera(file).image_size[0] > 0


def _reads_or_complains(content: bytes, read: Callable[[Path], None] = _sidecar) -> None:
    with tempfile.TemporaryDirectory() as folder:
        file = _write(folder, content, "camera" if read is _camera else "out.tif.json")
        complaint = ""
        try:
            read(file)
        except InputError as error:
            complaint = str(error)
        assert not complaint or str(file) in complaint


def test_a_good_one_is_read_whole(tmp_path: Path) -> None:
    saved = read_sidecar(_write(tmp_path, json.dumps(GOOD).encode()))
    used, left_out, unread = saved.images
    assert (saved.reference, saved.record.lambda_, saved.composite) == (0, -0.2, StitchOptions().composite)
    assert (used.camera.image_size, used.camera.focal, used.camera.focal_source) == ((400, 300), 380.0, "exif")
    assert list(map(list, used.to_plane)) == _IMAGE["to_plane"]
    assert (left_out.to_plane, left_out.reason) == (None, "no overlap")
    assert unread.camera is None


@pytest.mark.parametrize(
    ("path", "value", "field"),
    [
        (("format",), "rdstitch camera", "format"),
        (("version",), 3, "version"),
        (("images", 0, "size"), "wide", "images[0].size"),
        (("images", 0, "size"), [400], "images[0].size"),
        (("images", 0, "size"), [400, 0], "images[0].size[1]"),
        (("images", 0, "size"), None, "images[0]"),
        (("images", 0, "coefficients"), [5, 0, 0], "images[0]"),
        (("images", 0, "coefficients"), [True, 0, 0], "images[0].coefficients[0]"),
        (("images", 0, "used"), 1, "images[0].used"),
        (("output", "georeference"), {**PLACE, "crs": "EPSG:9999"}, "output.georeference"),
        (("images", 0, "focal_source"), "guesswork", "images[0].focal_source"),
        (("images", 0, "to_plane"), [[1, 0, 0], [0, 1, 0], [1, 1, 0]], "images[0]"),
        (("images", 0, "to_plane"), [[1, 0, 0], [0, "1", 0], [0, 0, 1]], "images[0].to_plane[1][1]"),
        *((("images", 0, "to_plane"), [[k, 0, 0], [0, k, 0], [0, 0, k]], "images[0]") for k in (1e308, 1e-308)),
        (("images", 0, "to_plane"), [[1, 0, 1e308], [0, 1, 0], [0, 0, 1]], "images[0]"),
        (("images", 0, "center_px"), [1e308, 0.0], "images[0]"),
        (("images", 0, "focal_px"), 1e308, "images[0]"),
        (("images",), [], "images"),
        (("reference",), "b.jpg", "reference"),
        (("pairs",), None, "pairs"),
        (("output", "file"), "../out.tif", "output.file"),
        (("output", "plane_to_output"), [[0, 0, 0]] * 3, "output"),
        (("camera", "lens_covariance"), [[1, 0]], "camera.lens_covariance"),
        (("options", "composite", "blend"), "magic", "options.composite.blend"),
        (("options", "composite", "blur"), 1, "options.composite.blur"),
        (("options", "composite", "scale"), float("inf"), "options.composite.scale"),
    ],
)
def test_complaints_name_the_field(tmp_path: Path, path: tuple[str | int, ...], value: Any, field: str) -> None:
    content = json.loads(json.dumps(GOOD))
    holder = content
    for key in path[:-1]:
        holder = holder[key]
    holder[path[-1]] = value
    file = _write(tmp_path, json.dumps(content).encode())
    with pytest.raises(InputError, match=rf"^{re.escape(str(file))}: {re.escape(field)}(: | must be )"):
        read_sidecar(file)


def test_version_1_is_still_read(tmp_path: Path) -> None:
    content = json.loads(json.dumps(GOOD)) | {"version": 1}
    for image in content["images"][:2]:
        del image["coefficients"]
        image["lambda2"] = 0.01
    camera = read_sidecar(_write(tmp_path, json.dumps(content).encode())).images[0].camera
    assert camera.coefficients == (-0.2, 0.01, 0.0)


@settings(deadline=None)
@given(damaged(GOOD))
def test_damaged_fields(content: Any) -> None:
    _reads_or_complains(json.dumps(content).encode("utf-8", "surrogatepass"))


@settings(deadline=None)
@given(st.binary(max_size=200) | damaged_text(json.dumps(GOOD)))
def test_damaged_text(content: bytes) -> None:
    _reads_or_complains(content)


@pytest.mark.parametrize("content", [b"[" * 100_000, b'{"a":' * 60 + b"1" + b"}" * 60, b"\xff\xfe" * 9, b"1" * 5000])
def test_text_that_parsers_choke_on(content: bytes) -> None:
    _reads_or_complains(content)


def _good(name: str, own: bool) -> str:
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / name
        save_camera(Camera((400, 300), -0.2, focal=380.0, focal_source="file"), file)
        text = file.read_text(encoding="utf-8")
    if own:
        return text
    text = re.sub(r"(?m)^#rdstitch .*\n|^rdstitch:\n(?: +.*\n)*", "", text)
    return re.sub(r',\s*"rdstitch": \{[^}]*\}', "", text)


TEXTS = [
    _good(name, own) for name in ("c.json", "c.yml", "opencv.json", "cameras.json", "c.pto") for own in (False, True)
]
OBJECTS = [json.loads(text) for text in TEXTS if text.startswith("{")]


@pytest.mark.parametrize("text", TEXTS)
def test_good_ones_are_read(text: str, tmp_path: Path) -> None:
    (tmp_path / "camera").write_text(text, encoding="utf-8")
    assert load_camera(tmp_path / "camera").distortion == pytest.approx(-0.2, abs=1e-3)


@settings(deadline=None)
@given(st.sampled_from(OBJECTS).flatmap(damaged))
def test_damaged_camera_fields(content: object) -> None:
    _reads_or_complains(json.dumps(content).encode("utf-8", "surrogatepass"), _camera)


@settings(deadline=None)
@given(st.binary(max_size=100) | st.sampled_from(TEXTS).flatmap(damaged_text))
def test_damaged_camera_text(content: bytes) -> None:
    _reads_or_complains(content, _camera)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('{"a": ["b", {"c": "x\\u0000y"}]}', "r.json: a[1].c: holds a NUL character"),
        ('{"a": [1, NaN]}', "r.json: a[1]: expected a finite number, not nan"),
        ("[" * 60 + "]" * 60, "is nested too deeply"),
        ("{", "r.json: is not JSON: "),
    ],
)
def test_what_no_record_may_hold_is_named(text: str, message: str) -> None:
    with pytest.raises(InputError, match=re.escape(message)):
        parse_json(text, "r.json")


def test_another_wheel_of_opencv_will_do(monkeypatch: pytest.MonkeyPatch) -> None:
    def only_rdstitch(name: str) -> str:
        if name != "rdstitch":
            raise PackageNotFoundError(name)
        return "1.2"

    monkeypatch.setattr("importlib.metadata.version", only_rdstitch)
    found = versions()
    assert (found["rdstitch"], found["opencv"]) == ("1.2", cv2.__version__)
    assert all(found.values())
