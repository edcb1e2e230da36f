"""Registration of pairs: match the features of two pictures, estimate homography and λ together."""

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from typing import TypeVar

import numpy as np

from rdstitch.camera import Camera
from rdstitch.features import Correspondences, Features, Matcher, match_overlap
from rdstitch.matching.links import Link
from rdstitch.matching.options import PairOptions
from rdstitch.radial_homography import RadialHomography
from rdstitch.robust import EstimationOptions, PairMatches, RansacOptions, estimate_radial_homographies

Value = TypeVar("Value")

Pair = tuple[int, int]

PairProgress = Callable[[int, int], None]

PairCache = Callable[[int, Callable[[], Value]], Value]
"""Called with the position of a pair and what computes something of it; gives that, perhaps from an earlier run."""


Estimate = Callable[[list[int]], list[RadialHomography]]

RecallMany = Callable[[Sequence[int], Estimate], list[RadialHomography]]
"""Called with the positions of pairs and with what estimates those at some places among them; gives all of theirs."""

_PAIRS_AT_ONCE = 256  # after so many there is progress to show, and to keep
_SELECT_BELOW = 50
"""Inliers from which on a free homography is as sure as a motion of the plane; the alignment decides between them."""


@dataclass(frozen=True)
class PairRegistration:
    """What became of one pair.

    Attributes
    ----------
    image1, image2 : int
        Indices of the pictures.
    correspondences : Correspondences
        The putative matches, pixels.
    relation : RadialHomography
        The estimate from ``image1`` to ``image2``; falsy with the reason where there is none.
    """

    image1: int
    image2: int
    correspondences: Correspondences
    relation: RadialHomography

    def link(self) -> Link:
        """The inliers, as global adjustment takes them."""
        inliers = self.relation.inliers
        matched = self.correspondences
        return Link(self.image1, self.image2, matched.points1[inliers], matched.points2[inliers], self.relation)


def match_pairs(
    features: Sequence[Features],
    pairs: Sequence[tuple[int, int]],
    matcher: Matcher,
    *,
    known_matches: Sequence[Correspondences | None] | None = None,
    progress: PairProgress | None = None,
    recall: PairCache[Correspondences] | None = None,
    workers: int = 1,
) -> list[Correspondences]:
    """Match the features of pairs of pictures, several pairs at a time.

    Parameters
    ----------
    features : sequence of Features
        One a picture.
    pairs : sequence of (int, int)
        Indices of the pictures of each pair.
    matcher : callable
        Matches the features of two pictures.
    known_matches : sequence of Correspondences or None, optional
        Some matches of each pair, where they are known: they show where the pictures overlap, and only there the rest
        is looked for.
    progress : callable, optional
        Called with the number of pairs done and their total.
    recall : callable, optional
        Stands between this function and the matching of each pair; see :data:`PairCache`.
    workers : int
        Threads; more than one only for a matcher that may be called from several.
    """

    def work(index: int) -> Correspondences:
        image1, image2 = pairs[index]
        known = None if known_matches is None else known_matches[index]
        if known is None:
            compute = partial(matcher, features[image1], features[image2])
        else:
            compute = partial(match_overlap, matcher, features[image1], features[image2], known)
        return compute() if recall is None else recall(index, compute)

    done = []
    with ThreadPoolExecutor(workers) as pool:
        for found in pool.map(work, range(len(pairs))):
            done.append(found)
            if progress is not None:
                progress(len(done), len(pairs))
    return done


def estimate_pairs(
    cameras: Sequence[Camera],
    pairs: Sequence[Pair],
    matched: Sequence[Correspondences],
    options: PairOptions,
    *,
    tilts: Sequence[tuple[float, float] | None] | None = None,
    progress: PairProgress | None = None,
    recall: RecallMany = lambda pairs, compute: compute(list(range(len(pairs)))),
) -> list[PairRegistration]:
    """Estimate the two-view geometry of every pair, many at a time, but in one thread.

    Several threads would take half as long again: small arrays keep the interpreter busy, for which threads wait.

    Parameters
    ----------
    cameras : sequence of Camera
        One a picture; of its lens only the centre and the focal length are used, unless ``options.distortion``.
    pairs : sequence of (int, int)
    matched : sequence of Correspondences
        One a pair.
    options : PairOptions
    tilts : sequence of (float, float) or None, optional
        Known tilt (ψ, θ), radians, of each picture, None where unknown.
    progress : callable, optional
        Called with the number of pairs done and their total.
    recall : callable, optional
        Stands between this function and the estimation of some pairs; see :data:`RecallMany`.
    """
    limits = RansacOptions(options.threshold, options.confidence, options.max_iterations, options.seed)
    how = EstimationOptions(options.solver, options.distortion, limits, _SELECT_BELOW)

    def matches_of(index: int) -> PairMatches:
        (image1, image2), found = pairs[index], matched[index]
        camera = cameras[image1]
        own = Camera(camera.image_size, focal=camera.focal, focal_source=camera.focal_source, center=camera.center)
        own = own.with_focal()
        known = [None, None] if tilts is None else [tilts[image1], tilts[image2]]
        return PairMatches(
            found.points1,
            found.points2,
            own,
            own.resized(cameras[image2].image_size),
            -found.ratio,
            None if None in known else np.array(known, dtype=np.float64),
        )

    done: list[PairRegistration] = []
    for start in range(0, len(pairs), _PAIRS_AT_ONCE):
        block = range(start, min(start + _PAIRS_AT_ONCE, len(pairs)))

        def estimate(places: list[int], block: range = block) -> list[RadialHomography]:
            return estimate_radial_homographies([matches_of(block[place]) for place in places], how)

        relations = recall(block, estimate)
        done += [
            PairRegistration(*pairs[k], matched[k], relation) for k, relation in zip(block, relations, strict=True)
        ]
        if progress is not None:
            progress(len(done), len(pairs))
    return done
