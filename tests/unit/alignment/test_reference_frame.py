"""The image in whose frame all others lie before the camera."""

from dataclasses import replace

import numpy as np
import pytest

from examples.worlds.alignment_scenes import aligned, scene
from rdstitch.alignment import Alignment
from rdstitch.alignment.frames import frontal_reference, in_frame_of
from rdstitch.alignment.motion_models import POSE, PSI, X
from rdstitch.arrays import FloatArray
from rdstitch.geometry.camera import Camera


def _tilted() -> Alignment:
    """Three images, the first of which is oblique."""
    poses = np.zeros((3, 6))
    poses[:, X] = (0.0, 0.3, 0.6)
    found = aligned(scene(poses, rng=np.random.default_rng(4)), model="homography", reference=0)
    poses[0, PSI] = 1.1
    to_images = POSE.matrices(poses, POSE.shared_from_physical(np.array([0.0, 0.0, 0.26]))).matrices
    return replace(found, homographies=np.asarray(np.linalg.inv(to_images), dtype=np.float64))


def test_an_oblique_reference_gives_way_to_one_whose_horizon_no_image_crosses() -> None:
    tilted = _tilted()
    oblique = in_frame_of(tilted, 0)
    assert frontal_reference(oblique) in (1, 2)
    frontal = in_frame_of(oblique, 1)
    assert frontal_reference(frontal) == 1
    assert np.allclose(frontal.homographies[1], np.eye(3), atol=1e-9)
    for k in range(3):
        a, b = frontal.relation(k, 0), tilted.relation(k, 0)
        assert np.allclose(a / a[2, 2], b / b[2, 2], atol=1e-6)


def test_each_border_is_undistorted_once_of_any_number_of_references(monkeypatch: pytest.MonkeyPatch) -> None:
    calls, found = list[int](), _tilted()
    many = replace(
        found,
        used=np.ones(60, dtype=np.bool_),
        cameras=found.cameras * 20,
        homographies=np.tile(found.homographies, (20, 1, 1)),
    )
    undistort = Camera.undistort

    def counted(self: Camera, points: FloatArray) -> FloatArray:
        calls.append(len(points))
        return undistort(self, points)

    monkeypatch.setattr(Camera, "undistort", counted)
    assert frontal_reference(in_frame_of(many, 0)) in (1, 2)
    assert len(calls) <= 60
