"""The image in whose frame all others lie before the camera."""

from dataclasses import replace

import numpy as np

from rdstitch.alignment.frames import frontal_reference, in_frame_of
from rdstitch.alignment.motion_models import POSE, PSI, X
from tests.alignment_scenes import aligned, scene


def test_an_oblique_reference_gives_way_to_one_whose_horizon_no_image_crosses() -> None:
    rng = np.random.default_rng(4)
    poses = np.zeros((3, 6))
    poses[:, X] = (0.0, 0.3, 0.6)
    given = scene(poses, rng=rng)
    found = aligned(given, model="homography", reference=0)
    poses[0, PSI] = 1.1
    to_images = POSE.matrices(poses, POSE.shared_from_physical(np.array([0.0, 0.0, 0.26]))).matrices
    tilted = replace(found, homographies=np.asarray(np.linalg.inv(to_images), dtype=np.float64))
    oblique = in_frame_of(tilted, 0)
    assert frontal_reference(oblique) in (1, 2)
    frontal = in_frame_of(oblique, 1)
    assert frontal_reference(frontal) == 1
    assert np.allclose(frontal.homographies[1], np.eye(3), atol=1e-9)
    for k in range(3):
        a, b = frontal.relation(k, 0), tilted.relation(k, 0)
        assert np.allclose(a / a[2, 2], b / b[2, 2], atol=1e-6)
