"""Images that are there twice: the same pixels, saved again, or taken again by a camera that stood still.

They are no evidence: what an image shows counts once, however often it is given.
"""

from collections.abc import Mapping, Sequence

import numpy as np

from rdstitch.geometry.camera import border_of
from rdstitch.geometry.radial_homography import transfer
from rdstitch.matching.two_view import Pair, PairRegistration

_SAME_PX = 0.5
"""Pixels that matches of a copy move by at most: saving again moves them by less, and no place is off by more."""

_MIN_SAME = 0.9  # share of the matches that do: of an image that shows something else beside what is static, more move


def copies_of(pairs: Sequence[PairRegistration]) -> dict[int, int]:
    """Of each image that is a copy, by its index, the first image that it is a copy of."""
    result: dict[int, int] = {}
    for pair in sorted(pairs, key=lambda pair: pair.images):
        if not {*pair.images} & result.keys() and _is_copy(pair):
            result[pair.image2] = pair.image1
    return result


def distinct(pairs: Sequence[PairRegistration], copies: Mapping[int, int]) -> dict[Pair, PairRegistration]:
    """The registered pairs that are evidence, by the images that they are between where copies are their first images.

    Where none but a copy was compared with an image, its pair stands for that.
    """
    result: dict[Pair, PairRegistration] = {}
    for pair in sorted(pairs, key=lambda pair: len({*pair.images} & copies.keys())):
        i, j = (copies.get(k, k) for k in pair.images)
        if pair.relation and i != j and (j, i) not in result:
            result.setdefault((i, j), pair)
    return result


def _is_copy(pair: PairRegistration) -> bool:
    """Whether both images show the same at the same pixels, by the corners first: most pairs are told by these."""
    relation = pair.relation
    if not relation or relation.camera.image_size != relation.camera2.image_size:
        return False
    corners = relation.camera.normalize(border_of(relation.camera.image_size, 1))
    with np.errstate(all="ignore"):
        moved = transfer(relation.homography, relation.distortion, corners, relation.camera.higher) - corners
    if not (np.linalg.norm(moved, axis=1) * relation.camera.scale < 2.0 * _SAME_PX).all():
        return False
    matches = pair.correspondences
    return bool(np.mean(np.linalg.norm(matches.points2 - matches.points1, axis=1) < _SAME_PX) >= _MIN_SAME)
