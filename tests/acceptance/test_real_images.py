"""Real images with known lenses: drones over a park and a field, and chessboards before wide lenses."""

from collections.abc import Callable
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

import rdstitch
from rdstitch.errors import RdstitchError
from tests.chessboards import BOARDS, corners_of, files_of, off_lines, rational_undistort

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
@pytest.mark.parametrize("name", list(BOARDS))
def test_chessboards_are_straight(name: str, shared_data: Locate) -> None:
    """Rows and columns of corners, undistorted, against a lens of eight coefficients fitted to these corners."""
    files = files_of(shared_data(name))
    camera = rdstitch.calibrate(files).camera
    corners = corners_of(files, BOARDS[name])
    best = off_lines(corners, rational_undistort(corners, camera.image_size))
    assert off_lines(corners, camera.undistort) <= 1.3 * best
