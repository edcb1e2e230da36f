"""The project for Hugin, read back: control points of two images meet in the panorama."""

import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from examples.worlds.turns import panorama_rotations, turning_sequence
from rdstitch.arrays import FloatArray
from rdstitch.camera_files import read_camera_file
from rdstitch.choices import ModelName
from rdstitch.errors import ArgumentError
from rdstitch.export.hugin_project import project_of_hugin
from rdstitch.geometry.camera import Camera
from rdstitch.options.stitch_options import StitchOptions
from rdstitch.pipeline.recipes import mosaic
from tests.cli.running import flight

_VALUE = re.compile(r"([A-Za-z]+)(-?[\d.]+(?:e-?\d+)?|=\d+|\"[^\"]*\")")


def _lines(text: str, kind: str) -> list[dict[str, str]]:
    return [dict(_VALUE.findall(line[2:])) for line in text.splitlines() if line.startswith(f"{kind} ")]


def _rays(image: dict[str, str], points: FloatArray) -> FloatArray:
    """Where pixels (N, 2) of an image meet the sphere, or with TrX the plane at z = 1, by panotools' own formulas."""
    value = {key: float(text) for key, text in image.items() if not text.startswith('"')}
    width, height, unit = value["w"], value["h"], min(value["w"], value["h"]) / 2
    bent = points - np.array([(width - 1) / 2 + value["d"], (height - 1) / 2 + value["e"]])
    a, b, c = value["a"], value["b"], value["c"]
    measured = straight = np.linalg.norm(bent, axis=1) / unit
    for _ in range(60):  # r_d = r (a r³ + b r² + c r + 1 - a - b - c)
        straight = measured / (((a * straight + b) * straight + c) * straight + 1 - a - b - c)
    flat = bent * (straight / np.maximum(measured, 1e-12))[:, None]
    focal = width / 2 / np.tan(np.radians(value["v"]) / 2)
    rays = np.column_stack([flat / focal, np.ones(len(flat))])
    y, p, r = (np.radians(value[name]) for name in "ypr")
    turn = np.array([[np.cos(y), 0, np.sin(y)], [0, 1, 0], [-np.sin(y), 0, np.cos(y)]])
    turn = turn @ np.array([[1, 0, 0], [0, np.cos(p), -np.sin(p)], [0, np.sin(p), np.cos(p)]])
    turn = turn @ np.array([[np.cos(r), -np.sin(r), 0], [np.sin(r), np.cos(r), 0], [0, 0, 1]])
    rays = np.asarray(rays @ turn.T, dtype=np.float64)
    if "TrX" not in value:
        rays /= np.linalg.norm(rays, axis=1)[:, None]
        return rays
    place = np.array([value["TrX"], value["TrY"], -value["TrZ"]])
    met: FloatArray = place + rays * ((1.0 - place[2]) / rays[:, 2])[:, None]
    return met


def _border(width: float, height: float) -> FloatArray:
    t = np.linspace(0.0, 1.0, 50)[:, None]
    corners = np.array([(0, 0), (width - 1, 0), (width - 1, height - 1), (0, height - 1)])
    return np.concatenate([a + t * (b - a) for a, b in zip(corners, np.roll(corners, -1, axis=0), strict=True)])


def _plane(folder: Path) -> list[Path]:
    """One of the images is held upright, as EXIF says."""
    paths = flight(3, 3, 2, distortion=-0.1).write(folder)
    with Image.open(paths[1]) as image:
        exif = image.getexif()
        exif[0x0112] = 6
        turned = image.transpose(Image.Transpose.ROTATE_90)
    turned.save(paths[1], exif=exif)
    return paths


def _turn(folder: Path) -> list[Path]:
    lens = Camera((320, 240), -0.1, focal=260.0, focal_source="option")
    return turning_sequence(lens, panorama_rotations(4, np.radians(30.0), seed=1), seed=2).write(folder)


@pytest.mark.parametrize("taken", [_plane, _turn])
def test_control_points_meet(taken: Callable[[Path], list[Path]], tmp_path: Path) -> None:
    paths = taken(tmp_path)
    result = mosaic(paths, options=StitchOptions(workers=1, dry_run=True))
    (tmp_path / "a.pto").write_text(text := project_of_hugin(result.registration, result.canvas), encoding="utf-8")
    images, control = _lines(text, "i"), _lines(text, "c")
    assert [Path(image["n"].strip('"')) for image in images] == [path.absolute() for path in sorted(paths)]
    resolved = [
        {key: images[int(value[1:])][key] if value.startswith("=") else value for key, value in image.items()}
        for image in images
    ]
    links = result.registration.alignment.support
    assert len(control) > 10 * len(links)
    off = [
        np.linalg.norm(
            _rays(resolved[int(c["n"])], np.array([[float(c["x"]), float(c["y"])]]))
            - _rays(resolved[int(c["N"])], np.array([[float(c["X"]), float(c["Y"])]]))
        )
        for c in control
    ]
    focal = result.registration.camera.with_guessed_focal().focal
    assert np.median(off) * focal < 1.0
    # The output is a crop of the panorama: it reaches as far as the images.
    (panorama,) = (line for line in text.splitlines() if line.startswith("p "))
    crop = [int(value) for value in re.search(r" S(\d+),(\d+),(\d+),(\d+) ", panorama).groups()]
    width, height = (int(value) for value in re.search(r" w(\d+) h(\d+) ", panorama).groups())
    ends = np.concatenate([_rays(image, _border(float(image["w"]), float(image["h"]))) for image in resolved])
    if taken is _turn:
        longitude, latitude = np.arctan2(ends[:, 0], ends[:, 2]), np.arcsin(ends[:, 1])
        ends = np.column_stack([longitude * width / (2 * np.pi), latitude * height / np.pi])
    else:
        ends = ends[:, :2] * focal
    ends += np.array([width / 2, height / 2])
    bounds = np.stack([ends.min(axis=0), ends.max(axis=0)])
    np.testing.assert_allclose(crop, np.clip(bounds, 0, (width, height)).T.ravel(), atol=4.0)
    lens = read_camera_file(tmp_path / "a.pto").camera
    assert lens.nearest_distortion == pytest.approx(result.distortion, abs=0.01)


@pytest.mark.parametrize(
    ("model", "name", "reason"),
    [
        ("homography", "a.png", "no images with a homography of their own"),
        ("pose", 'a".png', r'a"\.png: .*cannot name files with quotes'),
    ],
)
def test_what_hugin_does_not_know_is_refused(tmp_path: Path, model: ModelName, name: str, reason: str) -> None:
    paths = flight(3, 2).write(tmp_path)
    paths[0] = paths[0].rename(paths[0].with_name(name))
    result = mosaic(paths, options=StitchOptions(workers=1, dry_run=True, model=model))
    with pytest.raises(ArgumentError, match=reason):
        project_of_hugin(result.registration, result.canvas)
