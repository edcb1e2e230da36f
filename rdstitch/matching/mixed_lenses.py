"""Which images come from which lens, where those of two lenses or two zoom settings are mixed.

A pair of images sees λ of both of them, each on its own: the same one where they come from one lens. So a division of
the images into two lenses predicts what every pair sees.
"""

from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass

import numpy as np

from rdstitch.arrays import BoolArray, FloatArray
from rdstitch.geometry.camera import Camera
from rdstitch.matching.lens_votes import LensVotes
from rdstitch.matching.two_view import PairRegistration

_STARTS = 5  # divisions that are begun with
_ROUNDS = 3
_MIN_GAP = 0.01  # λ; what is nearer is one lens that one λ does not quite describe
_MIN_GAP_PX = 4.0  # the same at a corner, pixels; with one λ, images are off by a tenth of that, rows of them by half
_MAX_MEAN_RESIDUAL = 1.25  # standard deviations that a vote, two numbers, is off on average; less is luck
_MIN_GAIN = 4.0  # factor by which two lenses must explain the votes of pairs of both better, at least
_GAIN_OF_FEW = 2.8  # the same times one over the number of such pairs
_MIN_MARGIN = 5.0  # standard deviations by which votes must tell of which of the two lenses an image is


@dataclass(frozen=True, eq=False)
class TwoLenses:
    """Images of two lenses."""

    second: BoolArray  # (N,), bool: which images come from the second one: the fewer
    distortion: tuple[float, float]  # λ of both, half-diagonal frame
    certain: bool  # whether it is clear which images belong together, and a pair of them can be stitched


def two_lenses(cameras: Sequence[Camera], votes: LensVotes) -> TwoLenses | None:
    """The division of images into two lenses that the votes support; None where one lens will do.

    Relief and lenses that one λ does not describe scatter the votes by many times their standard deviations, and a few
    scattered votes can always be divided somehow. Two lenses must therefore explain what pairs of both see far better
    than one lens does, the more so the fewer pairs there are; and they must differ by enough to be seen in the result.
    """
    if not len(votes):
        return None
    one_lens = votes.fitted(np.zeros((len(votes), 2), dtype=np.intp), np.array([np.median(votes.distortion)]))
    by_one = votes.mahalanobis_residuals(one_lens)
    # Whatever the division: what is asked of the votes of pairs of both below, these votes must bring.
    if np.maximum(by_one - _MIN_GAIN * _MAX_MEAN_RESIDUAL, 0.0).sum() < _GAIN_OF_FEW * _MAX_MEAN_RESIDUAL:
        return None
    count, gap = len(cameras), max(_MIN_GAP, _MIN_GAP_PX / min(camera.scale for camera in cameras))
    divisions = [division for division in _divisions(count, votes) if abs(division[1][1] - division[1][0]) >= gap]
    if not divisions:
        return None
    second, lenses = min(
        divisions, key=lambda division: votes.mahalanobis_residuals(division[1][votes.lens_index(division[0])]).sum()
    )
    seen = np.isin(np.arange(count), [votes.image1, votes.image2])
    if 2 * second[seen].sum() > seen.sum():
        second, lenses = ~second, lenses[::-1]
    second &= seen  # of an image without votes nothing is known that would tell it from most others
    lens_index = votes.lens_index(second)
    between = lens_index[:, 0] != lens_index[:, 1]
    number, missed = int(between.sum()), votes.mahalanobis_residuals(lenses[lens_index])
    remaining = max(float(missed[between].sum()), max(_MAX_MEAN_RESIDUAL, float(missed.mean())) * number)
    if not number or by_one[between].sum() < (_MIN_GAIN + _GAIN_OF_FEW / number) * remaining:
        return None
    clear = _margins(count, votes, second, lenses)[seen].min() >= _MIN_MARGIN
    return TwoLenses(second, (float(lenses[0]), float(lenses[1])), bool(clear and not between.all()))


def separate_lenses(
    cameras: Sequence[Camera],
    pairs: Sequence[PairRegistration],
    threshold: float,
    known_distortion: float | None,
    executor: Executor,
) -> tuple[TwoLenses | None, Mapping[int, str]]:
    """Both lenses, and the images of that which took fewer, or has fewer matches, with why they are left out.

    None where one lens will do or λ is known (``known_distortion``); none are left out where it is not clear which
    belong together. ``threshold``: largest transfer error of an inlier, pixels.
    """
    votes = None if known_distortion is not None else LensVotes.of(pairs, threshold, executor)
    mixed = None if votes is None else two_lenses(cameras, votes)
    if votes is None or mixed is None or not mixed.certain:
        return mixed, {}
    voted, sizes = np.union1d(votes.image1, votes.image2).tolist(), []
    for second in (False, True):
        images = {k for k in voted if mixed.second[k] == second}
        of_lens = [p for p in pairs if p.relation and images.issuperset(p.images)]
        members = {image for pair in of_lens for image in pair.images}
        sizes.append((len(members), sum(int(pair.relation.inliers.sum()) for pair in of_lens)))
    kept = sizes[1] > sizes[0]
    reason = (
        f"comes from another lens or zoom setting (λ about {mixed.distortion[not kept]:.3f}, that of the others "
        f"{mixed.distortion[kept]:.3f}); stitch those of each on their own"
    )
    return mixed, {k: reason for k in voted if mixed.second[k] != kept}


def _divisions(count: int, votes: LensVotes) -> Iterator[tuple[BoolArray, FloatArray]]:
    """Images of the second of two lenses, and λ of both, by the widest gaps between λ of each image on its own."""
    every = np.stack([votes.image1, votes.image2], axis=1)
    of_images = votes.fitted(every, np.full(count, np.median(votes.distortion)))
    levels = np.unique(of_images[every])
    for cut in np.argsort(levels[:-1] - levels[1:], kind="stable")[:_STARTS]:
        second, lenses = of_images > levels[cut], levels[[cut, cut + 1]]
        for _ in range(_ROUNDS):
            lenses = votes.fitted(votes.lens_index(second), lenses)
            second ^= _margins(count, votes, second, lenses) < 0.0
        yield second, lenses


def _margins(count: int, votes: LensVotes, second: BoolArray, lenses: FloatArray) -> FloatArray:
    """How much more the votes were missed if each image (N,) came from the other lens."""
    lens_index = votes.lens_index(second)
    missed = votes.mahalanobis_residuals(lenses[lens_index])
    total: FloatArray = np.zeros(count)
    for image, other in zip((votes.image1, votes.image2), np.eye(2, dtype=int), strict=True):
        np.add.at(total, image, votes.mahalanobis_residuals(lenses[lens_index ^ other]) - missed)
    return total
