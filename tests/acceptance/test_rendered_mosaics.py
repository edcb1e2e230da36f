"""Twelve views of a plane, no setting given: the mosaic against the true plane."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

import rdstitch
from rdstitch.camera import Camera
from rdstitch.synthetic import Photometry, Sequence, grid_poses, ground, sequence_over
from tests.acceptance.rendered import geometry, image


@dataclass(frozen=True)
class View:
    """Lens, grid and motion of a set; angles in degrees; the largest median and 95 % error, px."""

    size: tuple[int, int]
    focal: float
    distortion: float
    grid: tuple[int, int]
    tilt: tuple[float, float]
    yaw: float
    median: float
    percentile95: float
    exposure: float = 0.15


SETS = {
    "barrel": View((640, 480), 520.0, -0.25, (4, 3), (2.5, -2.0), 8.0, 0.5, 1.5),
    "wide": View((800, 600), 650.0, -0.25, (6, 2), (2.0, -1.5), 8.0, 0.8, 2.5),
    "strong": View((640, 480), 420.0, -0.45, (4, 3), (-6.0, 5.0), 15.0, 1.0, 3.0),
    "none": View((640, 480), 520.0, 0.0, (4, 3), (0.0, 0.0), 180.0, 0.5, 1.5),
}


def _sequence(view: View, seed: int) -> Sequence:
    lens = Camera(view.size, view.distortion, focal=view.focal)
    tilt = np.radians(view.tilt[0]), np.radians(view.tilt[1])
    poses = grid_poses(lens, *view.grid, overlap=0.4, yaw=np.radians(view.yaw), tilt=tilt, seed=seed)
    gain = 1.0 + view.exposure * np.random.default_rng(seed).uniform(-1.0, 1.0, len(poses))
    light = Photometry(gain=gain, noise=0.005)
    return sequence_over(lambda size: ground(size, seed), lens, poses, photometry=light, seed=seed)


@pytest.mark.slow
@pytest.mark.parametrize("name", SETS)
def test_mosaic(name: str, tmp_path: Path) -> None:
    view = SETS[name]
    sequence = _sequence(view, seed=11)
    folder, output = tmp_path / "frames", tmp_path / "mosaic.png"
    folder.mkdir()
    sequence.write(folder)
    result = rdstitch.mosaic([folder], output)
    alignment = result.registration.alignment
    assert alignment.used.all()
    assert abs(alignment.distortion - view.distortion) <= 0.01
    error = geometry(sequence, result, "similarity")
    assert error.median < view.median
    assert error.percentile95 < view.percentile95
    seen = image(sequence, output, "similarity")
    assert seen.median < view.median
    assert seen.percentile95 < view.percentile95
    assert seen.coverage >= 0.97
