"""Matches that relief moves: right ones that a pair's plane does not explain.

Over rough ground a pair of images has many planes, and two-view estimation takes the one that explains the most: a
valley floor, one flank of a ridge. The next pair takes another one, and no camera fits them all. What lies off the
plane continues it, though: parallax changes from place to place as the ground does, and a match agrees with the
matches around it. Wrong matches do not, and what stands on the plane or moves on its own ends with a step.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from rdstitch.arrays import BoolArray
from rdstitch.geometry.division_model import undistort
from rdstitch.matching.two_view import PairRegistration
from rdstitch.numerics.nearest_points import nearest_points
from rdstitch.solvers.homography import direct_linear

_NEIGHBOURS = 6
"""Matches around one that it may continue: as many as a point has on average in a triangulation of the plane."""

_STEEPEST = 0.2
"""Pixels by which parallax changes from one pixel to the next: ground that climbs by 30 degrees, in two images that
are apart by a third of the camera's height."""

_ROUGH = 0.5
"""Matches off the planes, for each inlier of all pairs together, from which on the planes are not the ground. Below,
most pairs show one plane, and what is off it are outliers: buildings reach 0.4, a flat scene 0
(``python -m examples.benchmarks.relief``)."""


def over_rough_ground(pairs: Sequence[PairRegistration], threshold: float) -> Sequence[PairRegistration]:
    """The pairs with all matches that the ground explains as inliers, where it is not the plane that each shows.

    The same pairs where it is no rougher; otherwise homographies fit all of the inliers, and λ stays that of the
    planes. ``threshold``: largest transfer error of an inlier, pixels: by so much matches of one place differ.
    """
    related = [pair for pair in pairs if pair.relation]
    inliers = sum(int(pair.relation.inliers.sum()) for pair in related)
    if sum(len(pair.relation.inliers) for pair in related) - inliers < _ROUGH * inliers:
        return pairs
    rough = {pair.images: _continued(pair, threshold) for pair in related}
    if sum(int(explained.sum()) for explained in rough.values()) - inliers < _ROUGH * inliers:
        return pairs
    return [_fitted(pair, rough[pair.image1, pair.image2]) if pair.relation else pair for pair in pairs]


def _continued(pair: PairRegistration, threshold: float) -> BoolArray:
    """The inliers of a pair together with the matches that continue them, shape (N,)."""
    matched, inliers = pair.correspondences, pair.relation.inliers
    parallax = matched.points2 - pair.relation.transfer(matched.points1)
    distances, neighbours = nearest_points(matched.points1, matched.points1, _NEIGHBOURS + 1)
    with np.errstate(invalid="ignore"):
        change = np.linalg.norm(parallax[:, None] - parallax[neighbours], axis=2)
        continuing = change <= threshold + _STEEPEST * distances
    while True:
        more = inliers | (continuing & inliers[neighbours]).any(axis=1)
        if (more == inliers).all():
            return inliers
        inliers = more


def _fitted(pair: PairRegistration, inliers: BoolArray) -> PairRegistration:
    """A pair with other inliers, and the homography that fits them best."""
    matched, relation = pair.correspondences, pair.relation
    flat1, flat2 = (
        undistort(camera.normalize(points[inliers]), relation.distortion, relation.camera.higher)
        for camera, points in ((relation.camera, matched.points1), (relation.camera2, matched.points2))
    )
    seen = np.isfinite(flat1).all(axis=1) & np.isfinite(flat2).all(axis=1)
    homography = direct_linear(flat1[seen], flat2[seen])
    homography /= np.cbrt(np.linalg.det(homography))
    moved = relation.reexpressed(homography, relation.camera, relation.camera2)
    errors = np.linalg.norm(moved.transfer(matched.points1[inliers]) - matched.points2[inliers], axis=1)
    rms, reason = float(np.sqrt(np.nanmean(errors**2))), "the ground is no plane: the homography that fits it best"
    return replace(pair, relation=replace(moved, inliers=inliers, model="homography", rms=rms, reason=reason))
