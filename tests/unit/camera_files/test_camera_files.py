"""Camera files of others: λ comes back exactly, others read what is written, and what is not λ is fitted."""

import json
import math
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, get_args
from xml.etree import ElementTree

import cv2
import numpy as np
import pytest
from numpy.typing import ArrayLike

from rdstitch.arrays import FloatArray
from rdstitch.camera_files import export_note, load_camera, read_camera_file, save_camera
from rdstitch.camera_files.polynomials import fitted_polynomial, kept_at_unit, terms_in
from rdstitch.choices import CameraFormat, FocalSource
from rdstitch.errors import ArgumentError, InputError, OutputError
from rdstitch.geometry.camera import Camera
from rdstitch.geometry.lens_model import LensModel
from rdstitch.pipeline.inputs.camera_and_odometry import read_camera
from rdstitch.system.records import parse_yaml

OPENCV = ["c.yml", "c.yaml", "opencv.json", "left.opencv.json", "a.fisheye.yml"]
FOREIGN = [*OPENCV, "cameras.json", "c.pto", "camera_info.yaml", "camchain.yaml", "cameras.txt"]
NAMES = ["own.json", *FOREIGN]
CAMERAS = [
    Camera((4000, 3000), -0.21, 0.0, (2013.25, 1490.5), 3300.0, "file", 0.0012),
    Camera((640, 480), 0.08, 0.01),
    Camera((3000, 4000), 0.0, focal=2500.0, focal_source="file"),
    Camera((1280, 720), -0.45, focal=700.0, focal_source="file"),
    Camera((1280, 960), -0.53, -0.05, (650.0, 503.0), 600.0, "file", 0.003, -0.01, ((0.01,) * 5,) * 5),
]
UNOBSERVABLE = Camera((1280, 960), focal=900.0, focal_source="file", distortion_std=math.inf)
ROUND = [Camera((4000, 3000), distortion) for distortion in (-0.8, -0.25, -0.05, 0.01, 1e-5, 1e-16)]


def _points(camera: Camera) -> FloatArray:
    width, height = camera.image_size
    u, v = np.meshgrid(np.linspace(0, width - 1, 23), np.linspace(0, height - 1, 17))
    return np.column_stack([u.ravel(), v.ravel()])


def _apart(seen: FloatArray, camera: Camera) -> FloatArray:
    """Distances of points from those of the camera, pixels (N,)."""
    return np.asarray(np.linalg.norm(seen - _points(camera), axis=1))


def _rays(camera: Camera) -> FloatArray:
    """Where the camera's points look, (N, 3)."""
    straight = camera.undistort(_points(camera))
    return np.column_stack([(straight - camera.center) / camera.focal, np.ones(len(straight))])


def _stated(text: str) -> float:
    """The largest distance that a file states, pixels."""
    return float(re.findall(r"fit_largest_px\"?: ([-\d.e]+)", text)[-1])


def _saved_by_others(camera: Camera, file: Path) -> str:
    """Save a camera as anyone else would have written it."""
    save_camera(camera, file)
    text = _without_own_node(file.read_text(encoding="utf-8"))
    file.write_text(text, encoding="utf-8")
    return text


def _without_own_node(text: str) -> str:
    if text.startswith("{"):
        content = json.loads(text)
        for holder in (content, *content.values()):
            if isinstance(holder, dict):
                holder.pop("rdstitch", None)
        return json.dumps(content)
    text = re.sub(r"(?m)^#rdstitch .*\n", "", text)
    return re.sub(r"(?m)^rdstitch:\n(?: +.*\n)*", "", text)


@pytest.mark.parametrize("name", NAMES)
def test_focal_length_and_tilt_keep_their_standard_deviations(tmp_path: Path, name: str) -> None:
    camera = Camera((640, 480), -0.2, focal=512.0, focal_source="file", focal_std=13.0)
    camera = replace(camera, tilt=(0.05, -0.03), tilt_std=(0.002, 0.001))
    save_camera(camera.resized((1280, 960)), tmp_path / name)
    found = load_camera(tmp_path / name)
    assert found.focal_std == pytest.approx(26.0)
    assert found.focal_log_std == pytest.approx(13.0 / 512.0)
    assert (*found.tilt, *found.tilt_std) == pytest.approx((*camera.tilt, *camera.tilt_std))
    assert found.with_focal(600.0, "option").focal_log_std == 0.01


@pytest.mark.parametrize("source", ["guess", "exif"])
@pytest.mark.parametrize("name", NAMES)
def test_a_focal_length_that_was_guessed_is_no_calibration_by_being_saved(
    tmp_path: Path, name: str, source: FocalSource
) -> None:
    for camera in (Camera((640, 480), -0.2, focal=512.0, focal_source=source), Camera((640, 480), -0.2, focal=512.0)):
        save_camera(camera, tmp_path / name)
        found = load_camera(tmp_path / name)
        assert (found.focal_source, found.focal_log_std) == (camera.focal_source or "guess", camera.focal_log_std)


def test_a_focal_length_that_was_estimated_is_as_uncertain_as_before_it_was_saved(tmp_path: Path) -> None:
    camera = Camera((640, 480), focal=512.0, focal_source="estimate")
    for saved in (camera, replace(camera, focal_std=20.0)):
        saved.save(tmp_path / "c.json")
        assert Camera.load(tmp_path / "c.json").focal_log_std == pytest.approx(saved.focal_log_std)


def test_a_focal_length_and_a_tilt_of_which_nothing_was_found_come_back_as_such(tmp_path: Path) -> None:
    camera = Camera((640, 480), focal=512.0, focal_source="estimate", focal_std=math.inf)
    replace(camera, tilt=(0.1, 0.2), tilt_std=(math.inf, math.inf)).save(tmp_path / "c.json")
    found = Camera.load(tmp_path / "c.json")
    assert (found.focal_source, found.focal_std, found.tilt_std) == ("guess", None, None)


@pytest.mark.parametrize("camera", [*CAMERAS, UNOBSERVABLE, *ROUND])
@pytest.mark.parametrize("name", NAMES)
def test_a_camera_comes_back_as_it_was(tmp_path: Path, name: str, camera: Camera) -> None:
    save_camera(camera, tmp_path / name)
    found = read_camera_file(tmp_path / name)
    assert found.camera == camera
    assert found.fit is None


@pytest.mark.parametrize("camera", CAMERAS[:3])
@pytest.mark.parametrize("name", FOREIGN)
def test_the_lens_of_a_foreign_file_is_fitted_with_a_residual(tmp_path: Path, name: str, camera: Camera) -> None:
    assert "lambda" not in _saved_by_others(camera, tmp_path / name)
    found = read_camera_file(tmp_path / name)
    assert found.camera.image_size == camera.image_size
    np.testing.assert_allclose(found.camera.center, camera.center, atol=1e-6)
    assert found.camera.focal == pytest.approx(camera.with_guessed_focal().focal, rel=1e-6)
    # λ alone stands for λ and μ of the second camera.
    assert found.camera.nearest_distortion == pytest.approx(camera.distortion + camera.distortion2, abs=0.006)
    # The residual is what a user sees: px between the two lenses. The file's own model is off by some px too.
    apart = _apart(found.camera.distort(camera.undistort(_points(camera))), camera)
    assert apart.max() < found.fit.largest + 0.002 * camera.scale
    assert found.fit.rms <= found.fit.largest
    assert found.fit.largest < 0.004 * camera.scale


def _projected(matrix: FloatArray, values: ArrayLike, rays: FloatArray, *, fisheye: bool) -> FloatArray:
    """Where OpenCV sees rays (N, 3)."""
    none, d = np.zeros(3), np.asarray(values)
    if fisheye:
        seen = cv2.fisheye.projectPoints(rays[None], none, none, matrix, d)[0]
    else:
        seen = cv2.projectPoints(rays, none, none, matrix, d)[0]
    return np.asarray(seen, dtype=np.float64).reshape(-1, 2)


Parsed = tuple[list[float], list[float], str]
"""fx, fy, cx, cy; coefficients; and the name of the model."""


def _numbers(values: list[Any]) -> list[float]:
    return [float(value) for value in values]


def _opencv(text: str) -> Parsed:
    """Of OpenCV's files, and of ROS's, which look alike."""
    record = json.loads(text) if text.startswith("{") else parse_yaml(text, "c.yml")
    fx, _, cx, _, fy, cy = _numbers(record["camera_matrix"]["data"])[:6]
    model = "equi" if "fisheye_model" in record else record.get("distortion_model", "opencv")
    return [fx, fy, cx, cy], _numbers(record["distortion_coefficients"]["data"]), model


def _camera_chain(text: str) -> Parsed:
    record = parse_yaml(text, "camchain.yaml")["cam0"]
    values = _numbers(record["distortion_coeffs"])
    return _numbers(record["intrinsics"]), values, record["distortion_model"]


def _colmap(text: str) -> Parsed:
    line = text.splitlines()[-1].split()
    values = [float(value) for value in line[4:]]
    return [*values[:2], values[2] - 0.5, values[3] - 0.5], values[4:], line[1]


def _opendronemap(text: str) -> Parsed:
    (lens,) = json.loads(text).values()
    width, height = lens["width"], lens["height"]
    longer = max(width, height)
    focals = [lens["focal_x"] * longer, lens["focal_y"] * longer]
    center = [(width - 1) / 2 + lens["c_x"] * longer, (height - 1) / 2 + lens["c_y"] * longer]
    fisheye = lens["projection_type"] == "fisheye_opencv"
    names = ("k1", "k2", "k3", "k4") if fisheye else ("k1", "k2", "p1", "p2", "k3")
    return [*focals, *center], [lens[name] for name in names], "equi" if fisheye else "brown"


PARSERS = dict.fromkeys(("c.yml", "opencv.json", "camera_info.yaml", "fisheye.yml"), _opencv)
PARSERS |= {"cameras.json": _opendronemap, "camchain.yaml": _camera_chain, "cameras.txt": _colmap}


@pytest.mark.parametrize("camera", [CAMERAS[0], CAMERAS[3], CAMERAS[4]])
@pytest.mark.parametrize(("name", "parse"), PARSERS.items())
def test_exports_are_off_as_stated(tmp_path: Path, name: str, camera: Camera, parse: Callable[[str], Parsed]) -> None:
    save_camera(camera, tmp_path / name)
    text = (tmp_path / name).read_text(encoding="utf-8")
    (fx, fy, cx, cy), values, model = parse(text)
    matrix = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
    fisheye = model in ("equi", "equidistant", "OPENCV_FISHEYE")
    apart, stated = _apart(_projected(matrix, values, _rays(camera), fisheye=fisheye), camera).max(), _stated(text)
    assert 0.3 * stated < apart < 1.05 * stated + 1e-6
    assert stated < 1.0


@pytest.mark.parametrize("name", ["fisheye.yml", "c.yml"])
def test_a_strong_lens_of_others_takes_more_than_one_coefficient(tmp_path: Path, name: str) -> None:
    camera = CAMERAS[4]
    _saved_by_others(camera, tmp_path / name)
    found = read_camera_file(tmp_path / name)
    assert found.fit.largest < 0.2
    assert found.camera.higher
    apart = _apart(found.camera.distort(camera.undistort(_points(camera))), camera)
    assert apart.max() < 0.3


def test_what_opencv_writes_is_read(tmp_path: Path) -> None:
    matrix = np.array([[700.0, 0, 320], [0, 703.0, 242], [0, 0, 1]])
    coefficients = np.array([[-0.25, 0.08, 0.0004, -0.0002, -0.01]])
    for name in ("c.yml", "vector.yml", "c.json", "c.xml"):
        storage = cv2.FileStorage(str(tmp_path / name), cv2.FILE_STORAGE_WRITE)
        storage.write("calibration_time", "Sat Nov 21 2026")
        storage.write("image_width", 640)
        storage.write("image_height", 480)
        storage.write("camera_matrix", matrix)
        storage.write("distortion_coefficients", coefficients[0] if name == "vector.yml" else coefficients)
        storage.release()
    rows = f"image_width: 640\nimage_height: 480\nK: {matrix.tolist()}\nD: {coefficients.tolist()}\n"
    (tmp_path / "rows.yml").write_text(rows)
    nested = {"rows": 3, "cols": 3, "data": matrix.tolist()}
    (tmp_path / "nested.yml").write_text(rows.replace(str(matrix.tolist()), json.dumps(nested)))
    found, *same = (
        read_camera_file(tmp_path / name) for name in ("c.yml", "vector.yml", "c.json", "rows.yml", "nested.yml")
    )
    assert same == [found, found, found, found]
    with pytest.raises(InputError, match=r"c\.xml: is OpenCV's in XML, .* as YAML or JSON"):
        load_camera(tmp_path / "c.xml")
    assert found.kind == "OpenCV"
    assert 0.0 < found.fit.rms < found.fit.largest < 4.0
    apart = _apart(_projected(matrix, coefficients[0], _rays(found.camera), fisheye=False), found.camera)
    assert np.sqrt(np.mean(apart**2)) == pytest.approx(found.fit.rms, rel=0.35)


@pytest.mark.parametrize("count", [4, 5, 8])
def test_brown_is_what_opencv_calls_so(count: int) -> None:
    k = np.random.default_rng(count).normal(0.0, 0.05, count)
    matrix = np.array([[700.0, 0, 320], [0, 720.0, 242], [0, 0, 1]])
    lens = LensModel((700.0, 720.0), (320.0, 242.0), tuple(k.tolist()))
    points = _points(Camera((640, 480)))
    rays = np.column_stack([(points - lens.center) / lens.mean_focal, np.ones(len(points))])
    np.testing.assert_allclose(lens.distort(points), _projected(matrix, k, rays, fisheye=False), atol=1e-9)


@pytest.mark.parametrize(
    ("camera", "projection"),
    [(replace(CAMERAS[0], distortion=-0.02), 0), (CAMERAS[0], 3), (CAMERAS[3], 3), (CAMERAS[4], 3)],
)
def test_hugin_means_what_its_manual_says(tmp_path: Path, camera: Camera, projection: int) -> None:
    save_camera(camera, tmp_path / "c.pto")
    text = (tmp_path / "c.pto").read_text(encoding="utf-8")
    line = next(line for line in text.splitlines() if line[:2] == "i ")
    a, b, c, d, e, v = (float(re.findall(rf" {name}(-?[\d.e-]+)", line)[0]) for name in "abcdev")
    # r_src = (a r³ + b r² + c r + 1 - a - b - c) r, in halves of the shorter side; v spans the width.
    # A fisheye, f3, has angles where a rectilinear lens has tangents.
    assert f" f{projection} " in line
    (width, height), unit = camera.image_size, min(camera.image_size) / 2
    ideal = (camera.undistort(_points(camera)) - camera.center) / camera.focal
    half_view = np.tan(np.radians(v) / 2)
    if projection:
        tangent = np.linalg.norm(ideal, axis=1, keepdims=True)
        ideal, half_view = ideal * np.arctan(tangent) / np.maximum(tangent, 1e-12), np.radians(v) / 2
    ideal *= width / 2 / half_view / unit
    r = np.linalg.norm(ideal, axis=1, keepdims=True)
    center = (width - 1) / 2 + d, (height - 1) / 2 + e
    seen = ideal * (a * r**3 + b * r**2 + c * r + 1 - a - b - c) * unit + center
    apart, stated = _apart(seen, camera).max(), _stated(text)
    assert 0.3 * stated < apart < 1.05 * stated + 1e-6


@pytest.mark.parametrize(("projection", "view"), [(2, 190.0), (3, 200.0)])
def test_hugins_fisheyes_see_more_than_half_of_all(tmp_path: Path, projection: int, view: float) -> None:
    (tmp_path / "c.pto").write_text(f'i w2000 h2000 f{projection} v{view} a0 b0 c0 d0 e0 n"a.jpg"\n', encoding="utf-8")
    camera = load_camera(tmp_path / "c.pto")
    assert camera.focal == pytest.approx(1000.0 / np.radians(view / 2))
    # An equidistant fisheye: a ray 60 degrees off the axis is measured at 60/(v/2) of the way to the border.
    straight = camera.center + np.array([[camera.focal * np.tan(np.radians(60.0)), 0.0]])
    seen = (camera.lens_model or camera).distort(straight)
    np.testing.assert_allclose(seen - camera.center, [[1000.0 * 60.0 / (view / 2), 0.0]], atol=0.1)


def test_hugins_rectilinear_lenses_see_less_than_half_of_all(tmp_path: Path) -> None:
    (tmp_path / "c.pto").write_text('i w2000 h2000 f0 v190 n"a.jpg"\n', encoding="utf-8")
    with pytest.raises(InputError, match="v: a rectilinear lens sees less than 180 degrees"):
        load_camera(tmp_path / "c.pto")


def test_opendronemap_of_others(tmp_path: Path) -> None:
    entry = {"projection_type": "perspective", "width": 4000, "height": 3000, "focal": 0.85, "k1": -0.02, "k2": 0.004}
    file = tmp_path / "cameras.json"
    file.write_text(json.dumps({"v2 dji fc300x 4000 3000 perspective 0.55": entry}), encoding="utf-8")
    found = read_camera_file(file)
    assert found.kind == "OpenDroneMap"
    assert found.camera.focal == pytest.approx(3400.0)
    assert found.camera.center == (1999.5, 1499.5)
    # Near the centre r_d = r_u (1 + k1 r²), and r_u = r_d / (1 + λ r_d²): λ is about k1 in focal lengths.
    assert found.camera.distortion_focal == pytest.approx(-0.02, abs=0.004)
    entry |= {"projection_type": "fisheye", "focal": 0.4}
    of_opencv = entry | {"projection_type": "fisheye_opencv", "k3": 0.0, "k4": 0.0}
    cameras = []
    for fisheye in (entry, of_opencv):
        file.write_text(json.dumps({"one": fisheye}), encoding="utf-8")
        cameras.append(load_camera(file))
    assert cameras[0] == cameras[1]
    file.write_text(json.dumps({"one": entry, "two": entry}), encoding="utf-8")
    with pytest.raises(InputError, match="2 cameras"):
        load_camera(file)


@pytest.mark.parametrize(
    ("model", "parameters"),
    [
        ("SIMPLE_DIVISION", [1500.0, 810.5, 590.5, -0.2]),
        ("DIVISION", [1500.0, 1500.0, 810.5, 590.5, 0.1]),
        ("SIMPLE_FISHEYE", [900.0, 810.5, 590.5]),
        ("FISHEYE", [900.0, 905.0, 810.5, 590.5]),
    ],
)
def test_cameras_of_colmap_4_mean_what_it_says(tmp_path: Path, model: str, parameters: list[float]) -> None:
    pycolmap = pytest.importorskip("pycolmap", "4.0")
    numbers = " ".join(map(repr, parameters))
    (tmp_path / "cameras.txt").write_text(f"1 {model} 1600 1200 {numbers}\n", encoding="utf-8")
    camera = load_camera(tmp_path / "cameras.txt")
    lens, points = camera.lens_model or camera, _points(camera)
    theirs = pycolmap.Camera(model=model, width=1600, height=1200, params=parameters).cam_from_img(points + 0.5)
    # What is within 1/32 pixel of a division model is read as that.
    tolerance = 1e-6 if "DIVISION" in model else 1.0 / 32.0
    np.testing.assert_allclose(lens.distort(theirs * camera.focal + camera.center), points, atol=tolerance)


def test_a_division_model_of_colmap_has_square_pixels(tmp_path: Path) -> None:
    (tmp_path / "cameras.txt").write_text("1 DIVISION 1600 1200 1500 1510 810.5 590.5 -0.2\n", encoding="utf-8")
    with pytest.raises(InputError, match="needs one focal length"):
        load_camera(tmp_path / "cameras.txt")


@pytest.mark.parametrize(
    ("model", "values"),
    [
        ("SIMPLE_PINHOLE", [1500.0]),
        ("SIMPLE_RADIAL", [1500.0, -0.08]),
        ("RADIAL", [1500.0, -0.08, 0.01]),
        ("OPENCV", [1500.0, 1500.1, -0.08, 0.01, 1e-05, -1e-05]),
        ("FULL_OPENCV", [1500.0, 1500.1, 0.5, 0.02, 0.0, 0.0, 0.001, 0.6, 0.08, 0.002]),
        ("RADIAL_FISHEYE", [1500.0, -0.02, 0.004]),
        ("OPENCV_FISHEYE", [1500.0, 1500.1, -0.02, 0.004, -1e-3, 1e-4]),
    ],
)
def test_cameras_of_colmap_and_kalibr_mean_what_opencv_says(tmp_path: Path, model: str, values: list[float]) -> None:
    size, fisheye = (1600, 1200), "FISHEYE" in model
    focals = values[: 2 if model in ("OPENCV", "FULL_OPENCV", "OPENCV_FISHEYE") else 1]
    k = values[len(focals) :]
    written = [*focals, 810.5, 590.5, *k]
    (tmp_path / "cameras.txt").write_text(
        f"# Camera list\n#   CAMERA_ID, MODEL, …\n7 {model} 1600 1200 {' '.join(map(repr, written))}\n",
        encoding="utf-8",
    )
    found = [read_camera_file(tmp_path / "cameras.txt")]
    padded = [*k, *[0.0] * (4 - len(k))]
    if len(padded) == 4:
        (tmp_path / "rig-camchain.yaml").write_text(
            "cam0:\n  T_cam_imu:\n  - [1.0, 0.0, 0.0, 0.0]\n  - [0.0, 1.0, 0.0, 0.0]\n  cam_overlaps: []\n"
            f"  camera_model: pinhole\n  distortion_coeffs: {padded}\n"
            f"  distortion_model: {'equi' if fisheye else 'radtan'}\n"
            f"  intrinsics: [{focals[0]}, {focals[-1]}, 810.0, 590.0]\n  resolution: [1600, 1200]\n"
            "  rostopic: /cam0/image_raw\n",
            encoding="utf-8",
        )
        found.append(read_camera_file(tmp_path / "rig-camchain.yaml"))
    matrix = np.array([[focals[0], 0.0, 810.0], [0.0, focals[-1], 590.0], [0.0, 0.0, 1.0]])
    for file, kind in zip(found, ("COLMAP", "Kalibr"), strict=False):
        assert file.kind == kind
        assert file.camera.image_size == size
        assert file.camera.focal == pytest.approx(np.sqrt(focals[0] * focals[-1]))
        assert file.camera.center == pytest.approx((810.0, 590.0))
        assert _apart(_projected(matrix, padded, _rays(file.camera), fisheye=fisheye), file.camera).max() < 0.15


@pytest.mark.parametrize(
    ("text", "named"),
    [
        ("1 THIN_PRISM_FISHEYE 640 480 500 500 320 240\n", "MODEL"),
        ("1 RADIAL 640 480 500 320 240 0.1\n", "PARAMS"),
        ("1 RADIAL 640 480 -500 320 240 0.1 0\n", "positive"),
        ("1 PINHOLE 640 480 500 500 320 240\n2 PINHOLE 640 480 500 500 320 240\n", "2 cameras"),
        ("cam0:\n  camera_model: omni\n", "cam0.camera_model"),
        ("cam0:\n  camera_model: pinhole\n  distortion_model: fov\n", "cam0.distortion_model"),
        ("cam0:\n  camera_model: pinhole\ncam1:\n  camera_model: pinhole\n", "2 cameras"),
        ("no camera at all\n", "file: is no camera file of a known format"),
        ("[1, 2]\n", "file: is no camera file of a known format"),
        ('{"a": 1}', "file: is no camera file of a known format"),
        ("<html/>", "file: is XML, but no lens"),
    ],
)
def test_what_others_know_and_rdstitch_does_not_is_named(tmp_path: Path, text: str, named: str) -> None:
    (tmp_path / "file").write_text(text, encoding="utf-8")
    with pytest.raises(InputError, match=named):
        load_camera(tmp_path / "file")


@pytest.mark.parametrize(
    ("name", "old", "new", "named"),
    [
        ("c.yml", "cols: 8", "cols: 4", "distortion_coefficients"),
        ("c.yml", "rows: 3", "rows: x", "camera_matrix.rows"),
        ("c.yml", "camera_matrix:", "camera_matrix: hello\nother:", "camera_matrix: expected rows, cols and data, or"),
        ("c.yml", "image_width:", 'distortion_model: ""\nimage_width:', "a camera that is not calibrated"),
        ("c.yml", "image_width: 4000\n", "", "image_width"),
        ("c.yml", "3300.0, 0.0, 2013.25", "3300.0, 0.5, 2013.25", "camera_matrix"),
        ("c.yml", "image_height: 3000", "image_height: 3000\n\tx", "line 5"),
        ("opencv.json", '"image_height": 3000', '"image_height": 0', "image_height"),
        ("opencv.json", '"image_height": 3000', '"image_height": 1' + 400 * "0", "image_height"),
        ("cameras.json", '"width": 4000', '"width": 1' + 400 * "0", "width"),
        ("c.pto", "i w4000", "i w4e30", "w: "),
        ("cameras.json", '"focal_x": ', '"focal_x": 1e308, "x": ', "focal length"),
        ("cameras.json", '"fisheye_opencv",', '"fisheye62",', "projection_type"),
        ("cameras.json", '"focal_x"', '"focal_z"', "focal_x"),
        ("cameras.json", '"k1": ', '"k1": 1', "folds"),
        ("c.pto", " f3 v", " f4 v", "fisheye"),
        ("c.pto", "i w4000", "i w40.5", "w: "),
        ("c.pto", "\ni ", "\nj ", "image line"),
    ],
)
def test_complaints_name_file_and_field(tmp_path: Path, name: str, old: str, new: str, named: str) -> None:
    text = _saved_by_others(CAMERAS[0], tmp_path / name)
    if new == '"k1": 1':
        text = re.sub(r'"k1": [-\d.e]+', '"k1": -30.0', text)
    else:
        assert old in text
        text = text.replace(old, new)
    (tmp_path / name).write_text(text, encoding="utf-8")
    with pytest.raises(InputError, match=f"{re.escape(str(tmp_path / name))}.*{re.escape(named)}"):
        load_camera(tmp_path / name)


@pytest.mark.parametrize("name", ["camera", "camera.csv", "camera.yml.txt"])
def test_a_name_that_says_no_format_is_refused(tmp_path: Path, name: str) -> None:
    with pytest.raises(OutputError, match="camera file"):
        save_camera(CAMERAS[0], tmp_path / name)
    assert list(tmp_path.iterdir()) == []


def test_a_camera_saves_and_loads_its_own_format(tmp_path: Path) -> None:
    lens = Camera((640, 480), distortion=-0.2, focal=520.0, focal_source="file")
    lens.save(tmp_path / "method.json")
    save_camera(lens, tmp_path / "function.json")
    assert (tmp_path / "method.json").read_bytes() == (tmp_path / "function.json").read_bytes()
    assert Camera.load(tmp_path / "method.json") == load_camera(tmp_path / "function.json") == lens
    # It says which files are not its own.
    with pytest.raises(OutputError, match=r"camera\.yml: unknown file type .* use one of \.json"):
        lens.save(tmp_path / "camera.yml")
    with pytest.raises(OutputError, match="does not exist"):
        lens.save(tmp_path / "missing" / "camera.json")
    with pytest.raises(InputError, match="cannot be read"):
        Camera.load(tmp_path / "camera.json")
    save_camera(lens, tmp_path / "camera.yml")
    with pytest.raises(InputError, match=r"camera\.yml: is not JSON"):
        Camera.load(tmp_path / "camera.yml")


def _opencv_file(
    path: Path, focal: tuple[float, float], coefficients: list[float], size: tuple[int, int] | None, mark: str = ""
) -> Path:
    """What somebody else's script writes, for images of 1280 x 960 pixels."""
    (fx, fy), count = focal, len(coefficients)
    sides = "" if size is None else f"image_width: {size[0]}\nimage_height: {size[1]}\n"
    path.write_text(
        f"%YAML:1.0\n---\n{sides}{mark}camera_matrix: !!opencv-matrix\n   rows: 3\n   cols: 3\n   dt: d\n"
        f"   data: [{fx}, 0., 641., 0., {fy}, 478., 0., 0., 1.]\n"
        f"distortion_coefficients: !!opencv-matrix\n   rows: {count}\n   cols: 1\n   dt: d\n   data: {coefficients}\n"
    )
    return path


FISHEYES = {
    "gopro": (582.0, [-0.018, 0.019, -0.03, 0.014]),
    "tutorial": (558.0, [-0.0014, -0.0033, 0.0051, -0.0026]),
    "wide": (478.0, [0.0034, 0.0007, -0.0020, 0.0002]),
    "narrow": (780.0, [-0.0127, 0.0198, -0.0245, 0.0093]),
}
BROWNS = {
    "strong": (590.0, [-0.25, 0.06, 0.0005, 0.001]),
    "webcam": (1280.0, [0.05, -0.2, 0.01, -0.005]),
    "ultra-wide, nearly straight": (640.0, [-0.05, 0.01, 0.0, 0.0]),
    "none": (500.0, [0.0, 0.0, 0.0, 0.0]),
}


@pytest.mark.parametrize("name", FISHEYES)
def test_coefficients_of_a_fisheye_without_a_mark_are_refused_with_the_remedy(tmp_path: Path, name: str) -> None:
    focal, k = FISHEYES[name]
    bare = _opencv_file(tmp_path / "bare.yml", (focal, focal), k, (1280, 960))
    with pytest.raises(InputError, match=r"bare\.yml: distortion_coefficients: .*cv2\.fisheye.* \"fisheye_model: 1\""):
        load_camera(bare)
    marked = _opencv_file(tmp_path / "marked.yml", (focal, focal), k, (1280, 960), "fisheye_model: 1\n")
    assert load_camera(marked).distortion < -0.2


@pytest.mark.parametrize("name", BROWNS)
def test_four_coefficients_of_usual_lenses_need_no_mark(tmp_path: Path, name: str) -> None:
    focal, k = BROWNS[name]
    found = load_camera(_opencv_file(tmp_path / "c.yml", (focal, focal), k, (1280, 960)))
    marked = _opencv_file(tmp_path / "m.yml", (focal, focal), k, (1280, 960), "distortion_model: plumb_bob\n")
    assert found == load_camera(marked)


@pytest.mark.parametrize("reference", ["[*{0},*{0},*{0},*{0}]", "{{<<: [*{0},*{0},*{0},*{0}]}}"])
def test_a_few_lines_of_yaml_do_not_become_millions(tmp_path: Path, reference: str) -> None:
    """4 to the power of 30 objects: without end where each is visited."""
    lines = ["a0: &a0 {x: [1]}", *(f"a{k + 1}: &a{k + 1} {reference.format(f'a{k}')}" for k in range(30))]
    (tmp_path / "laugh.yaml").write_text("\n".join(lines))
    with pytest.raises(InputError, match=r"laugh\.yaml"):
        load_camera(tmp_path / "laugh.yaml")
    # An alias is what it stands for.
    assert parse_yaml("a: &one [1.0, 2.0]\nb: *one\n", "c.yaml") == {"a": [1.0, 2.0], "b": [1.0, 2.0]}


def test_yaml_may_be_written_in_any_style(tmp_path: Path) -> None:
    usual = load_camera(_opencv_file(tmp_path / "c.yml", (900.0, 900.0), [-0.2, 0.05, 0.0, 0.0, 0.0], (1280, 960)))
    rows = "\n".join(f"    - {value}" for value in ("9e2", "0", "641.", "0", "9e+02", "478.", "0", "0", "1"))
    (tmp_path / "block.yaml").write_text(
        f"image_width: 1280  # pixels\nimage_height: 960\ncamera_matrix:\n    rows: 3\n    cols: 3\n    data:\n{rows}\n"
        "distortion_coefficients: {rows: 1, cols: 5, data: [-2e-1, 5.0e-02, 0, 0, 0]}\n"
    )
    assert load_camera(tmp_path / "block.yaml") == usual


def test_images_of_a_region_of_interest_are_of_a_part_of_the_sensor(tmp_path: Path) -> None:
    printed = (
        "height: 480\nwidth: 640\ndistortion_model: plumb_bob\nd: [-0.2, 0.05, 0, 0, 0]\n"
        "k: [400, 0, 319.5, 0, 400, 239.5, 0, 0, 1]\nroi: "
    )
    for roi in ("{x_offset: 0, y_offset: 0, width: 0, height: 0, do_rectify: false}", "[10, 10, 620, 460]"):
        (tmp_path / "whole.yaml").write_text(printed + roi)
        assert load_camera(tmp_path / "whole.yaml").image_size == (640, 480)
    (tmp_path / "region.yaml").write_text(printed + "{x_offset: 200, y_offset: 60, width: 400, height: 300}")
    whole, region = (load_camera(tmp_path / f"{name}.yaml") for name in ("whole", "region"))
    assert region.image_size == (400, 300)
    shown, offset = np.array([[0.0, 0.0], [399.0, 299.0], [50.0, 200.0]]), np.array([200.0, 60.0])
    np.testing.assert_allclose(region.undistort(shown) + offset, whole.undistort(shown + offset), atol=1.0)


def test_that_a_lens_was_fitted_is_no_warning(tmp_path: Path) -> None:
    file = _opencv_file(tmp_path / "c.yml", (900.0, 900.0), [-0.2, 0.05, 0.0, 0.0, 0.0], (1280, 960))
    (message,) = read_camera(file)[1]
    assert "was fitted to the OpenCV lens model, rms 0." in message.text
    assert message.severity == "note"


def test_a_file_without_a_size_takes_that_of_the_images(tmp_path: Path) -> None:
    file = _opencv_file(tmp_path / "c.yml", (900.0, 900.0), [-0.2, 0.05, 0.0, 0.0, 0.0], None)
    with pytest.raises(InputError, match="image_width"):
        load_camera(file)
    assert load_camera(file, image_size=(1280, 960)).image_size == (1280, 960)
    with pytest.raises(InputError, match=r"principal point 641, 478 is not that of images of 640 x 480"):
        load_camera(file, image_size=(640, 480))


FITTED = [
    (Camera((1280, 960), -0.02, focal=1100.0), "poly5"),
    (Camera((1280, 960), -0.234, focal=1000.0, center=(650.0, 470.0)), "ptlens"),
    (Camera((1000, 750), -0.5, focal=500.0), "poly5"),
    (Camera((960, 1280), 0.03, focal=1100.0), "poly5"),
    (Camera((640, 480), 0.0, focal=600.0), "poly3"),
]
KNOWN = """<?xml version="1.0"?><!DOCTYPE lensdatabase SYSTEM "lensfun-database.dtd">
<lensdatabase><lens><maker>M</maker><model>L</model><mount>X</mount><cropfactor>1.5</cropfactor><calibration>
<distortion model="poly3" focal="20" k1="-0.02"/></calibration></lens></lensdatabase>"""


def _distorted(text: str, camera: Camera, points: FloatArray) -> FloatArray:
    """Pixels (N, 2) without distortion to measured ones, by the formulas of lensfun's documentation."""
    lens = ElementTree.fromstring(text).find("lens")
    values, center = lens.find("calibration/distortion"), lens.find("center")
    k = {name: float(value) for name, value in values.attrib.items() if name != "model"}
    (width, height), unit = camera.image_size, (min(camera.image_size) - 1) / 2
    middle = np.array([width - 1, height - 1]) / 2 + unit * np.array([float(center.attrib[axis]) for axis in "xy"])
    focal = k["focal"] * np.hypot(width, height) / np.hypot(36.0, 24.0)
    radius = np.linalg.norm(points - middle, axis=1)
    r = radius / unit if lens.findtext("type") == "rectilinear" else focal * np.arctan(radius / focal) / unit
    if values.attrib["model"] == "poly3":
        bent = r * (1 - k["k1"] + k["k1"] * r**2)
    elif values.attrib["model"] == "poly5":
        bent = r * (1 + k["k1"] * r**2 + k["k2"] * r**4)
    else:
        bent = r * (k["a"] * r**3 + k["b"] * r**2 + k["c"] * r + 1 - k["a"] - k["b"] - k["c"])
    result: FloatArray = middle + (points - middle) * (bent * unit / np.maximum(radius, 1e-9))[:, None]
    return result


@pytest.mark.parametrize(("camera", "model"), FITTED)
def test_what_is_written_is_the_lens_within_what_is_stated(camera: Camera, model: str, tmp_path: Path) -> None:
    save_camera(camera, tmp_path / "a.xml")
    text = (tmp_path / "a.xml").read_text(encoding="utf-8")
    assert f'model="{model}"' in text
    (note,) = export_note(camera, tmp_path / "a.xml")
    (stated,) = re.findall(r"at most (\d+\.\d+) pixels", note)
    width, height = camera.image_size
    x, y = np.meshgrid(np.linspace(0, width - 1, 23), np.linspace(0, height - 1, 19))
    measured = np.column_stack([x.ravel(), y.ravel()])
    straight = camera.undistort(measured)
    # The undistorted image is larger by a factor: where its scale is kept at r = 1.
    sizes = np.linspace(0.9, 1.1, 4001)
    middle = np.array(camera.center)
    off = [np.abs(_distorted(text, camera, middle + s * (straight - middle)) - measured).max() for s in sizes]
    assert min(off) < float(stated) + 0.05
    assert load_camera(tmp_path / "a.xml").coefficients == camera.coefficients


@pytest.mark.parametrize(("camera", "_model"), FITTED)
def test_what_others_wrote_is_read(camera: Camera, _model: str, tmp_path: Path) -> None:
    save_camera(camera, tmp_path / "a.xml")
    text = (tmp_path / "a.xml").read_text(encoding="utf-8")
    (tmp_path / "b.xml").write_text(text[text.index("<lensdatabase") :], encoding="utf-8")
    found = read_camera_file(tmp_path / "b.xml", lambda: camera.image_size)
    assert found.kind == "lensfun"
    assert found.fit.largest < 0.2
    assert found.camera.nearest_distortion == pytest.approx(camera.distortion, abs=2e-4)
    assert found.camera.center == pytest.approx(camera.center, abs=1e-3)
    assert found.camera.focal == pytest.approx(camera.focal, rel=1e-4)


def test_a_profile_of_the_database(tmp_path: Path) -> None:
    (tmp_path / "a.xml").write_text(KNOWN, encoding="utf-8")
    camera = load_camera(tmp_path / "a.xml", (3000, 2000))
    assert camera.focal == pytest.approx(20 * 1.5 / np.hypot(36, 24) * np.hypot(3000, 2000) * 1.02)
    assert camera.nearest_distortion < -0.03


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("<lensdatabase>", '<!DOCTYPE a [<!ENTITY b "c">]><lensdatabase>', "defines entities"),
        ("</lensdatabase>", "", "is not XML"),
        ('model="poly3"', 'model="acm"', "known here, not rectilinear acm"),
        ("<cropfactor>", "<type>thoby</type><cropfactor>", "known here, not thoby poly3"),
        ('focal="20"', 'focal="x"', "poly3: could not convert"),
        ('focal="20"', 'focal="0"', "expected a positive focal length"),
        ('k1="-0.02"', 'k1="2"', "must leave a scale above 0"),
        (
            "</calibration>",
            '<distortion model="poly3" focal="30" k1="0"/></calibration>',
            "1 lenses with 2 distortions",
        ),
    ],
)
def test_what_is_wrong_is_named(old: str, new: str, message: str, tmp_path: Path) -> None:
    text = KNOWN[KNOWN.index("<lensdatabase") :]
    assert old in text
    (tmp_path / "a.xml").write_text(text.replace(old, new), encoding="utf-8")
    with pytest.raises(InputError, match=r"a\.xml: .*" + re.escape(message)):
        load_camera(tmp_path / "a.xml", (640, 480))


@pytest.mark.parametrize("powers", [(4, 3, 2), (3,), (3, 5)])
@pytest.mark.parametrize("distortion", [0.0123, -0.0123, -0.3])
def test_a_lens_of_any_sign_keeps_its_scale_at_the_unit_radius(distortion: float, powers: tuple[int, ...]) -> None:
    camera = Camera((3264, 2448), distortion=distortion, focal=3117.3)
    lens, _ = fitted_polynomial(camera, powers)
    scale, terms = kept_at_unit(terms_in(lens, 1224.0, powers), powers)
    assert scale * (1.0 - sum(terms)) == pytest.approx(1.0)
    assert 0.5 < scale < 2.0


@pytest.mark.parametrize("camera_format", [name for name in get_args(CameraFormat) if name != "auto"])
def test_a_format_needs_no_name(camera_format: CameraFormat, tmp_path: Path) -> None:
    save_camera(CAMERAS[0], tmp_path / "lens", camera_format)
    assert load_camera(tmp_path / "lens").distortion == pytest.approx(CAMERAS[0].distortion, abs=0.01)


def test_an_unknown_format_is_refused_and_the_known_are_named(tmp_path: Path) -> None:
    unknown: Any = "opencv-xml"
    with pytest.raises(ArgumentError, match=r"camera_format must be one of auto, rdstitch, .*, not 'opencv-xml'"):
        save_camera(CAMERAS[0], tmp_path / "lens.json", unknown)


BROWN = [-0.2, 0.03, 0.003, 0.002], [-0.2, 0.03, 0.003, 0.002, 0.01], [-0.2, 0.05, 0, 0, 0.01, 0.02, 0.003, 0.001]


@pytest.mark.parametrize("coefficients", BROWN)
@pytest.mark.parametrize(("name", "parse"), PARSERS.items())
def test_a_calibration_is_written_with_all_that_the_format_has(
    tmp_path: Path, coefficients: list[float], name: str, parse: Callable[[str], Parsed]
) -> None:
    fy = 1010.0
    camera = load_camera(_opencv_file(tmp_path / "given.yml", (1000.0, fy), coefficients, (1280, 960)))
    save_camera(camera, tmp_path / name)
    text = (tmp_path / name).read_text(encoding="utf-8")
    (fx, written_fy, cx, cy), values, model = parse(text)
    fisheye = model in ("equi", "equidistant", "OPENCV_FISHEYE")
    points = _points(camera)
    straight = (camera.lens_model or camera).undistort(points)
    rays = np.column_stack([(straight - camera.center) / np.sqrt(1000.0 * fy), np.ones(len(points))])
    matrices = [
        np.array([[a, 0, c], [0, b, d], [0, 0, 1.0]]) for a, b, c, d in ((1000, fy, 641, 478), (fx, written_fy, cx, cy))
    ]
    given = _projected(matrices[0], coefficients, rays, fisheye=False)
    apart = np.linalg.norm(_projected(matrices[1], values, rays, fisheye=fisheye) - given, axis=1).max()
    assert apart < 1.05 * _stated(text) + 1e-6
    if len(coefficients) <= {"camchain.yaml": 4, "fisheye.yml": 0, "cameras.json": 5}.get(name, 8):
        assert apart < 1e-9
    assert load_camera(tmp_path / name) == camera


@pytest.mark.parametrize("coefficients", BROWN)
@pytest.mark.parametrize("name", ["c.pto", "a.xml"])
def test_a_radial_format_states_what_it_cannot_hold(tmp_path: Path, coefficients: list[float], name: str) -> None:
    camera = load_camera(_opencv_file(tmp_path / "given.yml", (1000.0, 1010.0), coefficients, (1280, 960)))
    (note,) = export_note(camera, tmp_path / name)
    (stated,) = re.findall(r"at most (\d+\.\d+) pixels", note)
    assert float(stated) > 2.0


def test_numbers_without_a_dot_are_read_from_older_files(tmp_path: Path) -> None:
    save_camera(Camera((4000, 3000), -0.05), tmp_path / "c.yml")
    text = (tmp_path / "c.yml").read_text(encoding="utf-8")
    (tmp_path / "c.yml").write_text(re.sub(r"lambda_px: .*", "lambda_px: -8e-09", text), encoding="utf-8")
    assert load_camera(tmp_path / "c.yml") == Camera((4000, 3000), -0.05)
