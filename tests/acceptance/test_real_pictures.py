"""Real pictures with known lenses: drones over a park and a field, and chessboards before wide lenses."""

from collections.abc import Callable
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
import pytest

import rdstitch
from rdstitch.arrays import FloatArray
from rdstitch.camera import Camera
from rdstitch.errors import RdstitchError
from rdstitch.io.read import read_image

Locate = Callable[[str], Path]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "distortion", "largest_error"), [("garfield_red", -0.234, 0.009), ("garfield_gre", -0.231, 0.003)]
)
def test_consecutive_pairs(name: str, distortion: float, largest_error: float, shared_data: Locate) -> None:
    """The median over pairs is nearer the truth than the best other library's; what is refused is told."""
    pictures = sorted(shared_data(name).glob("*.*"))
    found, refused = [], []
    for pair in pairwise(pictures):
        try:
            registration = rdstitch.calibrate(pair)
        except RdstitchError as error:
            refused.append(str(error))
        else:
            found.append(registration.alignment.distortion)
    assert len(found) >= 20
    assert all(text and "\n" not in text for text in refused)
    assert abs(float(np.median(found)) - distortion) < largest_error


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "least", "distortion", "tolerance"),
    [("garfield_red", 26, -0.234, 0.006), ("garfield_gre", 26, -0.231, 0.006), ("copr", 38, -0.023, 0.007)],
)
def test_sequences(name: str, least: int, distortion: float, tolerance: float, shared_data: Locate) -> None:
    registration = rdstitch.calibrate([shared_data(name)])
    assert registration.alignment.used.sum() >= least
    assert abs(registration.alignment.distortion - distortion) <= tolerance


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "board"),
    [("opencv_chess_left", (9, 6)), ("opencv_chess_right", (9, 6)), ("carnd_wide_gopro_chess", (8, 6))],
)
def test_chessboards_are_straight(name: str, board: tuple[int, int], shared_data: Locate) -> None:
    """Rows and columns of corners, undistorted, against the best that one λ about the image centre can do."""
    folder = shared_data(name)
    registration = rdstitch.calibrate([folder])
    lines = _lines(folder, board)
    size = registration.camera.image_size
    best = min(_bend(lines, Camera(size, float(value))) for value in np.arange(-0.7, 0.0, 0.005))
    assert _bend(lines, registration.camera) <= 1.3 * best


def _lines(folder: Path, board: tuple[int, int]) -> list[FloatArray]:
    """Rows and columns of the corners of all boards that are found whole, px."""
    lines: list[FloatArray] = []
    for file in sorted(folder.glob("*.jpg")):
        grey = read_image(file).pixels
        grey = grey if grey.ndim == 2 else cv2.cvtColor(grey, cv2.COLOR_RGB2GRAY)
        found, corners = cv2.findChessboardCorners(grey, board)
        if found:
            corners = cv2.cornerSubPix(grey, corners, (5, 5), (-1, -1), (3, 50, 1e-4))
            grid = corners.reshape(board[1], board[0], 2).astype(np.float64)
            lines += [*grid, *grid.transpose(1, 0, 2)]
    assert len(lines) > 100
    return lines


def _bend(lines: list[FloatArray], camera: Camera) -> float:
    """Root mean square distance of undistorted corners from straight lines, px."""
    squared = []
    for line in lines:
        flat = camera.undistort(line)
        squared.append(np.linalg.svd(flat - flat.mean(axis=0), compute_uv=False)[-1] ** 2 / len(flat))
    return float(np.sqrt(np.mean(squared)))
