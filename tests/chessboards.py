"""Chessboards before real lenses: their corners, and how far from straight lines a lens leaves them."""

from collections.abc import Callable, Sequence
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from rdstitch.arrays import FloatArray
from rdstitch.camera_files.lens_models import LensModel

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
