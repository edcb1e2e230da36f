"""The same pixels twice are no evidence."""

import numpy as np
import pytest

import rdstitch
from rdstitch.geometry.camera import Camera
from rdstitch.synthetic import Photometry, grid_poses, ground, sequence_over

OPTIONS = rdstitch.StitchOptions(workers=1, features=rdstitch.FeatureOptions(max_features=500))


@pytest.mark.parametrize("place", [0, 1, 3])
def test_a_copy_changes_nothing_and_lies_where_its_image_does(place: int) -> None:
    lens = Camera((320, 240), distortion=-0.15, focal=300.0)
    poses = grid_poses(lens, 3, 1, overlap=0.5, yaw=0.2, seed=3)
    taken = sequence_over(lambda size: ground(size, seed=3), lens, poses, photometry=Photometry(noise=0.01), seed=3)
    frames = taken.frames()
    saved_again = np.clip(frames[1].astype(int) + np.random.default_rng(0).integers(-1, 2, frames[1].shape), 0, 255)
    with_copy = [*frames]
    with_copy.insert(place, saved_again.astype(frames[1].dtype))
    alone, found = (rdstitch.mosaic(images, None, OPTIONS).registration for images in (frames, with_copy))
    assert found.alignment.used.all()
    original = 2 if place <= 1 else 1
    np.testing.assert_array_equal(found.alignment.homographies[original], found.alignment.homographies[place])
    assert found.alignment.distortion_std == pytest.approx(alone.alignment.distortion_std, rel=0.1)
    assert abs(found.alignment.distortion - alone.alignment.distortion) < 0.3 * alone.alignment.distortion_std
    assert [message.code for message in found.alignment.messages].count("copies") == 1
