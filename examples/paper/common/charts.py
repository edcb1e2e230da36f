"""A chessboard: seen by a camera, undistorted, laid on its grid, and drawn so."""

from functools import partial
from pathlib import Path

import cv2
import numpy as np

from examples.judging import fit_homography, fit_similarity
from examples.judging.fitting import apply
from examples.paper.common.report import Pixels
from rdstitch.arrays import FloatArray
from rdstitch.camera import Camera
from rdstitch.compositing import Canvas, CompositeOptions, PlacedImage, compose
from rdstitch.io.read import read_image
from rdstitch.synthetic import ImageTexture, Poses, sequence_over
from rdstitch.synthetic import Sequence as RenderedSequence

_SQUARE = 80  # texels of a rendered chart
_SQUARES = 30  # a side
_DARK, _LIGHT = 40, 225
_AS_IT_IS = CompositeOptions(exposure="none", seam="none", blend="none", background=255)


def rendered_chart(camera: Camera, tilt: tuple[float, float], yaw: float) -> RenderedSequence:
    """One image of an endless chessboard; a texel is a pixel at the image's centre."""
    dark = np.indices((_SQUARES, _SQUARES)).sum(axis=0) % 2 == 0
    chart = np.kron(np.where(dark, _DARK, _LIGHT), np.ones((_SQUARE, _SQUARE))).astype(np.uint8)
    assert camera.focal is not None
    return sequence_over(ImageTexture(chart), camera, Poses.of([(0.0, 0.0)], camera.focal, yaw, tilt))


def seen_corners(sequence: RenderedSequence) -> tuple[FloatArray, FloatArray]:
    """Corners of the rendered chart that the image shows: measured px, and grid coordinates, both (N, 2)."""
    steps = np.arange(1.0, _SQUARES)
    grid = np.stack(np.meshgrid(steps, steps), axis=-1).reshape(-1, 2)
    points = sequence.to_image(0, grid * _SQUARE - 0.5)
    limit = np.array(sequence.lens.image_size) - 1.0
    with np.errstate(invalid="ignore"):
        seen = ((points >= 0.0) & (points <= limit)).all(axis=1)
    return points[seen], grid[seen]


def off_grid(points: FloatArray, grid: FloatArray, *, metric: bool) -> float:
    """Rms distance from the grid, % of a square, after the best similarity (metric) or homography."""
    fit = fit_similarity if metric else fit_homography
    residual = apply(fit(points, grid), points) - grid
    return 100.0 * float(np.sqrt((residual**2).sum(axis=1).mean()))


def undistorted(camera: Camera, points: FloatArray) -> FloatArray:
    """Measured px to undistorted coordinates in half diagonals."""
    return camera.normalize(camera.undistort(points))


def before_and_after(file: Path, camera: Camera, to_grid: FloatArray, size: tuple[float, float], px: float) -> Pixels:
    """An image beside itself, undistorted and rectified.

    ``camera``: with the λ that undistorts it. ``to_grid``: undistorted half diagonals to grid coordinates, of which the
    square from (0, 0) to ``size`` is drawn; shape (3, 3). ``px``: size of a square.
    """
    width, height = (round(px * extent) for extent in size)
    frame = np.array([(0.0, 0.0), (width - 1.0, 0.0), (width - 1.0, height - 1.0), (0.0, height - 1.0)])
    canvas = Canvas((width, height), np.diag([px, px, 1.0]), (frame,))
    after = compose([PlacedImage(partial(read_image, file), camera, to_grid)], canvas, _AS_IT_IS)
    pixels = np.where(after.alpha[..., None] > 0, _as_rgb(after.pixels), np.uint8(255))
    measured = _as_rgb(np.asarray(read_image(file).pixels))
    shape = (round(measured.shape[1] * height / measured.shape[0]), height)
    before = cv2.resize(measured, shape, interpolation=cv2.INTER_AREA)
    gap = np.full((height, 8, 3), 255, np.uint8)
    both: Pixels = np.concatenate([before, gap, pixels], axis=1)
    return both


def _as_rgb(pixels: Pixels) -> Pixels:
    return pixels if pixels.ndim == 3 else np.repeat(pixels[:, :, None], 3, axis=2)
