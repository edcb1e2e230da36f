"""Which pairs are heard on the lens."""

import numpy as np
import pytest

from rdstitch.arrays import FloatArray
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


def _votes(distortion: list[list[float]], covariance: FloatArray) -> Votes:
    count = len(distortion)
    chain = np.arange(count)
    return Votes(chain, chain + 1, np.array(distortion), np.tile(covariance, (count, 1, 1)))


OWN = np.array([[4e-4, 1e-4], [1e-4, 9e-4]])


def test_what_both_images_have_in_common_counts_little() -> None:
    alike, unlike = _votes([[-0.15, -0.15]], OWN), _votes([[-0.15, -0.25]], OWN)
    assert 2.0 * alike.mahalanobis_residuals(-0.2)[0] < unlike.mahalanobis_residuals(-0.2)[0]


def test_lenses_are_fitted_to_their_votes_by_least_sums_of_distances() -> None:
    rng = np.random.default_rng(0)
    first, second = -0.2 + 0.004 * rng.normal(size=(2, 60))
    votes = _votes(np.stack([first, second + 0.1], axis=1).tolist(), 1e-5 * np.eye(2))
    which = np.tile([0, 1], (60, 1))
    found = votes.fitted(which, np.array([0.0, 0.0, 0.7]))
    assert found[1] - found[0] == pytest.approx(0.1, abs=0.003)
    assert found[2] == 0.7  # no vote: it stays
    # One vote far off hardly moves the lenses: distances count, not their squares.
    spoiled = _votes([*votes.distortion[:59].tolist(), [0.9, -0.9]], 1e-5 * np.eye(2))
    assert np.abs(spoiled.fitted(which, np.array([0.0, 0.0])) - found[:2]).max() < 0.01
