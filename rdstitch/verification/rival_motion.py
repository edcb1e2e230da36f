"""Does something in the pictures move otherwise than the plane that was registered?

A vehicle ahead, a part of the robot, or a second plane has matches that agree with each other and not with the
alignment. Relief and chance have few of them, spread over nothing; a rival covers an area of its own. What decides
between two motions is the area that they cover, not the number of their matches: texture is not size.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from rdstitch.alignment import Alignment
from rdstitch.arrays import BoolArray, FloatArray
from rdstitch.camera import Camera
from rdstitch.matching.two_view import PairRegistration
from rdstitch.messages import Message, names_of
from rdstitch.radial_homography import RadialHomography
from rdstitch.robust import estimate_radial_homography

_MIN_MATCHES = 12
"""Inliers of a rival: four define its homography, and eight more by chance have not been seen."""

_FAR = 3.0
"""Thresholds beyond which a match disagrees with the alignment: nearer, relief and the lens may be to blame."""

_CELLS = 16
"""Cells along the longer side of a picture, by which area is counted."""

_MIN_DISAGREEMENT = 0.02
"""Of a picture's diagonal: relief moves what stands on the plane by less."""

_MIN_APART = 0.05
"""Of a picture's diagonal: the tops of trees and houses reach 0.02 to 0.03, vehicles 0.25 to 0.5."""

_MIN_SHARE = 0.1
"""Of the area that has either motion. Flights over trees and houses reach 0.08, vehicles over a tenth 0.09 to 0.5
(``python -m tests.benchmarks.trust --kind vehicle``)."""

_CONTESTED_SHARE = 0.45
"""From here on nobody can say which of the two motions is the plane's, unless the pixels do."""

_CLEAR_AGREEMENT = 0.55
"""Share of the overlaps from which on what looks alike there is the larger part: matches are where texture is."""

MIN_AGREEMENT = 0.4
"""Share of the overlaps that must look alike where there is a rival. The plane fills what two pictures share of it, but
for the rival: 0.5 to 0.9 in the same sets, where a vehicle was registered instead 0.15 to 0.29."""


@dataclass(frozen=True)
class RivalMotion:
    """What moves otherwise in one pair of pictures.

    Attributes
    ----------
    image1, image2 : int
        Indices of the pictures.
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
        One for every pair of overlapping, aligned pictures; its area is 0 where there is no rival.
    """
    return [
        _rival(alignment, pair, threshold, seed)
        for pair in pairs
        if alignment.used[pair.image1] and alignment.used[pair.image2] and _agreeing(alignment, pair, threshold).any()
    ]


def rival_share(rivals: Sequence[RivalMotion]) -> float:
    """Share of the area of all pairs together that moves otherwise, in [0, 1]."""
    total = sum(rival.area + rival.plane_area for rival in rivals)
    return sum(rival.area for rival in rivals) / max(total, 1)


def pairs_of_rivals(pairs: Sequence[PairRegistration], rivals: Sequence[RivalMotion]) -> list[PairRegistration]:
    """The pairs as the rivals move; those that contradicted the alignment stay, and those without a rival say nothing.

    Parameters
    ----------
    pairs : sequence of PairRegistration
    rivals : sequence of RivalMotion
        What :func:`find_rival_motions` found in them.
    """
    found = {(rival.image1, rival.image2): rival.relation for rival in rivals}
    result = []
    for pair in pairs:
        own = pair.relation
        relation = found.get((pair.image1, pair.image2), own)
        if relation is None:
            relation = RadialHomography.failed("nothing moves otherwise", own.camera, own.camera2, len(own.inliers))
        result.append(replace(pair, relation=relation))
    return result


def is_apart(rivals: Sequence[RivalMotion]) -> bool:
    """Whether what moves otherwise covers a good part of the pictures, and moves by more than tree tops do."""
    if rival_share(rivals) < _MIN_SHARE:
        return False
    worst = max(rivals, key=lambda rival: rival.area)
    return worst.relation is None or worst.disagreement > _MIN_APART * 2.0 * worst.relation.camera.half_diagonal


def rival_messages(
    paths: Sequence[str],
    rivals: Sequence[RivalMotion],
    agreement: float,
    *,
    lens_only: bool = False,
    larger: bool = False,
) -> list[Message]:
    """What to say of the rivals: nothing where they cover little, a failure where they may be the plane.

    Parameters
    ----------
    paths : sequence of str
        Of the pictures.
    rivals : sequence of RivalMotion
    agreement : float
        Share of the overlaps, [0, 1], that looks alike where the alignment puts the pictures; NaN where unknown.
    lens_only : bool
        Only the lens is wanted, which both motions show.
    larger : bool
        Whether the rival was registered, too, and found to be the smaller one.
    """
    share = rival_share(rivals)
    if share < _MIN_SHARE:
        return []
    worst = max(rivals, key=lambda rival: rival.area)
    images = (paths[worst.image1], paths[worst.image2])
    first, second = names_of(images)
    u, v = worst.center
    what = (
        f"{share:.0%} of what the pictures have in common moves otherwise than the rest, most of it around "
        f"({u:.0f}, {v:.0f}) of {first} when compared with {second}, by {worst.disagreement:.0f} pixels"
    )
    decided = larger or share < _CONTESTED_SHARE
    clear = agreement >= _CLEAR_AGREEMENT or (decided and not agreement < MIN_AGREEMENT)
    if lens_only or clear:
        more = f"; what was stitched fills {agreement:.0%} of the overlaps" if share >= _CONTESTED_SHARE else ""
        return [Message(f"{what} (a vehicle, a second plane?){more}; a mask keeps it out", images, code="rival-motion")]
    # It concerns all pictures: without the one that shows it best, the rival would only be harder to see.
    shown = sorted({k for rival in rivals for k in (rival.image1, rival.image2)})
    text = f"{what}, and it is not clear which of the two is the plane; mask what does not belong to it"
    return [Message(text, tuple(paths[k] for k in shown), "failure", "rival-motion")]


def _rival(alignment: Alignment, pair: PairRegistration, threshold: float, seed: int) -> RivalMotion:
    matched, camera = pair.correspondences, alignment.cameras[pair.image1]
    error = _error(alignment, pair)
    plane = _cells(matched.points1[error < threshold], camera)
    nothing = RivalMotion(pair.image1, pair.image2, 0, len(plane), (0.0, 0.0), 0.0)
    # A point that the alignment puts nowhere has an infinite error.
    unexplained = np.flatnonzero(~(error < _FAR * threshold))
    if len(unexplained) < _MIN_MATCHES:
        return nothing
    found = estimate_radial_homography(
        matched.points1[unexplained],
        matched.points2[unexplained],
        camera.image_size,
        image_size2=alignment.cameras[pair.image2].image_size,
        center=camera.center,
        solver="auto",
        distortion=camera.distortion,
        quality=-matched.ratio[unexplained],
        threshold=threshold,
        seed=seed,
    )
    if not found or int(found.inliers.sum()) < _MIN_MATCHES:
        return nothing
    inliers = unexplained[found.inliers]
    disagreement = float(np.median(error[inliers]))
    if disagreement < _MIN_DISAGREEMENT * 2.0 * camera.half_diagonal:
        return nothing
    area = _cells(matched.points1[inliers], camera) - plane
    u, v = np.median(matched.points1[inliers], axis=0).tolist()
    relation = replace(found, inliers=np.isin(np.arange(len(error)), inliers))
    return RivalMotion(pair.image1, pair.image2, len(area), len(plane), (u, v), disagreement, relation)


def _agreeing(alignment: Alignment, pair: PairRegistration, threshold: float) -> BoolArray:
    agrees: BoolArray = _error(alignment, pair) < threshold
    return agrees


def _error(alignment: Alignment, pair: PairRegistration) -> FloatArray:
    """Transfer error (M,) of every match, pixels; infinite where the alignment puts a point nowhere."""
    matched = pair.correspondences
    expected = alignment.transfer(pair.image1, pair.image2, matched.points1)
    error: FloatArray = np.nan_to_num(np.linalg.norm(expected - matched.points2, axis=1), nan=np.inf)
    return error


def _cells(points: FloatArray, camera: Camera) -> set[tuple[int, int]]:
    """The cells of a grid over the picture that points (N, 2), pixels, lie in."""
    column, row = np.floor(points / (max(camera.image_size) / _CELLS)).astype(np.int64).T
    return set(zip(column.tolist(), row.tolist(), strict=True))
