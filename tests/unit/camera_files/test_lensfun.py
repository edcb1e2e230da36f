"""lensfun's profiles: what is written is the lens by lensfun's own formulas, and what others wrote is read."""

import re
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest

from rdstitch.arrays import FloatArray
from rdstitch.camera import Camera
from rdstitch.camera_files import export_note, load_camera, read_camera_file, save_camera
from rdstitch.errors import InputError

CAMERAS = [
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


@pytest.mark.parametrize(("camera", "model"), CAMERAS)
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
    if find_spec("lensfunpy") is not None:
        lensfunpy = import_module("lensfunpy")
        (lens,) = (
            found for found in lensfunpy.Database(xml=text, load_common=False).lenses if found.maker == "Unknown"
        )
        change = lensfunpy.Modifier(lens, 1.0, width, height)
        change.initialize(float(re.findall(r'focal="([^"]+)"', text)[0]), 8.0, 10.0, scale=1.0)
        places = change.apply_geometry_distortion()[::40, ::40].reshape(-1, 2)
        y, x = np.mgrid[:height:40, :width:40]
        own = _distorted(text, camera, np.column_stack([x.ravel(), y.ravel()]).astype(np.float64))
        inside = ((places >= 0) & (places <= np.array([width - 1, height - 1]))).all(axis=1)
        # It takes sides for a pixel shorter where it compares aspect ratios: 0.03 % of the radius.
        assert np.abs(own - places)[inside].max() < 0.3


@pytest.mark.parametrize(("camera", "_model"), CAMERAS)
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
    with pytest.raises(InputError, match=r"a\.xml: ") as caught:
        load_camera(tmp_path / "a.xml", (640, 480))
    assert message in str(caught.value)
