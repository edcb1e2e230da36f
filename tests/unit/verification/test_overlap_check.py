"""Which overlaps are compared, and how many agree."""

import numpy as np

from rdstitch.alignment.motion_models.rotation import rotation_from_vector
from rdstitch.alignment.result import LinkFit
from rdstitch.camera import Camera
from rdstitch.verification import overlap_check
from rdstitch.verification.overlap_check import _least_confirmed
from rdstitch.verification.photometric_agreement import ComparedImage


def _fit(i: int, j: int, inliers: int = 50) -> LinkFit:
    return LinkFit(i, j, 100, inliers, 0.5, True)


def test_of_few_links_all_are_compared() -> None:
    links = [_fit(i, i + 1) for i in range(40)]
    assert _least_confirmed(links) == links


def test_of_many_those_with_the_fewest_triangles_and_matches_are_compared() -> None:
    """A clique of nine has 36 links in seven triangles each; a chain of 20 hangs on it."""
    clique = [_fit(i, j) for i in range(9) for j in range(i + 1, 9)]
    chain = [_fit(k, k + 1, 30 + k) for k in range(8, 28)]
    chosen = _least_confirmed([*clique, *chain])
    assert len(chosen) == 40
    assert set(chain) <= set(chosen)
    weak = [_fit(fit.image1, fit.image2, 10 if fit.image1 == 3 else 50) for fit in clique]
    chosen = _least_confirmed([*weak, *chain])
    assert {fit for fit in weak if fit.inliers == 10} <= set(chosen)
    assert chosen == [fit for fit in [*weak, *chain] if fit in chosen]


def test_a_turn_is_compared_between_the_two_images() -> None:
    """Halfway between two directions, each image is tilted by half the angle."""
    first, last, half = (rotation_from_vector(np.array([[0.0, angle, 0.0]]))[0] for angle in (0.1, 0.4, 0.15))
    focal = np.diag([0.7, 0.7, 1.0])  # half diagonals to directions
    grey = np.zeros((2, 2), np.float32)
    both = overlap_check._between(*(ComparedImage(grey, Camera((64, 48)), turn @ focal) for turn in (first, last)))
    np.testing.assert_allclose(both[0].homography, half.T @ focal, atol=1e-9)
    np.testing.assert_allclose(both[1].homography, half @ focal, atol=1e-9)
