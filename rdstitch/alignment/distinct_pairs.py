"""Registered pairs of images where each that is there twice counts once, and what is given of such images."""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Self

import numpy as np
from numpy.typing import ArrayLike

from rdstitch.alignment.alignment_options import AlignmentOptions
from rdstitch.alignment.frames.quarter_turns import QuarterTurns
from rdstitch.alignment.near_copies import without_measurements
from rdstitch.alignment.result import Alignment, LinkFit, Unused
from rdstitch.arrays import FloatArray
from rdstitch.matching.copies import SAME_PX, copies_of, near_copies_of, without_copies
from rdstitch.matching.two_view import Pair, PairRegistration

# Times the errors of its image, and of its pairs on their own, that a near copy is off by where it needs a motion that
# the others do not: 20 to 60 of rendered ones that are tilted or zoomed, 1.0 of those that are only shifted.
_MISFIT = 1.5


@dataclass(frozen=True)
class DistinctPairs:
    """Registered pairs of images where each that is there twice counts once, and what is given of these images."""

    registered: Mapping[Pair, PairRegistration]  # by the images that they are between, copies replaced
    copies: Mapping[int, int]  # of each copy, the image that it is a copy of
    near_copies: Mapping[int, int]  # of each that is placed afterwards, the image that shows almost the same
    options: AlignmentOptions  # without copies

    @classmethod
    def of(
        cls,
        pairs: Sequence[PairRegistration],
        options: AlignmentOptions,
        quarters: QuarterTurns,
        counted: frozenset[int] = frozenset(),
    ) -> Self:
        """Which pairs are evidence; where all images show the same, all are; near copies that are ``counted`` are."""
        copies = copies_of(pairs)
        registered = without_copies(pairs, copies)
        if not registered:
            copies = {}
            registered = without_copies(pairs, copies)
        options = options_of_originals(options, copies, quarters)
        near = without_measurements(near_copies_of(registered), options)
        near = {copy: first for copy, first in near.items() if copy not in counted}
        distinct = cls(registered, copies, near, options)
        return distinct if distinct.evidence else replace(distinct, near_copies={})

    @property
    def evidence(self) -> list[Pair]:
        """The pairs that the images are aligned by."""
        return [ends for ends in self.registered if not self.near_copies.keys() & {*ends}]

    @property
    def of_near_copies(self) -> list[Pair]:
        """The pairs that near copies are placed by."""
        return [ends for ends in self.registered if self.near_copies.keys() & {*ends}]

    def misfits(self, alignment: Alignment) -> frozenset[int]:
        """The near copies that a model fits worse than their images, and than their pairs fit on their own."""
        errors: dict[int, list[FloatArray]] = {}
        near = self.near_copies
        concerned = near.keys() | {*near.values()}
        for ends, pair in self.registered.items():
            copies = near.keys() & {*ends}
            if concerned & {*ends} and len(copies) < 2 and alignment.used[[*ends]].all():
                both = np.array([pair.errors(alignment.transfer), pair.pairwise_errors])[:, pair.relation.inliers]
                for image in copies or ends:
                    errors.setdefault(image, []).append(both)
        medians = dict.fromkeys(concerned, np.zeros(2))
        medians |= {image: np.median(np.concatenate(parts, axis=1), axis=1) for image, parts in errors.items()}
        return frozenset(
            copy
            for copy, first in near.items()
            if medians[copy][0] > max(_MISFIT * medians[first][0], _MISFIT * medians[copy][1], SAME_PX)
        )


def options_of_originals(
    options: AlignmentOptions, copies: Mapping[int, int], quarters: QuarterTurns
) -> AlignmentOptions:
    """The options without copies: what is given of one is given of the image that it is a copy of.

    ``quarters`` are those by which the images became upright; the options are of stored ones.
    """
    control = []
    for one in options.control:
        first = copies.get(one.image, one.image)
        x, y = quarters.back.point(quarters.point(np.array(one.offset), one.image), first).tolist()
        control.append(replace(one, image=first, offset=(x, y)))
    upright = None if options.gravity is None else _filled(quarters.directions(options.gravity), copies)
    known = None
    if options.positions is not None:  # a place and its accuracy go together
        std = options.positions_std
        std = np.full(len(quarters.orientations), math.nan) if std is None else std
        known = _filled(np.column_stack([options.positions, std]), copies)
    return replace(
        options,
        reference=None if options.reference is None else copies.get(options.reference, options.reference),
        control=tuple(control),
        positions=None if known is None else known[:, :2],
        positions_std=None if known is None else known[:, 2],
        gravity=None if upright is None else quarters.back.directions(upright),
    )


def links_of_copies(alignment: Alignment, pairs: Sequence[PairRegistration], threshold: float) -> Iterator[LinkFit]:
    """How well the registered pairs agree that are no evidence."""
    known = {fit.images for fit in alignment.links}
    for pair in pairs:
        if pair.relation and pair.images not in known:
            errors = pair.errors(alignment.transfer)[pair.relation.inliers]
            agreeing = errors[errors < max(threshold, SAME_PX)]
            rms = float(np.sqrt(np.mean(agreeing**2))) if len(agreeing) else math.nan
            yield LinkFit(*pair.images, len(errors), len(agreeing), rms, Unused.COPY)


def _filled(rows: ArrayLike, copies: Mapping[int, int]) -> FloatArray:
    """Rows (N, D), one an image, those that begin with NaN from a copy of the image."""
    result = np.array(rows, dtype=np.float64)
    for copy, first in copies.items():
        if np.isnan(result[first, 0]):
            result[first] = result[copy]
    return result
