"""Paths, surveys and the ground below them."""

import numpy as np
import pytest

from rdstitch.camera import Camera
from rdstitch.errors import ArgumentError
from rdstitch.synthetic import (
    EndlessTexture,
    ImageTexture,
    Poses,
    blank,
    drive_poses,
    fit_to_plane,
    gradient,
    grid_poses,
    pair_poses,
    repeated,
    sequence_over,
)

LENS = Camera((320, 240), -0.25, focal=260.0)


@pytest.mark.parametrize("direction", [0.0, 0.5 * np.pi])
@pytest.mark.parametrize("tilt", [(0.0, 0.0), (0.1, -0.08)])
def test_pairs_overlap_as_requested(direction: float, tilt: tuple[float, float]) -> None:
    """Along the middle row (or column), 70 % of the first image is not in the second."""
    poses, _ = fit_to_plane(LENS, pair_poses(LENS, 0.3, direction=direction, tilt=tilt))
    sequence = sequence_over(blank, LENS, poses)
    ends = [(-0.5, 119.5), (319.5, 119.5)] if direction == 0.0 else [(159.5, -0.5), (159.5, 239.5)]
    axis = 0 if direction == 0.0 else 1
    first, second = (sequence.to_plane(index, ends)[:, axis] for index in range(2))
    assert (first[1] - second[0]) / (first[1] - first[0]) == pytest.approx(0.3, abs=0.01)


def test_all_that_images_see_lies_on_the_plane() -> None:
    poses, (width, height) = fit_to_plane(LENS, grid_poses(LENS, 4, 3, yaw=0.3, shift=0.1, tilt=(0.05, 0.1)), margin=5)
    sequence = sequence_over(ImageTexture(np.zeros((height, width), np.uint8)), LENS, poses, margin=5)
    corners = np.array([(-0.5, -0.5), (319.5, -0.5), (319.5, 239.5), (-0.5, 239.5)])
    seen = np.concatenate([sequence.to_plane(index, corners) for index in range(12)])
    assert seen.min() > 4.0
    assert (seen < (width - 5, height - 5)).all()
    with pytest.raises(ArgumentError, match="texels"):
        sequence_over(blank((width - 1, height)), LENS, poses, margin=5)


def test_an_image_of_the_horizon_is_refused() -> None:
    with pytest.raises(ArgumentError, match="horizon"):
        fit_to_plane(LENS, Poses.of([(0.0, 0.0)], 260.0, 0.0, (1.3, 0.0)))


def test_motion_between_poses_is_the_homography_between_images() -> None:
    poses = grid_poses(LENS, 3, 2, yaw=3.0, tilt=(0.1, -0.2)).shaken(seed=1, height=0.2)
    from_plane = poses.from_plane()
    for i, j in ((0, 1), (4, 2), (5, 0)):
        h = from_plane[j] @ np.linalg.inv(from_plane[i])
        expected = poses.motion(i, j).homography()
        np.testing.assert_allclose(h / np.cbrt(np.linalg.det(h) / np.linalg.det(expected)), expected, atol=1e-12)
    with pytest.raises(ArgumentError, match="tilt"):
        poses.shaken(seed=1, tilt=0.1).motion(0, 1)


def test_parking_ends_parallel_and_aside() -> None:
    poses = drive_poses(LENS, "parking", 101)
    assert poses.yaw[-1] == pytest.approx(poses.yaw[0])
    assert np.ptp(poses.yaw) == pytest.approx(0.7)
    step = np.linalg.norm(np.diff(poses.position[:2], axis=0))
    assert abs(poses.position[-1, 1]) > 5.0 * step
    assert (np.diff(poses.position[:, 0]) < 0.0).sum() == 50


def test_endless_ground_is_the_same_wherever_it_is_cut() -> None:
    texture = EndlessTexture((100_000, 50_000), seed=5, channels=1)
    whole = texture.region(70_000, 30_000, 70_300, 30_200)
    np.testing.assert_array_equal(texture.region(70_100, 30_050, 70_200, 30_150), whole[50:150, 100:200])
    assert 0.05 < whole.std() < 0.4
    period = texture.region(70_000 + 2039, 30_000, 70_300 + 2039, 30_200)
    assert abs(np.corrcoef(whole.ravel(), period.ravel())[0, 1]) < 0.75
    seam = texture.region(2039 - 8, 0, 2039 + 8, 2000).mean(axis=2)
    steps = np.abs(np.diff(seam, axis=1)).mean(axis=0)
    assert steps[7] < 2.0 * np.median(steps)


def test_hopeless_textures_are_hopeless() -> None:
    assert np.ptp(blank((50, 40)).region(0, 0, 50, 40)) == 0.0
    assert np.abs(np.diff(gradient((500, 400)).region(0, 0, 500, 400), n=2, axis=0)).max() < 1e-6
    tiles = repeated((500, 400), 1, period=96).region(0, 0, 500, 400)
    np.testing.assert_array_equal(tiles[:, 96:192], tiles[:, :96])
