"""Of two motions in the same images, which is the plane's?

How much of the overlaps looks alike does not say: what moves with the camera is seen by all images, and seen whole;
the plane behind it is seen by neighbours, and hidden where they overlap. What tells is what contradicts a motion.
Something that hardly moves is put over nearly all of the next image, and most of that looks different: it fills less
than half of the images, for certain. The plane is put over a part only, and may fill all that is not seen there.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Self

import numpy as np

from rdstitch.alignment import Alignment
from rdstitch.arrays import BoolArray, FloatArray, IntArray
from rdstitch.camera import Camera
from rdstitch.matching.two_view import PairRegistration, estimation_batches
from rdstitch.radial_homography import RadialHomography, from_plane, to_plane
from rdstitch.registration import Registration
from rdstitch.robust import EstimationOptions, PairMatches, RansacOptions, estimate_radial_homographies
from rdstitch.scipy_parts import spatial
from rdstitch.verification.overlap_check import placed_image
from rdstitch.verification.photometric_agreement import CELL, Agreement, ComparedCells, ComparedImage, compare_cells

Pair = tuple[int, int]

FILLED_BY_A_PLANE = 0.5
"""Share of the images that the plane fills at least: less is something in front of it."""

_MIN_HELD, _MIN_HELD_BY_PAIR = 0.3, 0.15
"""Share that looks alike of what the other motion does not explain, in all pairs together and in one. Planes reach 0.37
to 1, and 0.18 to 1, where a vehicle hides most of what two images share of them too; chance reaches 0.07."""

_MIN_CELLS = 8
"""Cells, below which there is too little to see."""

_NEIGHBOURS, _MIN_NEIGHBOURS = 5, 2
"""Cells around a place, and how many of them look alike at least where a motion holds, or may hold."""

_REACH = 2.0 * CELL
"""Pixels of the compared images that these may be away."""

MIN_INLIERS = 12
"""Inliers of a motion: four define its homography, and eight more by chance have not been seen."""

_IMAGES_AT_ONCE = 64
"""Images that are kept while pairs are compared, 1 MB each."""


@dataclass(frozen=True)
class Cells(ComparedCells):
    """What the pixels of a pair say of a motion.

    Attributes
    ----------
    centers_in_first : ndarray of shape (N, 2)
        Where the motion puts the cells that were compared, pixels of the first image as it is compared.
    """

    centers_in_first: FloatArray

    @classmethod
    def of(cls, first: ComparedImage, second: ComparedImage) -> Self:
        """Compare two images where they are put."""
        cells = compare_cells(first, second)
        there = from_plane(first.camera, first.homography, to_plane(second.camera, second.homography, cells.centers))
        seen = np.isfinite(there).all(axis=1)
        return cls(cells.centers[seen], cells.confirming[seen], cells.in_all, there[seen])

    @property
    def contradicting(self) -> int:
        """How many do not look alike."""
        return int((~self.confirming).sum())

    @property
    def fill_a_plane(self) -> bool:
        """Whether nothing shows that the motion fills less than half of the images."""
        return fills_at_most([self]) >= FILLED_BY_A_PLANE


class _Held:
    """Where in each image a motion holds, by what was compared in any pair."""

    def __init__(self, compared: Iterable[tuple[Pair, Cells]]) -> None:
        found: dict[int, list[tuple[FloatArray, BoolArray]]] = {}
        for (i, j), cells in compared:
            found.setdefault(i, []).append((cells.centers_in_first, cells.confirming))
            found.setdefault(j, []).append((cells.centers, cells.confirming))
        self._places = {k: spatial.cKDTree(np.concatenate([places for places, _ in own])) for k, own in found.items()}
        # One more, for places that have fewer neighbours.
        self._held = {k: np.concatenate([*(held for _, held in own), [False]]) for k, own in found.items()}

    def _around(self, image: int, points: FloatArray) -> BoolArray:
        """Around which of some points (N, 2) of an image enough of the cells look alike."""
        if image not in self._places or not len(points):
            return np.zeros(len(points), dtype=np.bool_)
        nearest = np.arange(1, min(_NEIGHBOURS, self._places[image].n) + 1)
        _, cells = self._places[image].query(points, k=nearest, distance_upper_bound=_REACH)
        return np.asarray(self._held[image][cells].sum(axis=1) >= _MIN_NEIGHBOURS)

    def outside(self, pair: Pair, cells: Cells) -> Agreement:
        """How much of a pair looks alike by another motion, where this one holds in neither of its images."""
        explained = self._around(pair[0], cells.centers_in_first) | self._around(pair[1], cells.centers)
        return Agreement(int((~explained).sum()), int((cells.confirming & ~explained).sum()))


def fills_at_most(compared: Iterable[Cells]) -> float:
    """Share of the images of some pairs that is not seen to contradict a motion, in [0, 1]."""
    cells = list(compared)
    return 1.0 - sum(own.contradicting for own in cells) / max(sum(own.in_all for own in cells), 1)


def _share(agreements: Iterable[Agreement]) -> float:
    """Share that looks alike of all together, in [0, 1]; 1 where there is next to nothing to see."""
    found = list(agreements)
    count = sum(own.cells for own in found)
    return sum(own.confirming for own in found) / count if count >= _MIN_CELLS else 1.0


@dataclass(frozen=True)
class Contest:
    """An alignment and what moves otherwise, compared with the pixels.

    Attributes
    ----------
    fills_at_most : float
        Share of the images that is not seen to contradict the alignment, in [0, 1].
    rival_fills_at_most : float
        The same of what moves otherwise; 1 where nothing does.
    outside : mapping of (int, int) to Agreement
        Of every pair that was compared: how much looks alike where nothing moves otherwise in either image.
    doubtful : frozenset of (int, int)
        Pairs that what moves otherwise may hold together: what was aligned fills less than half of the images, or
        hardly anything looks alike where nothing moves otherwise.
    """

    fills_at_most: float
    rival_fills_at_most: float
    outside: Mapping[Pair, Agreement]
    doubtful: frozenset[Pair]

    @property
    def held(self) -> float:
        """Share that looks alike where nothing moves otherwise, in [0, 1]."""
        return _share(self.outside.values())

    @property
    def won(self) -> bool:
        """Whether what was aligned is the plane: it may be, and the rival fills less than half of the images."""
        return not self.lost and self.held >= _MIN_HELD and self.rival_fills_at_most < FILLED_BY_A_PLANE

    @property
    def lost(self) -> bool:
        """Whether what was aligned is not the plane: it fills less than half of the images."""
        return self.fills_at_most < FILLED_BY_A_PLANE


def contest(registration: Registration, pairs: Sequence[Pair], rivals: Mapping[Pair, RadialHomography]) -> Contest:
    """Compare an alignment over a plane with what moves otherwise in some of its pairs.

    Parameters
    ----------
    registration : Registration
    pairs : sequence of (int, int)
        Those to be compared.
    rivals : mapping of (int, int) to RadialHomography
        How something moves otherwise in some of them.

    Raises
    ------
    InputError
        When an image can no longer be read.
    """
    images = _Images(registration)
    own = {pair: images.aligned(pair, registration.alignment) for pair in pairs}
    others = {pair: images.moved(pair, rivals[pair]) for pair in pairs if pair in rivals}
    held = _Held(others.items())
    outside = {pair: held.outside(pair, cells) for pair, cells in own.items()}
    doubtful = {pair for pair, cells in own.items() if not _may_be_the_plane(cells, outside[pair])}
    return Contest(fills_at_most(own.values()), fills_at_most(others.values()), outside, frozenset(doubtful))


def _may_be_the_plane(cells: Cells, outside: Agreement) -> bool:
    """Whether nothing shows that what holds a pair together is smaller than the plane, or something else."""
    return cells.fill_a_plane and _share([outside]) >= _MIN_HELD_BY_PAIR


def planes_of_pairs(registration: Registration, threshold: float, seed: int = 0) -> list[PairRegistration] | None:
    """Every pair by that of its two motions which may fill more than half of its images.

    Each pair decides for itself: where two motions are about as strong, some pairs were registered by one and some by
    the other, and no alignment holds both.

    Parameters
    ----------
    registration : Registration
    threshold : float
        Largest transfer error of an inlier, pixels.
    seed : int

    Returns
    -------
    list of PairRegistration or None
        None where no pair has a motion that fills less.

    Raises
    ------
    InputError
        When an image can no longer be read.
    """
    pairs = [pair for pair in registration.pairs if pair.relation]
    images, alignment = _Images(registration), registration.alignment
    limits = RansacOptions(threshold, seed=seed)
    known = alignment.distortion if alignment.distortion_std == 0.0 else None
    first = _strongest_motions(images, pairs, {}, EstimationOptions("auto", known, limits))
    if all(motion.cells.fill_a_plane for motion in first.values()):
        return None
    lens = float(np.median([motion.relation.distortion for motion in first.values()]))
    second = _strongest_motions(images, pairs, first, EstimationOptions("auto", lens, limits))
    motions = [(pair, motion) for found in (first, second) for pair, motion in found.items()]
    held = _Held((pair, motion.cells) for pair, motion in motions if not motion.cells.fill_a_plane)
    planes: dict[Pair, _Motion] = {}
    for pair, motion in motions:
        rest, best = held.outside(pair, motion.cells), planes.get(pair)
        more = best is None or fills_at_most([motion.cells]) > fills_at_most([best.cells])
        if more and _may_be_the_plane(motion.cells, rest):
            planes[pair] = motion
    return [_moving(pair, planes.get((pair.image1, pair.image2))) for pair in registration.pairs]


@dataclass(frozen=True)
class _Motion:
    """A motion of a pair, and what its pixels say of it."""

    relation: RadialHomography
    cells: Cells


def _moving(pair: PairRegistration, motion: _Motion | None) -> PairRegistration:
    """A pair by another motion; one that was registered by none that may be the plane's was not registered."""
    own = pair.relation
    if motion is not None:
        return replace(pair, relation=motion.relation)
    if not own:
        return pair
    reason = "what the two share fills less than half of them (a vehicle?)"
    return replace(pair, relation=RadialHomography.failed(reason, own.camera, own.camera2, len(own.inliers)))


class _Images:
    """The images of a registration, small, as pairs of them are compared."""

    def __init__(self, registration: Registration) -> None:
        @lru_cache(_IMAGES_AT_ONCE)
        def read(k: int) -> ComparedImage:
            camera = registration.alignment.cameras[k]
            return placed_image(registration.sources[k], camera, np.eye(3), registration.stretch)

        self._read = read

    def _placed(self, k: int, camera: Camera, homography: FloatArray) -> ComparedImage:
        image = self._read(k)
        return replace(image, camera=camera.resized(image.camera.image_size), homography=homography)

    def aligned(self, pair: Pair, alignment: Alignment) -> Cells:
        """As an alignment puts two of them."""
        return Cells.of(*(self._placed(k, alignment.cameras[k], alignment.homographies[k]) for k in pair))

    def moved(self, pair: Pair, motion: RadialHomography) -> Cells:
        """As a motion from one to the other puts them."""
        first = self._placed(pair[0], motion.camera, motion.homography)
        return Cells.of(first, self._placed(pair[1], motion.camera2, np.eye(3)))


def _strongest_motions(
    images: _Images, pairs: Sequence[PairRegistration], former: Mapping[Pair, _Motion], how: EstimationOptions
) -> dict[Pair, _Motion]:
    """Of each pair the motion that most of the matches agree on, of those that a former one does not explain."""
    result = {}
    for batch in estimation_batches(pairs):
        places = [(pair.image1, pair.image2) for pair in batch]
        rests = [
            np.flatnonzero(~former[place].relation.inliers) if place in former else np.arange(len(pair.matches))
            for place, pair in zip(places, batch, strict=True)
        ]
        tried = [k for k, rest in enumerate(rests) if len(rest) >= MIN_INLIERS]
        found = estimate_radial_homographies([_matches(batch[k], rests[k]) for k in tried], how)
        for k, motion in zip(tried, found, strict=True):
            if motion and int(motion.inliers.sum()) >= MIN_INLIERS:
                inliers = np.isin(np.arange(len(batch[k].matches)), rests[k][motion.inliers])
                result[places[k]] = _Motion(replace(motion, inliers=inliers), images.moved(places[k], motion))
    return result


def _matches(pair: PairRegistration, chosen: IntArray) -> PairMatches:
    """Some of the matches of a pair, as pairs are estimated from."""
    own, matched = pair.relation, pair.correspondences.take(chosen)
    camera = own.camera.without_lens().with_focal()
    other = camera.resized(own.camera2.image_size)
    return PairMatches(matched.points1, matched.points2, camera, other, -matched.ratio)
