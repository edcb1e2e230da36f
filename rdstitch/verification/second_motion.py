"""Does something in the images move differently from what was aligned, and which of the two is the plane?

A vehicle ahead, a part of the robot, or a second plane has matches that agree with each other and not with the
alignment. Relief and chance have few of them, spread over nothing; a second motion covers an area of its own.

What contradicts a motion says which is the plane. Something that hardly moves is put over nearly all of the next image,
and most of that looks different: it fills less than half of the images, for certain. The plane is put over a part only,
and may fill all that is not seen there.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from rdstitch.alignment import Alignment
from rdstitch.arrays import FloatArray, IntArray
from rdstitch.executors import batches
from rdstitch.geometry.camera import Camera
from rdstitch.geometry.radial_homography import RadialHomography
from rdstitch.matching.two_view import PAIRS_ESTIMATED_AT_ONCE, Pair, PairRegistration
from rdstitch.results.registration import Registration
from rdstitch.robust import EstimationOptions, PairMatches, estimate_radial_homographies
from rdstitch.verification.limits import limit
from rdstitch.verification.overlap_check import CheckedLink, ComparedImages
from rdstitch.verification.photometric_agreement import Agreement, overlap_agreement

_AREA_CELLS = 16
"""Cells along the longer side of an image, by which area is counted: texture is not size."""


@dataclass(frozen=True)
class SecondMotion:
    """What moves differently in one pair of images."""

    images: Pair
    # cells of the first image in which it has inliers and the plane has none; 0 where nothing moves differently
    area: int
    plane_area: int  # cells in which the plane has inliers
    center: tuple[float, float] = (0.0, 0.0)  # median place of its inliers in the first image, pixels
    disagreement: float = 0.0  # median distance of its inliers from where the alignment expects them, pixels
    relation: RadialHomography | None = None  # how it moves, of all matches of the pair; None where there is none

    @property
    def is_far(self) -> bool:
        """Whether it moves by more than tree tops do, as far as its images are known."""
        return self.relation is None or self.disagreement > limit("far motion") * 2.0 * self.relation.camera.scale


def find_second_motions(
    alignment: Alignment, pairs: Sequence[PairRegistration], threshold: float
) -> list[SecondMotion]:
    """Search the matches that the alignment does not explain for a second motion, pair by pair.

    ``pairs``: with all their matches, right and wrong; ``threshold``: largest transfer error of an inlier, pixels;
    gives one for every pair of aligned images that have matches in common.
    """
    errors = {
        pair.images: pair.errors(alignment.transfer)
        for pair in pairs
        if alignment.used[pair.image1] and alignment.used[pair.image2]
    }
    compared = [pair for pair in pairs if pair.images in errors and (errors[pair.images] < threshold).any()]
    rests = {
        pair.images: np.flatnonzero(~(errors[pair.images] < limit("off the plane") * threshold)) for pair in compared
    }
    lens = alignment.cameras[compared[0].image1].nearest_distortion if compared else None  # all images have one
    strongest = _strongest_motions(alignment, compared, rests, lens, threshold)
    return [
        _second_motion(alignment, pair, errors[pair.images], threshold, strongest.get(pair.images)) for pair in compared
    ]


def _second_motion(
    alignment: Alignment, pair: PairRegistration, errors: FloatArray, threshold: float, motion: RadialHomography | None
) -> SecondMotion:
    """What the motion of the matches that are left comes to."""
    camera, points = alignment.cameras[pair.image1], pair.correspondences.points1
    plane = _cells(points[errors < threshold], camera)
    disagreement = 0.0 if motion is None else float(np.median(errors[motion.inliers]))
    if motion is None or disagreement < limit("motion") * 2.0 * camera.scale:
        return SecondMotion(pair.images, 0, len(plane))
    u, v = np.median(points[motion.inliers], axis=0).tolist()
    area = _cells(points[motion.inliers], camera) - plane
    return SecondMotion(pair.images, len(area), len(plane), (u, v), disagreement, motion)


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
    how = EstimationOptions(distortion=lens, threshold=threshold)
    enough = [pair for pair in pairs if len(rests[pair.images]) >= limit("inliers of a motion")]
    for batch in batches(enough, PAIRS_ESTIMATED_AT_ONCE):
        given = []
        for pair in batch:
            first, second = (alignment.cameras[k] for k in pair.images)
            camera = first.without_lens().with_focal()
            matches, other = pair.correspondences.take(rests[pair.images]), camera.resized(second.image_size)
            given.append(PairMatches(matches.points1, matches.points2, camera, other, -matches.ratio))
        for pair, motion in zip(batch, estimate_radial_homographies(given, how), strict=True):
            if motion and int(motion.inliers.sum()) >= limit("inliers of a motion"):
                inliers = np.zeros(len(pair.matches), dtype=np.bool_)
                inliers[rests[pair.images][motion.inliers]] = True
                result[pair.images] = replace(motion, inliers=inliers)
    return result


def share_of(motions: Sequence[SecondMotion]) -> float:
    """Share of the area of all pairs together that moves differently, in [0, 1]."""
    return sum(motion.area for motion in motions) / max(sum(motion.area + motion.plane_area for motion in motions), 1)


def fills_at_most(compared: Iterable[Agreement]) -> float:
    """Share of the images of some pairs that is not seen to contradict a motion, in [0, 1]."""
    agreements = list(compared)
    contradicting = sum(agreement.cells - agreement.confirming for agreement in agreements)
    return 1.0 - contradicting / max(sum(agreement.in_all for agreement in agreements), 1)


def _may_be_a_plane(agreement: Agreement) -> bool:
    return fills_at_most([agreement]) >= limit("filled by a plane")


def is_clear(images: ComparedImages, motions: Sequence[SecondMotion], checked: Sequence[CheckedLink]) -> bool:
    """Whether what was aligned may fill more than half of the images, and what moves differently does not."""
    second = {motion.images: motion.relation for motion in motions if motion.relation is not None}
    moved = [_moved(images, link.pair, second[link.pair]) for link in checked if link.pair in second]
    half, other = limit("filled by a plane"), fills_at_most(moved) if moved else share_of(motions)
    return fills_at_most(link.agreement for link in checked) >= half and other < half


def explains(images: ComparedImages, motion: SecondMotion, link: CheckedLink) -> bool:
    """Whether a pair fits as well elsewhere because something smaller moved there, not for a pattern."""
    if motion.relation is None:
        return False
    shift = motion.disagreement / max(motion.relation.camera.image_size)
    near = abs(link.ambiguity.shift - shift) <= limit("same shift")
    return near and not _may_be_a_plane(_moved(images, link.pair, motion.relation))


def _moved(images: ComparedImages, pair: Pair, motion: RadialHomography) -> Agreement:
    """How much of two images looks alike as a motion from one to the other puts them."""
    first = images.placed(pair[0], motion.camera, motion.homography)
    return overlap_agreement(first, images.placed(pair[1], motion.camera2, np.eye(3)))


def planes_of_pairs(registration: Registration, threshold: float) -> list[PairRegistration] | None:
    """Every pair by that of its two strongest motions which may fill more than half of its images.

    Each pair decides for itself: where two motions are about as strong, some pairs were registered by one and some by
    the other, and no alignment holds both.

    Gives none where no pair has a motion that fills less.
    """
    alignment, pairs = registration.alignment, [pair for pair in registration.pairs if pair.relation]
    images = ComparedImages(registration.sources, registration.stretch)
    first = {pair.images: pair.relation for pair in pairs}
    candidates = [(pair, motion, _moved(images, pair, motion)) for pair, motion in first.items()]
    if all(_may_be_a_plane(agreement) for *_, agreement in candidates):
        return None
    rests = {pair: np.flatnonzero(~motion.inliers) for pair, motion in first.items()}
    # λ of the first ones may be that of a vehicle, whose image hardly changes.
    second = _strongest_motions(alignment, pairs, rests, None, threshold)
    candidates += [(pair, motion, _moved(images, pair, motion)) for pair, motion in second.items()]
    fills = [fills_at_most([agreement]) for *_, agreement in candidates]
    best: dict[Pair, RadialHomography] = {}
    for k in np.argsort(fills, kind="stable").tolist():  # the last one of a pair fills the most
        pair, motion, agreement = candidates[k]
        if _may_be_a_plane(agreement):
            best[pair] = motion
    return [
        replace(pair, relation=best.get(pair.images, _no_plane(pair))) if pair.relation else pair
        for pair in registration.pairs
    ]


def _no_plane(pair: PairRegistration) -> RadialHomography:
    relation, reason = pair.relation, "what the two share fills less than half of them (something that moved?)"
    return RadialHomography.failed(reason, relation.camera, relation.camera2, len(relation.inliers))
