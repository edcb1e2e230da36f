"""A fisheye whose circle is smaller than its images: the circle is found, and what is black around it is no content."""

from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

import rdstitch
from rdstitch.cache import Cache
from rdstitch.inputs.image_circle import find_circle, with_image_circle
from rdstitch.inputs.source import read_sources
from rdstitch.io import DecodedImage, read_image
from rdstitch.synthetic import FisheyeLens, grid_poses, ground, sequence_over
from tests.acceptance.rendered import geometry

Grey = NDArray[np.float32]


def _grey(
    shape: tuple[int, int], radius: float, center: tuple[float, float], level: float = 120.0
) -> NDArray[np.float32]:
    rng = np.random.default_rng(1)
    u, v = np.meshgrid(np.arange(shape[1]), np.arange(shape[0]))
    content = level * rng.uniform(0.3, 1.7, shape)
    dark = 4.0 + rng.normal(0.0, 2.0, shape)
    return np.where(np.hypot(u - center[0], v - center[1]) <= radius, content, dark).astype(np.float32)


@pytest.mark.parametrize(("radius", "center"), [(110.0, (160.0, 120.0)), (140.0, (150.0, 122.0))])
def test_a_circle_is_found_also_where_the_longer_sides_cut_it_off(radius: float, center: tuple[float, float]) -> None:
    found = find_circle(_grey((240, 320), radius, center))
    assert found.center == pytest.approx(center, abs=1.0)
    assert found.radius == pytest.approx(radius, abs=1.0)


def test_other_dark_borders_are_no_circle() -> None:
    u, v = np.meshgrid(np.arange(320), np.arange(240))
    bright = _grey((240, 320), 1000.0, (0.0, 0.0))
    frame = (np.abs(u - 160) < 140) & (np.abs(v - 120) < 100)
    pincushion = np.hypot(u - 160, v - 120) < 130 + 60 * np.abs(np.sin(2 * np.arctan2(v - 120, u - 160)))
    for content in (frame, pincushion, np.ones_like(frame), np.zeros_like(frame)):
        assert find_circle(np.where(content, bright, np.float32(3.0)).astype(np.float32)) is None


def test_a_circular_fisheye_is_stitched_and_calibrated(tmp_path: Path) -> None:
    """Of 150 degrees: one plus λ in the frame of the image's corners would be below zero."""
    lens = FisheyeLens((480, 360), 165.0 / np.radians(75.0), offset=(4.0, -2.0), image_circle=165.0)
    poses = grid_poses(lens, 3, 3, overlap=0.88, yaw=np.pi, tilt=(0.03, -0.02), seed=3)
    sequence = sequence_over(lambda size: ground(size, 3, channels=1), lens, poses)
    files = sequence.write(tmp_path)
    result = rdstitch.mosaic(files)
    alignment = result.registration.alignment
    assert alignment.used.all()
    camera = alignment.cameras[0]
    assert camera.image_circle == pytest.approx(0.97 * 165.0, abs=2.0)
    assert camera.center == pytest.approx(lens.center, abs=0.3)
    inner = lens.center + 155.0 * np.array([(np.cos(a), np.sin(a)) for a in np.linspace(0.0, 6.0, 9)])
    ratio = np.linalg.norm(camera.undistort(inner) - camera.center, axis=1) / np.linalg.norm(
        lens.undistort(inner) - lens.center, axis=1
    )
    assert ratio == pytest.approx(ratio.mean(), rel=0.02)
    error = geometry(sequence, result, "similarity")
    assert error.median < 0.3
    camera.save(tmp_path / "camera.json")
    again = rdstitch.Camera.load(tmp_path / "camera.json")
    assert again.image_circle == camera.image_circle
    given = rdstitch.mosaic(files, options=rdstitch.StitchOptions(camera=again)).registration.alignment
    assert given.used.all()
    assert given.cameras[0].coefficients == camera.coefficients


def test_a_second_run_decodes_nothing_to_find_the_circle(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    lens = FisheyeLens((240, 180), 83.0 / np.radians(75.0), image_circle=83.0)
    poses = grid_poses(lens, 2, 2, overlap=0.9, seed=3)
    files = sequence_over(lambda size: ground(size, 3, channels=1), lens, poses).write(tmp_path)
    decoded: list[Path] = []

    def counted(path: Path, *given: Any) -> DecodedImage:
        decoded.append(path)
        return read_image(path, *given)

    monkeypatch.setattr("rdstitch.inputs.source.read_image", counted)
    found = []
    for _ in range(2):
        sources, _ = read_sources(files, skip_bad=False)
        with ThreadPoolExecutor(1) as executor:
            found.append(with_image_circle(sources, executor, Cache.at(tmp_path / "cache"), 0.6))
    assert decoded == files
    assert found[0] == found[1]
    assert found[0][0].camera.image_circle is not None
