"""Real images with known lenses: drones over a park and a field, and chessboards before wide lenses."""

from collections.abc import Callable, Sequence
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

import rdstitch
from rdstitch.arrays import FloatArray
from rdstitch.errors import RdstitchError
from rdstitch.geometry.lens_model import LensModel

BOARDS = {
    "fisheye_chess": (15, 9),
    "carnd_wide_gopro_chess": (8, 6),
    "opencv_chess_left": (9, 6),
    "opencv_chess_right": (9, 6),
}
"""Inner corners."""

_SUFFIXES = (".jpg", ".tif")
_WINDOW = (5, 5)

Undistort = Callable[[FloatArray], FloatArray]


def files_of(folder: Path) -> list[Path]:
    return sorted(file for file in folder.iterdir() if file.suffix.lower() in _SUFFIXES)


def corners_of(files: Sequence[Path], board: tuple[int, int]) -> FloatArray:
    """Corners of the boards that are found whole, pixels, shape (B, rows, columns, 2)."""
    grids = []
    for file in files:
        grey = cv2.imread(str(file), cv2.IMREAD_GRAYSCALE)
        found, corners = cv2.findChessboardCorners(grey, board)
        if found:
            corners = cv2.cornerSubPix(grey, corners, _WINDOW, (-1, -1), (3, 50, 1e-4))
            grids.append(corners.reshape(board[1], board[0], 2).astype(np.float64))
    return np.array(grids)


def rational_undistort(grids: FloatArray, size: tuple[int, int]) -> Undistort:
    """OpenCV's rational lens, calibrated from the corners, pixels to undistorted pixels."""
    rows, columns = grids.shape[1:3]
    flat = np.zeros((rows * columns, 3), dtype=np.float32)
    flat[:, :2] = np.stack(np.meshgrid(np.arange(columns), np.arange(rows)), axis=-1).reshape(-1, 2)
    seen = [grid.reshape(-1, 1, 2).astype(np.float32) for grid in grids]
    start: NDArray[np.float64] = np.eye(3)
    _, matrix, lens, *_ = cv2.calibrateCamera(
        [flat] * len(seen), seen, size, start, np.zeros(8), flags=cv2.CALIB_RATIONAL_MODEL
    )
    focal, center = (matrix[0, 0], matrix[1, 1]), (matrix[0, 2], matrix[1, 2])
    return LensModel(focal, center, tuple(lens.ravel()[:8].tolist())).undistort


def off_lines(grids: FloatArray, undistort: Undistort) -> float:
    """Rms distance of corners from the lines of their rows and columns, to first order in pixels of the image."""
    flat, by_point = undistort(grids), _slope(grids, undistort)
    squared = []
    for own, slope in ((flat, by_point), (flat.swapaxes(1, 2), by_point.swapaxes(1, 2))):
        for line, change in zip(own.reshape(-1, *own.shape[2:]), slope.reshape(-1, *slope.shape[2:]), strict=True):
            weight = np.ones(len(line))
            for _ in range(3):  # distances in the image count, not those in the undistorted one
                middle = weight @ line / weight.sum()
                normal = np.linalg.svd(np.sqrt(weight)[:, None] * (line - middle), full_matrices=False)[2][-1]
                weight = 1.0 / np.sum((normal @ change) ** 2, axis=-1)
            squared.append(weight * ((line - middle) @ normal) ** 2)
    return float(np.sqrt(np.mean(np.concatenate(squared))))


def _slope(points: FloatArray, undistort: Undistort) -> FloatArray:
    """Derivatives (..., 2, 2) of undistorted by measured points, by central differences."""
    columns = [(undistort(points + 0.5 * unit) - undistort(points - 0.5 * unit)) for unit in np.eye(2)]
    return np.stack(columns, axis=-1)


Locate = Callable[[str], Path]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "distortion", "largest_error"), [("garfield_red", -0.234, 0.009), ("garfield_gre", -0.231, 0.003)]
)
def test_consecutive_pairs(name: str, distortion: float, largest_error: float, shared_data: Locate) -> None:
    """The median over pairs is nearer the truth than the best other library's; what is refused is told."""
    images = sorted(shared_data(name).glob("*.*"))
    found, refused = [], []
    for pair in pairwise(images):
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
def test_trees_and_houses_leave_the_focal_length(shared_data: Locate) -> None:
    """That of EXIF is right; with priors that all matches outweigh, relief made it half as long again."""
    registration = rdstitch.calibrate([shared_data("beach")])
    written = registration.sources[0].metadata.focal_px
    assert abs(np.log(registration.camera.focal / written)) < 0.2


@pytest.mark.slow
@pytest.mark.parametrize("name", list(BOARDS))
def test_chessboards_are_straight(name: str, shared_data: Locate) -> None:
    """Rows and columns of corners, undistorted, against a lens of eight coefficients fitted to these corners."""
    files = files_of(shared_data(name))
    camera = rdstitch.calibrate(files).camera
    corners = corners_of(files, BOARDS[name])
    best = off_lines(corners, rational_undistort(corners, camera.image_size))
    assert off_lines(corners, camera.undistort) <= 1.3 * best
