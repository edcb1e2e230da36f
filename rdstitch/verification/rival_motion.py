"""Does something in the images move otherwise than the plane that was registered?

A vehicle ahead, a part of the robot, or a second plane has matches that agree with each other and not with the
alignment. Relief and chance have few of them, spread over nothing; a rival covers an area of its own. What decides
between two motions is the area that they cover, not the number of their matches: texture is not size.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from rdstitch.alignment import Alignment
from rdstitch.arrays import FloatArray
from rdstitch.camera import Camera
from rdstitch.matching.two_view import PairRegistration, estimation_batches
from rdstitch.messages import Message, names_of
from rdstitch.radial_homography import RadialHomography
from rdstitch.robust import EstimationOptions, PairMatches, RansacOptions, estimate_radial_homographies
from rdstitch.verification.competing_motions import MIN_INLIERS, Contest

_FAR = 3.0
"""Thresholds beyond which a match disagrees with the alignment: nearer, relief and the lens may be to blame."""

_CELLS = 16
"""Cells along the longer side of an image, by which area is counted."""

_MIN_DISAGREEMENT = 0.02
"""Of an image's diagonal: relief moves what stands on the plane by less."""

_MIN_APART = 0.05
"""Of an image's diagonal: the tops of trees and houses reach 0.02 to 0.03, vehicles 0.25 to 0.5."""

_MIN_SHARE = 0.1
"""Of the area that has either motion. Flights over trees and houses reach 0.08, vehicles over a tenth 0.09 to 0.5
(``python -m tests.benchmarks.trust --kind vehicle``)."""

_CONTESTED_SHARE = 0.45
"""From here on nobody can say which of the two motions is the plane's, unless the pixels do."""

_CLEAR_AGREEMENT = 0.55
"""Share of the overlaps from which on what looks alike there is the larger part: matches are where texture is."""

MIN_AGREEMENT = 0.4
"""Share of the overlaps that must look alike where there is a rival, unless that is seen to be the smaller one. The
plane fills what two images share of it, but for the rival: 0.2 to 0.9 in the same sets; a vehicle, where it was
registered instead, 0.15 to 0.36."""


@dataclass(frozen=True)
class RivalMotion:
    """What moves otherwise in one pair of images.

    Attributes
    ----------
    image1, image2 : int
        Indices of the images.
    area : int
        Cells of ``image1`` in which the rival has inliers and the plane has none.
    plane_area : int
        Cells in which the plane has inliers.
    center : (float, float)
        Median place of the rival's inliers in ``image1``, pixels.
    disagreement : float
        Median distance of the rival's inliers from where the alignment expects them, pixels.
    relation : RadialHomography, optional
        How the rival moves, of all matches of the pair; None where there is no rival.
    """

    image1: int
    image2: int
    area: int
    plane_area: int
    center: tuple[float, float]
    disagreement: float
    relation: RadialHomography | None = None

    @property
    def share(self) -> float:
        """Of the area that has either motion, in [0, 1]."""
        return self.area / max(self.area + self.plane_area, 1)

    @property
    def is_far(self) -> bool:
        """Whether it moves by more than tree tops do, as far as its images are known."""
        return self.relation is None or self.disagreement > _MIN_APART * 2.0 * self.relation.camera.half_diagonal


def find_rival_motions(
    alignment: Alignment, pairs: Sequence[PairRegistration], threshold: float, seed: int = 0
) -> list[RivalMotion]:
    """Search the matches that the alignment does not explain for a second motion, pair by pair.

    Parameters
    ----------
    alignment : Alignment
    pairs : sequence of PairRegistration
        With all their matches, right and wrong.
    threshold : float
        Largest transfer error of an inlier, pixels.
    seed : int

    Returns
    -------
    list of RivalMotion
        One for every pair of overlapping, aligned images; its area is 0 where there is no rival.
    """
    aligned = [pair for pair in pairs if alignment.used[pair.image1] and alignment.used[pair.image2]]
    rivals, limits = list[RivalMotion](), RansacOptions(threshold, seed=seed)
    for batch in estimation_batches(aligned):
        rests = [_Rest(alignment, pair, threshold) for pair in batch]
        rests = [rest for rest in rests if rest.agreeing.any()]
        tried = [rest for rest in rests if len(rest.unexplained) >= MIN_INLIERS]
        # All images have one lens.
        how = EstimationOptions("auto", alignment.cameras[aligned[0].image1].nearest_distortion, limits)
        relations = estimate_radial_homographies([rest.matches for rest in tried], how)
        found = {rest.images: rest.rival(relation) for rest, relation in zip(tried, relations, strict=True)}
        rivals += [found.get(rest.images, rest.nothing) for rest in rests]
    return rivals


def rival_share(rivals: Sequence[RivalMotion]) -> float:
    """Share of the area of all pairs together that moves otherwise, in [0, 1]."""
    total = sum(rival.area + rival.plane_area for rival in rivals)
    return sum(rival.area for rival in rivals) / max(total, 1)


def is_apart(rivals: Sequence[RivalMotion]) -> bool:
    """Whether what moves otherwise covers a good part of the images, and moves by more than tree tops do."""
    if rival_share(rivals) < _MIN_SHARE:
        return False
    return max(rivals, key=lambda rival: rival.area).is_far


def rival_messages(
    paths: Sequence[str],
    rivals: Sequence[RivalMotion],
    agreement: float,
    compared: Contest | None = None,
    *,
    lens_only: bool = False,
) -> list[Message]:
    """What to say of the rivals: nothing where they cover little, a failure where they may be the plane.

    Parameters
    ----------
    paths : sequence of str
        Of the images.
    rivals : sequence of RivalMotion
    agreement : float
        Share of the overlaps, [0, 1], that looks alike where the alignment puts the images; NaN where unknown.
    compared : Contest, optional
        What the pixels say of both motions, where they were compared.
    lens_only : bool
        Only the lens is wanted, which both motions show.
    """
    share = rival_share(rivals)
    if not rivals or (share < _MIN_SHARE and compared is None):
        return []
    worst = max(rivals, key=lambda rival: rival.area)
    images = (paths[worst.image1], paths[worst.image2])
    first, second = names_of(images)
    u, v = worst.center
    what = (
        f"{share:.0%} of what the images have in common moves differently from the rest, most of it around "
        f"({u:.0f}, {v:.0f}) of {first} when compared with {second}, by {worst.disagreement:.0f} pixels"
    )
    clear = agreement >= _CLEAR_AGREEMENT or (share < _CONTESTED_SHARE and not agreement < MIN_AGREEMENT)
    if compared is not None:
        clear = compared.won or (clear and not compared.lost)
    if lens_only or clear:
        more = f"; what was stitched fills {agreement:.0%} of the overlaps" if share >= _CONTESTED_SHARE else ""
        return [Message(f"{what} (a vehicle, a second plane?){more}; a mask keeps it out", images, code="rival-motion")]
    # It concerns all images: without the one that shows it best, the rival would only be harder to see.
    shown = sorted({k for rival in rivals for k in (rival.image1, rival.image2)})
    text = f"{what}, and it is not clear which of the two is the plane; mask what does not belong to it"
    return [Message(text, tuple(paths[k] for k in shown), "failure", "rival-motion")]


class _Rest:
    """Matches of a pair that an alignment does not explain.

    Attributes
    ----------
    images : (int, int)
    error : ndarray of shape (M,)
        Of all matches, pixels; infinite where the alignment puts a point nowhere.
    agreeing : ndarray of shape (M,), bool
    unexplained : ndarray of shape (U,), intp
        Matches far from where the alignment puts them.
    """

    def __init__(self, alignment: Alignment, pair: PairRegistration, threshold: float) -> None:
        self.images = pair.image1, pair.image2
        self._camera, self._other = (alignment.cameras[k] for k in self.images)
        self._matched = pair.correspondences
        expected = alignment.transfer(*self.images, self._matched.points1)
        self.error = np.nan_to_num(np.linalg.norm(expected - self._matched.points2, axis=1), nan=np.inf)
        self.agreeing = self.error < threshold
        self.unexplained = np.flatnonzero(~(self.error < _FAR * threshold))

    @property
    def matches(self) -> PairMatches:
        """As pairs are estimated from."""
        camera = self._camera.without_lens().with_focal()
        rest, matched = self.unexplained, self._matched
        other = camera.resized(self._other.image_size)
        return PairMatches(matched.points1[rest], matched.points2[rest], camera, other, -matched.ratio[rest])

    @cached_property
    def _plane(self) -> set[tuple[int, int]]:
        return _cells(self._matched.points1[self.agreeing], self._camera)

    @property
    def nothing(self) -> RivalMotion:
        """No rival."""
        return RivalMotion(*self.images, 0, len(self._plane), (0.0, 0.0), 0.0)

    def rival(self, found: RadialHomography) -> RivalMotion:
        """What the motion of these matches comes to."""
        if not found or int(found.inliers.sum()) < MIN_INLIERS:
            return self.nothing
        inliers = self.unexplained[found.inliers]
        disagreement = float(np.median(self.error[inliers]))
        if disagreement < _MIN_DISAGREEMENT * 2.0 * self._camera.half_diagonal:
            return self.nothing
        points = self._matched.points1[inliers]
        area = _cells(points, self._camera) - self._plane
        u, v = np.median(points, axis=0).tolist()
        relation = replace(found, inliers=np.isin(np.arange(len(self.error)), inliers))
        return RivalMotion(*self.images, len(area), len(self._plane), (u, v), disagreement, relation)


def _cells(points: FloatArray, camera: Camera) -> set[tuple[int, int]]:
    """The cells of a grid over the image that points (N, 2), pixels, lie in."""
    column, row = np.floor(points / (max(camera.image_size) / _CELLS)).astype(np.int64).T
    return set(zip(column.tolist(), row.tolist(), strict=True))
