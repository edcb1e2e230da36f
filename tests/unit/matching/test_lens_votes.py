"""Which pairs are heard on the lens."""

import numpy as np
import pytest

from rdstitch.camera import Camera
from rdstitch.features import Correspondences
from rdstitch.matching.feature_store import StoredMatches
from rdstitch.matching.lens_votes import Votes
from rdstitch.matching.two_view import PairRegistration
from rdstitch.robust import estimate_radial_homography

LENS = Camera((640, 480), -0.2, focal=520.0)


@pytest.mark.parametrize(("count", "votes"), [(20, 0), (29, 0), (30, 1), (120, 1)])
def test_few_inliers_have_no_vote(count: int, votes: int) -> None:
    points1 = np.random.default_rng(count).uniform((150.0, 100.0), (490.0, 380.0), (count, 2))
    flat = LENS.undistort(points1)
    points2 = LENS.distort(flat @ np.array([[0.96, 0.28], [-0.28, 0.96]]).T + (-130.0, 110.0))
    relation = estimate_radial_homography(points1, points2, LENS.image_size, focal=520.0)
    assert relation.inliers.all()
    indices = np.repeat(np.arange(count)[:, None], 2, axis=1)
    pair = PairRegistration(
        0, 1, StoredMatches.of(Correspondences(indices, points1, points2, np.ones(count))), relation
    )
    assert len(Votes.of([pair], 3.0)) == votes
