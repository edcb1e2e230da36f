"""Images that are there twice: the same pixels, saved again, or taken again by a camera that hardly moved.

They are no evidence: what an image shows counts once, however often it is given.
"""

from collections.abc import Mapping, Sequence

import numpy as np

from rdstitch.arrays import FloatArray
from rdstitch.geometry.camera import border_of
from rdstitch.geometry.radial_homography import transfer
from rdstitch.matching.two_view import Pair, PairRegistration

SAME_PX = 0.5
"""Pixels that matches of a copy move by at most: what moves by less stays on the same pixel."""

_MIN_SAME = 0.9  # share of the matches that do: of an image that shows something else beside what is static, more move
_NEAR = 0.02  # of the width and the height, that matches of a near copy move by at most: an overlap of 97 % at least
_IDENTITY = np.eye(3)


def copies_of(pairs: Sequence[PairRegistration]) -> dict[int, int]:
    """Map each image that is a copy, by its index, to the first image that it is a copy of."""
    result: dict[int, int] = {}
    moved: dict[int, FloatArray] = {}  # from their first images
    for pair in sorted(pairs, key=lambda pair: pair.images):
        before = moved.get(pair.image1, _IDENTITY)
        if pair.image2 not in result and _moves_within(pair, np.full(2, SAME_PX), before):
            result[pair.image2] = result.get(pair.image1, pair.image1)
            moved[pair.image2] = pair.relation.homography @ before
    return result


def near_copies_of(pairs: Mapping[Pair, PairRegistration]) -> dict[int, int]:
    """Map each image that shows almost only what another one shows to that one; registered pairs by their images.

    Whatever it overlaps with, so does that one: else it may be the only one that joins some images.
    """
    neighbours: dict[int, set[int]] = {}
    for i, j in pairs:
        neighbours.setdefault(i, set()).add(j)
        neighbours.setdefault(j, set()).add(i)
    result: dict[int, int] = {}
    for first, copy in sorted((min(ends), max(ends)) for ends in pairs):
        if {first, copy} & result.keys() or neighbours[copy] - {first} - neighbours[first]:
            continue
        pair = pairs[(first, copy) if (first, copy) in pairs else (copy, first)]
        if _moves_within(pair, _NEAR * np.array(pair.relation.camera.image_size)):
            result[copy] = first
    return result


def without_copies(pairs: Sequence[PairRegistration], copies: Mapping[int, int]) -> dict[Pair, PairRegistration]:
    """The registered pairs that are evidence, by the images that they are between where copies are their first images.

    Where none but a copy was compared with an image, its pair stands for that.
    """
    result: dict[Pair, PairRegistration] = {}
    for pair in sorted(pairs, key=lambda pair: len({*pair.images} & copies.keys())):
        i, j = (copies.get(k, k) for k in pair.images)
        if pair.relation and i != j and (j, i) not in result:
            result.setdefault((i, j), pair)
    return result


def _moves_within(pair: PairRegistration, limits: FloatArray, before: FloatArray = _IDENTITY) -> bool:
    """Whether what both show moves by at most so many pixels (2,), by the corners first: they tell most pairs.

    From the original on, where image 1 is a copy to which ``before`` (3, 3) leads.
    """
    relation = pair.relation
    if not relation or relation.camera.image_size != relation.camera2.image_size:
        return False
    camera = relation.camera

    def shifts(homography: FloatArray, points: FloatArray) -> FloatArray:
        normalized = camera.normalize(points)
        with np.errstate(all="ignore"):
            return (transfer(homography, camera.distortion, normalized, camera.higher) - normalized) * camera.scale

    corners = border_of(camera.image_size, 1)
    if not (np.linalg.norm(shifts(relation.homography @ before, corners) / limits, axis=1) < 2.0).all():
        return False
    matches = pair.correspondences
    moved = matches.points2 - matches.points1 + shifts(before, matches.points1)
    return bool(np.mean(np.linalg.norm(moved / limits, axis=1) < 1.0) >= _MIN_SAME)
