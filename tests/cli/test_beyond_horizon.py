"""Images of a circular fisheye of 190 degrees and more: masked beyond the horizon, never folded."""

from pathlib import Path

import cv2
import numpy as np
import pytest

import rdstitch as library
from rdstitch.camera_files import load_camera
from rdstitch.camera_files.lens_models import nearest_model
from rdstitch.synthetic import FisheyeLens, ground
from tests.cli.running import CACHED, Run

SIZE = (400, 300)
LENS = FisheyeLens(SIZE, 105.0, offset=(4.0, -3.0))  # 90 degrees off the axis at 165 pixels
PLACES = ((0.0, 0.0, 0.0), (90.0, 15.0, 0.2), (180.0, -10.0, -0.3))  # x, y, and turned by
HEIGHT = 110.0
FILE = """%YAML:1.0
---
image_width: 400
image_height: 300
fisheye_model: 1
camera_matrix: !!opencv-matrix
   rows: 3
   cols: 3
   dt: d
   data: [ 105., 0., 203.5, 0., 105., 146.5, 0., 0., 1. ]
distortion_coefficients: !!opencv-matrix
   rows: 4
   cols: 1
   dt: d
   data: [ 0., 0., 0., 0. ]
"""


def _ground_points(points: np.ndarray, place: tuple[float, float, float]) -> np.ndarray:
    """Texels (N, 2) of the ground at measured pixels (N, 2) of an image; NaN beyond the horizon."""
    x, y, turn = place
    rotation = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    rays = (LENS.undistort(points) - LENS.center) / LENS.focal
    seen: np.ndarray = HEIGHT * rays @ rotation.T + (600.0 + x, 600.0 + y)
    return seen


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    made = tmp_path_factory.mktemp("fisheye")
    texture = np.asarray(ground((1400, 1200), 3, 1).region(0, 0, 1400, 1200), dtype=np.float32).reshape(1200, 1400)
    u, v = np.meshgrid(np.arange(SIZE[0], dtype=np.float64), np.arange(SIZE[1], dtype=np.float64))
    for number, place in enumerate(PLACES):
        seen = np.nan_to_num(_ground_points(np.column_stack([u.ravel(), v.ravel()]), place), nan=-1.0)
        x, y = seen.reshape(*u.shape, 2).astype(np.float32).transpose(2, 0, 1)
        image = cv2.remap(texture * 255.0, x, y, cv2.INTER_LINEAR, borderValue=(90.0,))
        cv2.imwrite(str(made / f"{number}.png"), image.astype(np.uint8))
    (made / "fisheye.yml").write_text(FILE, encoding="utf-8")
    return made


def test_the_camera_file_is_read_to_the_horizon(folder: Path) -> None:
    camera = load_camera(folder / "fisheye.yml")
    assert camera.sees_beyond_horizon
    points = np.random.default_rng(0).uniform((0, 0), (399, 299), (500, 2))
    angle = np.degrees(np.linalg.norm(points - LENS.center, axis=1) / LENS.focal)
    straight = camera.undistort(points)
    near = angle < 80.0
    assert np.linalg.norm(LENS.distort(straight[near]) - points[near], axis=1).max() < 0.1
    assert np.isnan(straight[angle > 91.0]).all()
    _, fit = nearest_model(camera, "fisheye")
    assert fit.largest < 0.1


@pytest.mark.parametrize("view", ["same", "all", "valid"])
def test_undistorted_images_are_masked(rdstitch: Run, folder: Path, tmp_path: Path, view: str) -> None:
    lens = ("--camera", folder / "fisheye.yml")
    rdstitch("undistort", folder / "0.png", "-o", tmp_path, *lens, "--view", view)
    image = cv2.imread(str(tmp_path / "0.png"), cv2.IMREAD_UNCHANGED)
    if view == "all":
        assert (image[[0, 0, -1, -1], [0, -1, 0, -1], 3] == 0).all()
        # A circle fills this share of its square.
        assert image[..., 3].mean() / 255.0 == pytest.approx(np.pi / 4.0, abs=0.05)
    else:
        assert (image[..., -1] > 0).all()


def test_a_mosaic_of_what_is_before_the_camera(rdstitch: Run, folder: Path, tmp_path: Path) -> None:
    images = [folder / f"{number}.png" for number in range(3)]
    lens = ("--camera", folder / "fisheye.yml")
    rdstitch("pano", *images, "-o", tmp_path / "a.png", *lens, *CACHED)
    image = cv2.imread(str(tmp_path / "a.png"), cv2.IMREAD_UNCHANGED)
    assert (image[[0, 0, -1, -1], [0, -1, 0, -1], 3] == 0).all()
    options = library.StitchOptions(camera=load_camera(folder / "fisheye.yml"))
    found = library.pano(images, options=options).registration.alignment
    assert found.used.all()
    points = np.random.default_rng(1).uniform((60, 20), (340, 280), (300, 2))
    moved = found.transfer(0, 2, points)
    back = np.linalg.norm(moved - LENS.center, axis=1) < np.radians(65.0) * 105.0
    off = _ground_points(moved[back], PLACES[2]) - _ground_points(points[back], PLACES[0])
    assert back.sum() > 50
    assert np.median(np.linalg.norm(off, axis=1)) < 0.5
