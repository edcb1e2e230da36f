"""Lenses of real folders against calibrations made otherwise: ``python -m tests.benchmarks.real_lenses [FOLDER ...]``.

Every folder is calibrated as a user would do it, without knowledge of what it shows; ``../shared/data`` has them.

Chessboards are judged by their corners, which the estimation does not use: the root mean square distance of the corners
of rows and columns from straight lines, and from a grid with one homography a board, both in pixels of the image;
beside it the same for OpenCV's rational model (``calibrateCamera``), fitted to these very corners. "λ there" is the
one-parameter lens nearest to ours at the radii of the corners, which is what a fit of one λ to them finds; the λ before
is that over the whole image, beyond the corners of most boards.

Flights are judged by the maker's fisheye polynomial, where an image carries it in its XMP: points all over the image
are undistorted by both lenses, and ours brought onto the maker's by the best similarity, or by the best homography
(no image of a plane shows either: a homography of the undistorted images is a change of the poses). Distances are
in undistorted pixels, whose scale is that of the image at the maker's principal point.
"""

import argparse
import re
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

import rdstitch
from examples.judging.fitting import apply, fit_homography, fit_similarity
from rdstitch.arrays import FloatArray
from rdstitch.camera import Camera
from rdstitch.camera_files.lens_models import Brown
from rdstitch.division_model import nearest_one_parameter

SHARED = Path(__file__).resolve().parents[3] / "shared" / "data"

BOARDS = {
    "fisheye_chess": (15, 9),
    "carnd_wide_gopro_chess": (8, 6),
    "opencv_chess_left": (9, 6),
    "opencv_chess_right": (9, 6),
}
"""Inner corners."""

FLIGHTS = {"garfield_red": "garfield_red_16bit", "garfield_red_16bit": "garfield_red_16bit"}
"""Folders, and that which carries the calibration of their camera."""

_SUFFIXES = (".jpg", ".tif")
_GRID = 65
_WINDOW = (5, 5)
_PIXEL_MM = 0.00375  # of the Parrot Sequoia's narrow bands

Undistort = Callable[[FloatArray], FloatArray]


def files_of(folder: Path) -> list[Path]:
    """The images of a folder."""
    return sorted(file for file in folder.iterdir() if file.suffix.lower() in _SUFFIXES)


def maker_undistort(image: Path) -> Undistort:
    """The lens that an image's XMP gives as Pix4D writes it, pixels to undistorted pixels.

    A ray at θ from the axis is measured ``F ρ(t)`` from the principal point, with t = 2 θ / π and ρ the polynomial.
    """
    text = image.read_bytes()

    def numbers(name: str) -> list[float]:
        found = re.search(rb'Camera:%s="([^"]*)"' % name.encode(), text)
        if found is None:
            raise ValueError(f"{image} has no {name}")
        return [float(number) for number in found[1].split(b",")]

    center = np.array(numbers("PrincipalPoint")) / _PIXEL_MM
    scale, polynomial = numbers("FisheyeAffineMatrix")[0], numbers("FisheyePolynomial")
    shares = np.linspace(0.0, 0.9, 20_001)
    measured = scale * np.polynomial.polynomial.polyval(shares, polynomial)
    end = int(np.argmax(np.diff(measured) <= 0.0)) or len(shares)
    focal = scale * polynomial[1] * 2.0 / np.pi

    def undistort(points: FloatArray) -> FloatArray:
        offset = points - center
        radius = np.linalg.norm(offset, axis=-1, keepdims=True)
        straight = focal * np.tan(np.interp(radius, measured[:end], shares[:end]) * np.pi / 2.0)
        return np.asarray(center + offset * np.where(radius > 0.0, straight / np.maximum(radius, 1e-12), 1.0))

    return undistort


def differences(camera: Camera, truth: Undistort) -> dict[str, tuple[float, float]]:
    """Rms and largest distance of undistorted points over the image, after the best similarity and homography."""
    u, v = (np.linspace(-0.5, side - 0.5, _GRID) for side in camera.image_size)
    points = np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 2)
    ours, theirs = camera.undistort(points), truth(points)
    result = {}
    for name, fit in (("similarity", fit_similarity), ("homography", fit_homography)):
        distance = np.linalg.norm(apply(fit(ours, theirs), ours) - theirs, axis=1)
        result[name] = float(np.sqrt(np.mean(distance**2))), float(distance.max())
    return result


def corners_of(files: Sequence[Path], board: tuple[int, int]) -> FloatArray:
    """Corners of the boards that are found whole, pixels, shape (B, rows, columns, 2)."""
    grids = []
    for file in files:
        grey = cv2.imread(str(file), cv2.IMREAD_GRAYSCALE)
        assert grey is not None
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
    k1, k2, p1, p2, k3, k4, k5, k6 = lens.ravel()[:8].tolist()
    focal, center = (matrix[0, 0], matrix[1, 1]), (matrix[0, 2], matrix[1, 2])
    return Brown(focal, center, (k1, k2, k3), (p1, p2), (k4, k5, k6)).undistort


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


def off_grid(grids: FloatArray, undistort: Undistort) -> float:
    """Rms distance of corners from a grid, one homography a board, to first order in pixels of the image."""
    rows, columns = grids.shape[1:3]
    plane = np.stack(np.meshgrid(np.arange(columns), np.arange(rows)), axis=-1).reshape(-1, 2).astype(np.float64)
    squared = []
    for grid, slope in zip(undistort(grids), _slope(grids, undistort), strict=True):
        flat, inverse = grid.reshape(-1, 2), np.linalg.inv(slope.reshape(-1, 2, 2))
        homography = fit_homography(plane, flat)
        for _ in range(3):
            homography = homography + _homography_step(homography, plane, flat, inverse)
        error = np.einsum("nij,nj->ni", inverse, flat - apply(homography, plane))
        squared.append(np.sum(error**2, axis=1))
    return float(np.sqrt(np.mean(np.concatenate(squared))))


def _homography_step(homography: FloatArray, plane: FloatArray, flat: FloatArray, inverse: FloatArray) -> FloatArray:
    """A Gauss-Newton step (3, 3) of a homography, whose last entry stays."""
    lifted = np.column_stack([plane, np.ones(len(plane))])
    depth = lifted @ homography[2]
    mapped = apply(homography, plane)
    zero = np.zeros_like(lifted)
    jacobian = (
        np.stack(
            [
                np.hstack([lifted, zero, -mapped[:, :1] * lifted[:, :2]]),
                np.hstack([zero, lifted, -mapped[:, 1:] * lifted[:, :2]]),
            ],
            axis=1,
        )
        / depth[:, None, None]
    )
    columns, error = inverse @ jacobian, np.einsum("nij,nj->ni", inverse, flat - mapped)
    step = np.linalg.lstsq(columns.reshape(-1, 8), error.ravel(), rcond=None)[0]
    return np.append(step, 0.0).reshape(3, 3)


def _slope(points: FloatArray, undistort: Undistort) -> FloatArray:
    """Derivatives (..., 2, 2) of undistorted by measured points, by central differences."""
    columns = [(undistort(points + 0.5 * unit) - undistort(points - 0.5 * unit)) for unit in np.eye(2)]
    return np.stack(columns, axis=-1)


def main() -> None:
    """Print a line for each folder."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folders", nargs="*", default=[*BOARDS, *FLIGHTS], help=f"of {SHARED}")
    parser.add_argument("--lens", default="auto", help="auto, division, …")
    given = parser.parse_args()
    for name in given.folders:
        if not (SHARED / name).is_dir():
            print(f"{name}: not here")
            continue
        start, files = time.process_time(), files_of(SHARED / name)
        found = rdstitch.calibrate(files, rdstitch.StitchOptions(workers=1, lens=given.lens))
        camera, alignment = found.camera, found.alignment
        line = (
            f"{name:22s} {int(alignment.used.sum())} of {len(files)}, {alignment.lens} λ {alignment.distortion:+.4f} ± "
            f"{alignment.distortion_std:.4f}"
        )
        if name in BOARDS:
            grids = corners_of(files, BOARDS[name])
            other = rational_undistort(grids, camera.image_size)
            for what, off in (("lines", off_lines), ("grid", off_grid)):
                own, best = off(grids, camera.undistort), off(grids, other)
                line += f"; off {what} {own:.3f}, rational {best:.3f}: {own / best:.2f} times"
            squared = np.sum(camera.normalize(grids) ** 2, axis=-1).ravel()
            there = nearest_one_parameter(squared, camera.distortion, camera.higher)[0]
            line += f" ({len(grids)} boards, λ there {there:+.4f})"
        if name in FLIGHTS:
            for gauge, (rms, largest) in differences(
                camera, maker_undistort(files_of(SHARED / FLIGHTS[name])[0])
            ).items():
                line += f"; up to a {gauge} rms {rms:.2f}, largest {largest:.2f}"
        print(f"{line}; {time.process_time() - start:.0f} s", flush=True)


if __name__ == "__main__":
    main()
