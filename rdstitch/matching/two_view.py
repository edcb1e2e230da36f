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
from rdstitch.robust import estimate_radial_homography

Value = TypeVar("Value")

Progress = Callable[[int, int], None]

Recall = Callable[[int, Callable[[], Value]], Value]
"""Called with the position of a pair and what computes something of it; gives that, perhaps from an earlier run."""


@dataclass(frozen=True)
class PairRegistration:
    """What became of one pair.

    Attributes
    ----------
    image1, image2 : int
        Indices of the pictures.
    correspondences : Correspondences
        The matches, of full-size px, right and wrong.
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
    glimpses: Sequence[Correspondences | None] | None = None,
    progress: Progress | None = None,
    recall: Recall[Correspondences] | None = None,
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
    glimpses : sequence of Correspondences or None, optional
        Some matches of each pair, where they are known: they tell where the pictures overlap, and only there the rest
        is looked for.
    progress : callable, optional
        Called with the number of pairs done and their total.
    recall : callable, optional
        Stands between this function and the matching of each pair; see :data:`Recall`.
    workers : int
        Threads; more than one only for a matcher that may be called from several.
    """

    def work(index: int) -> Correspondences:
        image1, image2 = pairs[index]
        glimpse = None if glimpses is None else glimpses[index]
        if glimpse is None:
            compute = partial(matcher, features[image1], features[image2])
        else:
            compute = partial(match_overlap, matcher, features[image1], features[image2], glimpse)
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
    pairs: Sequence[tuple[int, int]],
    matched: Sequence[Correspondences],
    options: PairOptions,
    *,
    tilts: Sequence[tuple[float, float] | None] | None = None,
    progress: Progress | None = None,
    recall: Recall[RadialHomography] | None = None,
) -> list[PairRegistration]:
    """Estimate the relation of every pair, one after the other.

    Several at a time would take half as long again: small arrays keep the interpreter busy, for which threads wait.

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
        Stands between this function and the estimation of each pair; see :data:`Recall`.
    """

    def relate(index: int) -> RadialHomography:
        image1, image2 = pairs[index]
        camera1, camera2, found = cameras[image1], cameras[image2], matched[index]
        tilt1, tilt2 = (None, None) if tilts is None else (tilts[image1], tilts[image2])
        return estimate_radial_homography(
            found.points1,
            found.points2,
            camera1.image_size,
            image_size2=camera2.image_size,
            focal=camera1.focal,
            focal_source=camera1.focal_source,
            center=camera1.center,
            solver=options.solver,
            tilt=None if tilt1 is None or tilt2 is None else np.array([tilt1, tilt2]),
            distortion=options.distortion,
            quality=-found.ratio,
            threshold=options.threshold,
            confidence=options.confidence,
            max_iterations=options.max_iterations,
            seed=options.seed,
        )

    done = []
    for index, pair in enumerate(pairs):
        compute = partial(relate, index)
        relation = compute() if recall is None else recall(index, compute)
        done.append(PairRegistration(*pair, matched[index], relation))
        if progress is not None:
            progress(len(done), len(pairs))
    return done
