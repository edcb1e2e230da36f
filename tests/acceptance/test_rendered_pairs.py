"""Two images with little overlap and strong distortion, no setting given: λ, and the stitched plane."""

from pathlib import Path

import numpy as np
import pytest

import rdstitch
from rdstitch.camera import Camera
from rdstitch.synthetic import Photometry, ground, pair_poses, sequence_over
from tests.acceptance.rendered import geometry, image
from tests.sampled import sampled


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
    assert geometry(sequence, result, "homography").median < 1.0
    seen = image(sequence, output, "homography")
    assert seen.median < 1.0
    assert seen.coverage > 0.97
