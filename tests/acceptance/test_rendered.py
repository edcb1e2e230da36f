"""Rendered pairs, mosaics and drives against their truth."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

import rdstitch
from examples.judging import PlaneComparison, compare_with_plane, registration_error
from examples.judging.trajectories import compare_trajectories
from examples.worlds.floor_drives import DISTORTION, PATHS, floor_drive, read_path, true_path
from rdstitch.geometry.camera import Camera
from rdstitch.io.read import read_image
from rdstitch.synthetic import Photometry, RenderedSequence, grid_poses, ground, pair_poses, sequence_over
from tests.cli.running import FAST, finished, start
from tests.sampled import sampled


def _shown(sequence: RenderedSequence, output: Path, model: str) -> PlaneComparison:
    """The written image against what the images could see of the true plane, up to one transform."""
    found = read_image(output)
    shown = np.dstack([found.pixels, found.alpha])
    return compare_with_plane(shown, sequence.texture, model=model, reachable=sequence.reachable())


@pytest.mark.slow
@pytest.mark.parametrize("path", PATHS)
def test_drive(path: str, tmp_path: Path) -> None:
    sequence = floor_drive(path, 80, seed=23, overlap=0.75)
    sequence.write(tmp_path)
    found, registration = rdstitch.trajectory([tmp_path])
    assert len(found) == len(sequence)
    error = compare_trajectories(found, true_path(sequence))
    assert error.translation_in_own_unit < 0.001
    assert np.degrees(error.rotation) < 0.02
    assert abs(registration.alignment.distortion - DISTORTION) < 0.001


@pytest.mark.slow
def test_short_drive_by_the_command(tmp_path: Path) -> None:
    sequence = floor_drive("parking", 12, seed=7, size=(320, 240), overlap=0.7)
    frames, output = tmp_path / "frames", tmp_path / "path.csv"
    frames.mkdir()
    sequence.write(frames)
    done = finished(start("trajectory", frames, "-o", output, *FAST))
    assert (done.status, done.err) == (0, "")
    assert abs(float(done.out) - DISTORTION) < 0.001
    found = read_path(output)
    assert len(found) == len(sequence)
    error = compare_trajectories(found, true_path(sequence))
    assert error.translation_in_own_unit < 0.003
    assert error.drift < 0.001
    assert np.degrees(error.rotation) < 0.02


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


def _sequence(view: View, seed: int) -> RenderedSequence:
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
    error = registration_error(result.registration.alignment, sequence, "similarity")
    assert error.median < view.median
    assert error.percentile95 < view.percentile95
    seen = _shown(sequence, output, "similarity")
    assert seen.median < view.median
    assert seen.percentile95 < view.percentile95
    assert seen.coverage >= 0.97


@pytest.mark.parametrize(
    ("distortion", "seed"), sampled([(-0.25, 1), (-0.25, 2), (-0.12, 1), (-0.12, 2), (-0.4, 1), (-0.4, 2)])
)
def test_pair(distortion: float, seed: int, tmp_path: Path) -> None:
    lens = Camera((480, 360), distortion, focal=420.0)
    poses = pair_poses(lens, 0.3, yaw=0.1 * seed, direction=0.4 * seed, tilt=(0.03, -0.02))
    light = Photometry(gain=np.array([1.0, 1.1]), noise=0.005)
    sequence = sequence_over(lambda size: ground(size, seed), lens, poses, photometry=light, seed=seed)
    output = tmp_path / "pano.png"
    result = rdstitch.pano(sequence.write(tmp_path), output)
    assert abs(result.registration.alignment.distortion - distortion) <= 0.02
    assert registration_error(result.registration.alignment, sequence, "homography").median < 1.0
    seen = _shown(sequence, output, "homography")
    assert seen.median < 1.0
    assert seen.coverage > 0.97
