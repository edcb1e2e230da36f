"""Does something in the images move differently from what was aligned, and which of the two is the plane?

A vehicle ahead, a part of the robot, or a second plane has matches that agree with each other and not with the
alignment. Relief and chance have few of them, spread over nothing; a second motion covers an area of its own.

How much of the overlaps looks alike does not say which is the plane: what moves with the camera is seen by all images,
and seen whole; the plane behind it is seen by neighbours, and hidden where they overlap. What says it is what
contradicts a motion. Something that hardly moves is put over nearly all of the next image, and most of that looks
different: it fills less than half of the images, for certain. The plane is put over a part only, and may fill all that
is not seen there.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from rdstitch.alignment import Alignment
from rdstitch.arrays import BoolArray, FloatArray, IntArray
from rdstitch.camera import Camera
from rdstitch.matching.two_view import Pair, PairRegistration, estimation_batches
from rdstitch.radial_homography import RadialHomography, from_plane, to_plane
from rdstitch.registration import Registration
from rdstitch.robust import EstimationOptions, PairMatches, RansacOptions, estimate_radial_homographies
from rdstitch.scipy_parts import spatial
from rdstitch.verification.overlap_check import CheckedLink, ComparedImages, share_alike
from rdstitch.verification.photometric_agreement import CELL, Agreement, ComparedCells, ComparedImage, compare_cells
from rdstitch.verification.self_similarity import Ambiguity

FILLED_BY_A_PLANE = 0.5
"""Share of the images that the plane fills at least: less is something in front of it."""

_FAR = 3.0
"""Thresholds beyond which a match disagrees with the alignment: nearer, relief and the lens may be to blame."""

_AREA_CELLS = 16
"""Cells along the longer side of an image, by which area is counted: texture is not size."""

_MIN_DISAGREEMENT, _MIN_FAR = 0.02, 0.05
"""Of an image's diagonal: relief moves what stands on the plane by less than the first, the tops of trees and houses by
less than the second; vehicles move by 0.25 to 0.5."""

_MIN_SHARE = 0.1
"""Of the area that has either motion. Flights over trees and houses reach 0.08, vehicles over a tenth 0.09 to 0.5
(``python -m examples.benchmarks.trust --kind vehicle``)."""

_MIN_HELD, _MIN_HELD_BY_PAIR = 0.3, 0.15
"""Share that looks alike of what the other motion does not explain, in all pairs together and in one. Planes reach 0.37
to 1, and 0.18 to 1, where a vehicle hides most of what two images share of them too; chance reaches 0.07."""

_MIN_CELLS = 8
"""Cells, below which there is too little to see."""

_NEIGHBOURS, _MIN_NEIGHBOURS, _REACH = 5, 2, 2.0 * CELL
"""Cells around a place, how many of them look alike at least where a motion holds, and how far they may be, pixels."""

_MIN_INLIERS = 12
"""Inliers of a motion: four define its homography, and eight more by chance have not been seen."""

_SAME_SHIFT = 0.05
"""Share of the longer side of an image by which two shifts differ that are the same: matches show theirs where they
are, pixels in the mean of all that they cover."""


@dataclass(frozen=True)
class SecondMotion:
    """What moves differently in one pair of images.

    Attributes
    ----------
    images : (int, int)
    area : int
        Cells of the first image in which it has inliers and the plane has none; 0 where nothing moves differently.
    plane_area : int
        Cells in which the plane has inliers.
    center : (float, float)
        Median place of its inliers in the first image, pixels.
    disagreement : float
        Median distance of its inliers from where the alignment expects them, pixels.
    relation : RadialHomography, optional
        How it moves, of all matches of the pair; None where there is none.
    """

    images: Pair
    area: int
    plane_area: int
    center: tuple[float, float] = (0.0, 0.0)
    disagreement: float = 0.0
    relation: RadialHomography | None = None

    @property
    def is_far(self) -> bool:
        """Whether it moves by more than tree tops do, as far as its images are known."""
        return self.relation is None or self.disagreement > _MIN_FAR * 2.0 * self.relation.camera.half_diagonal


def find_second_motions(
    alignment: Alignment, pairs: Sequence[PairRegistration], threshold: float
) -> list[SecondMotion]:
    """Search the matches that the alignment does not explain for a second motion, pair by pair.

    Parameters
    ----------
    pairs : sequence of PairRegistration
        With all their matches, right and wrong.
    threshold : float
        Largest transfer error of an inlier, pixels.

    Returns
    -------
    list of SecondMotion
        One for every pair of aligned images that have matches in common.
    """
    errors = {
        pair.images: pair.errors(alignment.transfer)
        for pair in pairs
        if alignment.used[pair.image1] and alignment.used[pair.image2]
    }
    compared = [pair for pair in pairs if pair.images in errors and (errors[pair.images] < threshold).any()]
    rests = {pair.images: np.flatnonzero(~(errors[pair.images] < _FAR * threshold)) for pair in compared}
    lens = alignment.cameras[compared[0].image1].nearest_distortion if compared else None  # all images have one
    found = _strongest_motions(alignment, compared, rests, lens, threshold)
    return [
        _second_motion(alignment, pair, errors[pair.images], threshold, found.get(pair.images)) for pair in compared
    ]


def _second_motion(
    alignment: Alignment, pair: PairRegistration, errors: FloatArray, threshold: float, found: RadialHomography | None
) -> SecondMotion:
    """What the motion of the matches that are left comes to."""
    camera, points = alignment.cameras[pair.image1], pair.correspondences.points1
    plane = _cells(points[errors < threshold], camera)
    disagreement = 0.0 if found is None else float(np.median(errors[found.inliers]))
    if found is None or disagreement < _MIN_DISAGREEMENT * 2.0 * camera.half_diagonal:
        return SecondMotion(pair.images, 0, len(plane))
    u, v = np.median(points[found.inliers], axis=0).tolist()
    area = _cells(points[found.inliers], camera) - plane
    return SecondMotion(pair.images, len(area), len(plane), (u, v), disagreement, found)


def _cells(points: FloatArray, camera: Camera) -> set[tuple[int, int]]:
    """The cells of a grid over the image that points (N, 2), pixels, lie in."""
    column, row = np.floor(points / (max(camera.image_size) / _AREA_CELLS)).astype(np.int64).T
    return set(zip(column.tolist(), row.tolist(), strict=True))


def _strongest_motions(
    alignment: Alignment,
    pairs: Sequence[PairRegistration],
    rests: Mapping[Pair, IntArray],
    lens: float | None,
    threshold: float,
) -> dict[Pair, RadialHomography]:
    """Of each pair the motion that most of some of its matches agree on, with the inliers among all."""
    result = {}
    how = EstimationOptions("auto", lens, RansacOptions(threshold))
    for batch in estimation_batches([pair for pair in pairs if len(rests[pair.images]) >= _MIN_INLIERS]):
        given = []
        for pair in batch:
            first, second = (alignment.cameras[k] for k in pair.images)
            camera = first.without_lens().with_focal()
            own, other = pair.correspondences.take(rests[pair.images]), camera.resized(second.image_size)
            given.append(PairMatches(own.points1, own.points2, camera, other, -own.ratio))
        for pair, motion in zip(batch, estimate_radial_homographies(given, how), strict=True):
            if motion and int(motion.inliers.sum()) >= _MIN_INLIERS:
                inliers = np.zeros(len(pair.matches), dtype=np.bool_)
                inliers[rests[pair.images][motion.inliers]] = True
                result[pair.images] = replace(motion, inliers=inliers)
    return result


def share_of(motions: Sequence[SecondMotion]) -> float:
    """Share of the area of all pairs together that moves differently, in [0, 1]."""
    return sum(own.area for own in motions) / max(sum(own.area + own.plane_area for own in motions), 1)


def is_separate(motions: Sequence[SecondMotion]) -> bool:
    """Whether what moves differently covers a good part of the images, and moves by more than tree tops do."""
    return share_of(motions) >= _MIN_SHARE and max(motions, key=lambda own: own.area).is_far


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

    @classmethod
    def moved(cls, images: ComparedImages, pair: Pair, motion: RadialHomography) -> Self:
        """Compare two images as a motion from one to the other puts them."""
        first = images.placed(pair[0], motion.camera, motion.homography)
        return cls.of(first, images.placed(pair[1], motion.camera2, np.eye(3)))


def fills_at_most(compared: Iterable[Cells]) -> float:
    """Share of the images of some pairs that is not seen to contradict a motion, in [0, 1]."""
    cells = list(compared)
    contradicting = sum(int((~own.confirming).sum()) for own in cells)
    return 1.0 - contradicting / max(sum(own.in_all for own in cells), 1)


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


def _share(agreements: Iterable[Agreement]) -> float:
    """Share that looks alike of all together, in [0, 1]; 1 where there is next to nothing to see."""
    found = list(agreements)
    count = sum(own.cells for own in found)
    return sum(own.confirming for own in found) / count if count >= _MIN_CELLS else 1.0


def _may_be_the_plane(cells: Cells, outside: Agreement) -> bool:
    """Whether nothing shows that what holds a pair together is smaller than the plane, or something else."""
    return fills_at_most([cells]) >= FILLED_BY_A_PLANE and _share([outside]) >= _MIN_HELD_BY_PAIR


@dataclass(frozen=True)
class MotionComparison:
    """What was aligned and what moves differently, compared with the pixels.

    Attributes
    ----------
    fills_at_most, second_fills_at_most : float
        Share of the images that is not seen to contradict the alignment, and what moves differently, in [0, 1].
    outside : mapping of (int, int) to Agreement
        Of every pair that was compared: how much looks alike where nothing moves differently in either image.
    doubtful : frozenset of (int, int)
        Pairs that what moves differently may hold together: what was aligned fills less than half of the images, or
        hardly anything looks alike where nothing moves differently.
    """

    fills_at_most: float
    second_fills_at_most: float
    outside: Mapping[Pair, Agreement]
    doubtful: frozenset[Pair]

    @property
    def won(self) -> bool:
        """Whether what was aligned is the plane: it may be, and the other fills less than half of the images."""
        held = _share(self.outside.values()) >= _MIN_HELD
        return not self.lost and held and self.second_fills_at_most < FILLED_BY_A_PLANE

    @property
    def lost(self) -> bool:
        """Whether what was aligned is not the plane: it fills less than half of the images."""
        return self.fills_at_most < FILLED_BY_A_PLANE


def compare_motions(
    alignment: Alignment, images: ComparedImages, motions: Sequence[SecondMotion], checked: Sequence[CheckedLink]
) -> MotionComparison | None:
    """Compare what was aligned over a plane with what moves differently, by the pixels.

    Only where the latter is a motion of its own and covers a good part; or where what was aligned fills less than half
    of the images, and something else moves in any of them. None otherwise.

    Raises
    ------
    InputError
        When an image can no longer be read.
    """
    second = {own.images: own.relation for own in motions if own.relation is not None}
    separate, far = is_separate(motions), any(own.relation is not None and own.is_far for own in motions)
    if alignment.on_sphere or not (separate or (far and share_alike(checked) < FILLED_BY_A_PLANE)):
        return None
    pairs = [link.pair for link in checked]
    placed = images.aligned(alignment, (k for pair in pairs for k in pair))
    own = {(i, j): Cells.of(placed[i], placed[j]) for i, j in pairs}
    others = {pair: Cells.moved(images, pair, second[pair]) for pair in pairs if pair in second}
    held = _Held(others.items())
    outside = {pair: held.outside(pair, cells) for pair, cells in own.items()}
    doubtful = frozenset(pair for pair, cells in own.items() if not _may_be_the_plane(cells, outside[pair]))
    found = MotionComparison(fills_at_most(own.values()), fills_at_most(others.values()), outside, doubtful)
    return found if separate or found.lost else None


def outside_second_motions(
    checked: Sequence[CheckedLink], motions: Sequence[SecondMotion], compared: MotionComparison | None
) -> Sequence[CheckedLink]:
    """The same links by what their images show where nothing moves differently, if that is the smaller part.

    A pair that fits as well where its second motion puts it shows no repeated pattern, but that.
    """
    if compared is None or not compared.won:
        return checked
    shifts = {
        own.images: own.disagreement / max(own.relation.camera.image_size)
        for own in motions
        if own.relation is not None
    }
    return [
        replace(
            link,
            agreement=compared.outside.get(link.pair, link.agreement),
            ambiguity=Ambiguity(link.ambiguity.here, 0.0, 0.0)
            if abs(link.ambiguity.shift - shifts.get(link.pair, np.inf)) <= _SAME_SHIFT
            else link.ambiguity,
        )
        for link in checked
    ]


def planes_of_pairs(registration: Registration, threshold: float) -> list[PairRegistration] | None:
    """Every pair by that of its two strongest motions which may fill more than half of its images.

    Each pair decides for itself: where two motions are about as strong, some pairs were registered by one and some by
    the other, and no alignment holds both.

    Returns
    -------
    list of PairRegistration or None
        None where no pair has a motion that fills less.

    Raises
    ------
    InputError
        When an image can no longer be read.
    """
    alignment, pairs = registration.alignment, [pair for pair in registration.pairs if pair.relation]
    images = ComparedImages(registration.sources, registration.stretch)
    first = {pair.images: pair.relation for pair in pairs}
    cells = {pair: Cells.moved(images, pair, motion) for pair, motion in first.items()}
    if all(fills_at_most([own]) >= FILLED_BY_A_PLANE for own in cells.values()):
        return None
    lens = float(np.median([motion.distortion for motion in first.values()]))
    rests = {pair: np.flatnonzero(~motion.inliers) for pair, motion in first.items()}
    second = _strongest_motions(alignment, pairs, rests, lens, threshold)
    candidates = [(pair, motion, cells[pair]) for pair, motion in first.items()]
    candidates += [(pair, motion, Cells.moved(images, pair, motion)) for pair, motion in second.items()]
    held = _Held((pair, own) for pair, _, own in candidates if fills_at_most([own]) < FILLED_BY_A_PLANE)
    best: dict[Pair, tuple[float, RadialHomography]] = {}
    for pair, motion, own in candidates:
        fills = fills_at_most([own])
        if (pair not in best or fills > best[pair][0]) and _may_be_the_plane(own, held.outside(pair, own)):
            best[pair] = fills, motion
    return [
        replace(pair, relation=best[pair.images][1] if pair.images in best else _no_plane(pair))
        if pair.relation
        else pair
        for pair in registration.pairs
    ]


def _no_plane(pair: PairRegistration) -> RadialHomography:
    own, reason = pair.relation, "what the two share fills less than half of them (a vehicle?)"
    return RadialHomography.failed(reason, own.camera, own.camera2, len(own.inliers))
