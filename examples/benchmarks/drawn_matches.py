"""Matches of a survey that are drawn instead of found, so that the stages after matching can be measured alone.

Places are spread over the ground; each image has those that it shows among its keypoints, with noise. Images that lie
near each other are matched by most of the keypoints that they share, an eighth of them wrong; one pair in a few
hundred joins images far apart by matches that agree with one another (a repeated pattern).
"""

from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from rdstitch.arrays import FloatArray, IntArray
from rdstitch.features import Correspondences
from rdstitch.geometry.camera import Camera
from rdstitch.geometry.radial_homography import RadialHomography
from rdstitch.matching.feature_store import StoredMatches
from rdstitch.matching.two_view import Pair, PairRegistration
from rdstitch.numerics.nearest_points import nearest_points
from rdstitch.synthetic import RenderedSequence
from rdstitch.synthetic.lenses import focal_length
from rdstitch.synthetic.poses import pixels_of_texels, plane_outline
from rdstitch.system.cache import Cache
from rdstitch.system.progress import Progress, silent

_KEYPOINTS = 400  # of an image
_NOISE = 0.25  # pixels
_FOUND, _SHARED, _WRONG = 0.8, 0.75, 0.12  # of places, of those that two images show, and of their matches
_NEIGHBOURS, _MATCHED = 10, 0.75  # images around each, and the share of these that is matched
_FEWEST, _PATTERN = 20, 40  # matches of a pair at least; of a pair far apart
_FALSE_PAIRS = 100  # images for each pair of images far apart
_DISTORTION_STD = 0.01


@dataclass(frozen=True)
class DrawnMatches:
    """Matches of the images of a sequence; it stands for :class:`rdstitch.matching.pair_estimator.PairEstimator`."""

    sequence: RenderedSequence
    store: Cache = field(default_factory=Cache.for_this_run)
    progress: Progress = silent

    @cached_property
    def keypoints(self) -> list[tuple[IntArray, FloatArray]]:
        """Of each image the numbers of the places, and where it shows them, pixels (K, 2)."""
        lens, from_plane = self.sequence.lens, self.sequence.poses.from_plane()
        outlines = plane_outline(lens, from_plane, 2)
        cell = np.ptp(outlines[0], axis=0)
        low, limit = outlines.min(axis=(0, 1)), np.array(lens.image_size) - 1.0
        result = []
        for k, outline in enumerate(outlines):
            first, last = (np.floor((edge - low) / cell).astype(int) for edge in (outline.min(0), outline.max(0)))
            cells = [(x, y) for x in range(first[0], last[0] + 1) for y in range(first[1], last[1] + 1)]
            places = [low + cell * np.random.default_rng((1, *c)).random((_KEYPOINTS, 2)) + cell * c for c in cells]
            numbers = [(c[0] * 100_003 + c[1]) * _KEYPOINTS + np.arange(_KEYPOINTS) for c in cells]
            random = np.random.default_rng((2, k))
            points = pixels_of_texels(lens, from_plane[k], np.concatenate(places))
            points += random.normal(0.0, _NOISE, points.shape)
            shown = ((points > 0.0) & (points < limit)).all(axis=1) & (random.random(len(points)) < _FOUND)
            result.append((np.concatenate(numbers)[shown], points[shown]))
        return result

    @cached_property
    def pairs(self) -> list[Pair]:
        """Those that are matched first."""
        position, random = self.sequence.poses.position, np.random.default_rng(3)
        near = nearest_points(position, position, _NEIGHBOURS + 1)[1]
        both = np.sort(np.stack([np.repeat(np.arange(len(near)), near.shape[1]), near.ravel()], axis=1), axis=1)
        both = np.unique(both[both[:, 0] != both[:, 1]], axis=0)
        kept = (random.random(len(both)) < _MATCHED) | (both[:, 1] - both[:, 0] == 1)
        return [(i, j) for i, j in both[kept].tolist()]

    @cached_property
    def false_pairs(self) -> list[Pair]:
        """Those of images far apart."""
        count, random = len(self.sequence), np.random.default_rng(4)
        drawn = np.sort(random.integers(0, count, (count // _FALSE_PAIRS, 2)), axis=1)
        return sorted({(i, j) for i, j in drawn.tolist() if j - i > 1} - {*self.pairs})

    def first(self) -> list[PairRegistration]:
        """All pairs that are matched first, the false ones among them."""
        found = [*self.estimate(self.pairs), *map(self._false, self.false_pairs)]
        return sorted(found, key=lambda pair: pair.images)

    def estimate(self, pairs: Iterable[Pair], distortion: float | None = None) -> list[PairRegistration]:
        """Pairs with their matches and their true homography."""
        return [self._matched(i, j, known=distortion is not None) for i, j in pairs]

    @property
    def _lens(self) -> Camera:
        assert isinstance(self.sequence.lens, Camera)
        return self.sequence.lens

    def _matched(self, i: int, j: int, *, known: bool) -> PairRegistration:
        (numbers1, points1), (numbers2, points2) = self.keypoints[i], self.keypoints[j]
        _, one, two = np.intersect1d(numbers1, numbers2, assume_unique=True, return_indices=True)
        random = np.random.default_rng((5, i, j))
        shared = random.random(len(one)) < _SHARED
        one, two = one[shared], two[shared]
        right = random.random(len(one)) >= _WRONG
        two[~right] = random.integers(0, len(points2), int((~right).sum()))
        lens = self._lens
        camera = Camera(lens.image_size, lens.distortion + random.normal(0.0, _DISTORTION_STD))
        if right.sum() < _FEWEST:
            relation = RadialHomography.failed("too few matches", camera, camera, len(right))
        else:
            from_plane, focal = self.sequence.from_plane, focal_length(lens) / camera.scale
            zoom = np.diag([focal, focal, 1.0])
            matrix = zoom @ from_plane(j) @ np.linalg.inv(zoom @ from_plane(i))
            matrix /= np.cbrt(np.linalg.det(matrix))
            std = np.inf if known else _DISTORTION_STD
            relation = RadialHomography(matrix, camera, camera, right, distortion_std=std, model="similarity")
        return self._pair(i, j, np.column_stack([one, two]), points1[one], points2[two], relation)

    def _false(self, pair: Pair) -> PairRegistration:
        random, lens = np.random.default_rng((6, *pair)), self._lens
        camera, shift = Camera(lens.image_size, lens.distortion), np.eye(3)
        shift[:2, 2] = random.uniform(-0.2, 0.2, 2)
        points = random.uniform((0.0, 0.0), lens.image_size, (_PATTERN, 2))
        relation = RadialHomography(shift, camera, camera, np.ones(_PATTERN, dtype=np.bool_), model="similarity")
        moved = relation.transfer(points) + random.normal(0.0, _NOISE, points.shape)
        seen = np.isfinite(moved).all(axis=1)
        relation = replace(relation, inliers=np.ones(int(seen.sum()), dtype=np.bool_))
        return self._pair(*pair, np.zeros((int(seen.sum()), 2)), points[seen], moved[seen], relation)

    def _pair(
        self, i: int, j: int, indices: FloatArray, points1: FloatArray, points2: FloatArray, relation: RadialHomography
    ) -> PairRegistration:
        matches = Correspondences(indices.astype(np.intp), points1, points2, np.full(len(indices), 0.5))
        stored = self.store.stored("matches", (i, j), lambda: matches)
        return PairRegistration(i, j, StoredMatches(stored, len(matches)), relation)
