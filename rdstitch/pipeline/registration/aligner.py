"""Stages: registered pairs become one alignment, which finds more pairs, which make a better alignment."""

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Self, TypeVar

import numpy as np
from numpy.typing import ArrayLike

from rdstitch.alignment import Alignment, AlignmentOptions, AlignmentTask, most_matches_read
from rdstitch.alignment.frames.cut_outs import common_size, cut_alignment, framed_camera, framed_link
from rdstitch.alignment.frames.quarter_turns import QuarterTurns
from rdstitch.alignment.known_model import KnownModel
from rdstitch.alignment.near_copies import without_measurements
from rdstitch.alignment.result import LinkFit, Unused
from rdstitch.arrays import FloatArray
from rdstitch.choices import Purpose
from rdstitch.errors import ImpossibleCameraError, RegistrationError
from rdstitch.geometry.camera import Camera
from rdstitch.inputs.source import Source
from rdstitch.matching.copies import SAME_PX, copies_of, near_copies_of, without_copies
from rdstitch.matching.rough_ground import over_rough_ground
from rdstitch.matching.two_view import Pair, PairRegistration
from rdstitch.options.stitch_options import StitchOptions
from rdstitch.pipeline.registration.alignment_inputs import alignment_options, sightings
from rdstitch.pipeline.registration.working_size import at_working_size
from rdstitch.results.messages import Message, names_of, shortened
from rdstitch.system.cache import Cache
from rdstitch.system.process_memory import return_freed_memory
from rdstitch.verification.limits import Limits

Computed = TypeVar("Computed")

# Share of the matches off the planes of their pairs that are where the alignment expects them: more than half, and it
# was the lens that moved them, not the ground.
_EXPLAINED = 0.5
# Times the errors of its image, and of its pairs on their own, that a near copy is off by where it needs a motion that
# the others do not: 20 to 60 of rendered ones that are tilted or zoomed, 1.0 of those that are only shifted.
_MISFIT = 1.5


@contextmanager
def impossible_estimates_fail() -> Iterator[None]:
    """An estimated camera that cannot be is a failed registration; a block, or a decorator of a stage."""
    try:
        yield
    except np.linalg.LinAlgError as error:
        raise RegistrationError(
            f"no reliable result: the matches are too few to fix the camera ({error}); take images that overlap more"
        ) from error
    except ImpossibleCameraError as error:
        raise RegistrationError(
            f"no reliable result: the images agree best on a lens that cannot be ({error}); "
            "give the lens with --camera or --lambda, or take images that overlap more"
        ) from error


@dataclass(frozen=True)
class AlignedPairs:
    """Pairs, and the alignment that was made from them."""

    pairs: tuple[PairRegistration, ...]  # every pair that was compared, in the order of the images
    alignment: Alignment
    rough: bool = False  # whether the inliers that it was made from are those over rough ground
    completed: Callable[[], Alignment] | None = None  # what the alignment is a draft of; None where it is complete
    known: KnownModel | None = None  # what a draft by more pairs can start from


@dataclass(frozen=True)
class _DistinctPairs:
    """Registered pairs of images where each that is there twice counts once."""

    registered: Mapping[Pair, PairRegistration]  # by the images that they are between, copies replaced
    copies: Mapping[int, int]  # of each copy, the image that it is a copy of
    near_copies: Mapping[int, int]  # of each that is placed afterwards, the image that shows almost the same

    @property
    def evidence(self) -> list[Pair]:
        """The pairs that the images are aligned by."""
        return [ends for ends in self.registered if not self.near_copies.keys() & {*ends}]

    @property
    def of_near_copies(self) -> list[Pair]:
        """The pairs that near copies are placed by."""
        return [ends for ends in self.registered if self.near_copies.keys() & {*ends}]


@dataclass(frozen=True)
class Aligner:
    """What the alignment of a set of images needs besides their pairs."""

    paths: tuple[str, ...]  # of the images, for messages
    cameras: tuple[Camera, ...]  # of the size that features are detected at
    options: AlignmentOptions
    cache: Cache
    threshold: float  # largest transfer error of an inlier, pixels
    quarters: QuarterTurns  # by which the images became upright; ``options`` are of the stored ones
    needs_poses: bool = False  # whether every alignment must have metric poses, see :meth:`metric`

    @classmethod
    def of(
        cls, sources: Sequence[Source], options: StitchOptions, cache: Cache, purpose: Purpose = Purpose.MOSAIC
    ) -> Self:
        """From what the user decided, and what the images and their headers say; see :class:`AlignmentOptions`."""
        paths = tuple(str(source.path) for source in sources)
        megapixels = options.features.for_images(len(sources)).limits[1]
        cameras = tuple(at_working_size(source.camera.with_guessed_focal(), megapixels) for source in sources)
        control = sightings(sources, cameras)
        decided = replace(alignment_options(sources, options), purpose=purpose, control=control)
        return cls(paths, cameras, decided, cache, options.threshold, QuarterTurns.of(sources))

    @property
    def exact_tilts(self) -> list[tuple[float, float]] | None:
        """(ψ, θ), radians, of each upright image, where they are known exactly; None where not."""
        tilts = self.options.exact_tilts(len(self.cameras))
        if not tilts:
            return tilts
        return [(psi, theta) for psi, theta in self.quarters.tilts(np.array(tilts)).tolist()]

    def align(self, pairs: Sequence[PairRegistration]) -> AlignedPairs:
        """Align the images by the pairs that were registered; from an earlier run where the cache has it."""
        return self.completed(self.draft(pairs))

    def draft(self, pairs: Sequence[PairRegistration], known: KnownModel | None = None) -> AlignedPairs:
        """Model, lens and poses by a few matches of each pair: what shows which pairs and matches are missing.

        The model is that of fewer pairs, if it is ``known`` and the others agree with it.
        """
        return_freed_memory()
        aligned = self._drafted(pairs, known)
        ground = over_rough_ground(pairs, self.threshold)
        if ground is not pairs and not self._explains(aligned.alignment, pairs, ground):
            over = self._drafted(ground)
            if over.alignment.rms <= Limits.max_rough_rms * self.threshold:  # else it is not one ground
                aligned = replace(over, pairs=tuple(pairs), rough=True)
        return self.metric(aligned) if self.needs_poses else aligned

    def completed(self, aligned: AlignedPairs) -> AlignedPairs:
        """The images adjusted to all matches, where their alignment is a draft."""
        if aligned.completed is None:
            return aligned
        return replace(aligned, alignment=aligned.completed(), completed=None)

    def used(self, aligned: AlignedPairs) -> Sequence[PairRegistration]:
        """The pairs with the inliers that the alignment was made from."""
        return over_rough_ground(aligned.pairs, self.threshold) if aligned.rough else aligned.pairs

    def _explains(
        self, alignment: Alignment, pairs: Sequence[PairRegistration], ground: Sequence[PairRegistration]
    ) -> bool:
        """Whether most matches off the planes of their pairs are where an alignment without them expects them: it knows
        more of the lens than a pair does; and near a camera that turns is no ground.
        """
        errors = [np.zeros(0)]
        for pair, more in zip(pairs, ground, strict=True):
            new = more.relation.inliers & ~pair.relation.inliers
            if pair.images in alignment.support and new.any():
                errors.append(pair.errors(alignment.transfer)[new])
        every = np.concatenate(errors)
        return alignment.on_sphere or not len(every) or bool(np.mean(every < self.threshold) > _EXPLAINED)

    def _drafted(
        self, pairs: Sequence[PairRegistration], known: KnownModel | None = None, counted: frozenset[int] = frozenset()
    ) -> AlignedPairs:
        """The images aligned; near copies are placed afterwards, but for those that are ``counted`` as all are."""
        if not any(pair.relation for pair in pairs):
            raise RegistrationError(_no_overlap(self.paths, pairs))
        distinct = self._distinct(pairs, counted)
        task = replace(self._task(distinct), known=known)
        compared = [distinct.registered[ends].images for ends in distinct.evidence]

        def complete(alignment: Alignment) -> Alignment:
            alignment = self._upright(alignment, task)
            alignment = alignment.with_copies(distinct.copies, compared)
            alignment = replace(alignment, links=(*alignment.links, *self._links_of_copies(alignment, pairs)))
            twice = {*distinct.copies, *distinct.near_copies}
            return alignment.with_messages([self._counted_once(twice)] if twice else [])

        drafted, draft_model = self._recalled("draft", task, lambda: (task.draft, task.draft_model))
        draft = complete(drafted)
        if misfits := self._misfits(draft, distinct):
            with_them = self._drafted(pairs, counted=counted | misfits)
            if with_them.alignment.model != draft.model:  # so little new ground tells of motion, but not of the lens
                return with_them

        def completed() -> Alignment:
            return complete(self._recalled("alignment", task, lambda: task.result))

        return AlignedPairs(tuple(pairs), draft, completed=completed, known=draft_model)

    def _distinct(self, pairs: Sequence[PairRegistration], counted: frozenset[int]) -> _DistinctPairs:
        """Which pairs are evidence; where all images show the same, all are."""
        copies = copies_of(pairs)
        registered = without_copies(pairs, copies)
        if not registered:
            copies = {}
            registered = without_copies(pairs, copies)
        near = without_measurements(near_copies_of(registered), self._options_without(copies))
        near = {copy: first for copy, first in near.items() if copy not in counted}
        distinct = _DistinctPairs(registered, copies, near)
        return distinct if distinct.evidence else replace(distinct, near_copies={})

    def _task(self, distinct: _DistinctPairs) -> AlignmentTask:
        """What is aligned: images as they are stored, cut ones in a frame that holds each of them."""
        stored, count = self.quarters.back, len(distinct.evidence)
        cameras = tuple(stored.camera(camera, k) for k, camera in enumerate(self.cameras))
        most = most_matches_read(count, self.options)
        named = (
            replace(distinct.registered[i, j].link().thinned(most), image1=i, image2=j)
            for i, j in (*distinct.evidence, *distinct.of_near_copies)
        )
        links = tuple(stored.link(link, self.cameras) for link in named)
        if (size := common_size(cameras, links)) is not None:
            cameras = tuple(framed_camera(camera, size) for camera in cameras)
            links = tuple(framed_link(link, size) for link in links)
        options = self._options_without(distinct.copies)
        return AlignmentTask(cameras, links[:count], options, distinct.near_copies, links[count:])

    def _misfits(self, alignment: Alignment, distinct: _DistinctPairs) -> frozenset[int]:
        """The near copies that a model fits worse than their images, and than their pairs fit on their own."""
        errors: dict[int, list[FloatArray]] = {}
        near = distinct.near_copies
        concerned = near.keys() | {*near.values()}
        for ends, pair in distinct.registered.items():
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

    def _options_without(self, copies: Mapping[int, int]) -> AlignmentOptions:
        """The options without copies: what is given of one is given of the image that it is a copy of."""
        given, quarters = self.options, self.quarters
        control = []
        for one in given.control:
            first = copies.get(one.image, one.image)
            x, y = quarters.back.point(quarters.point(np.array(one.offset), one.image), first).tolist()
            control.append(replace(one, image=first, offset=(x, y)))
        upright = None if given.gravity is None else _filled(quarters.directions(given.gravity), copies)
        known = None
        if given.positions is not None:  # a place and its accuracy go together
            std = np.full(len(self.cameras), math.nan) if given.positions_std is None else given.positions_std
            known = _filled(np.column_stack([given.positions, std]), copies)
        return replace(
            given,
            reference=None if given.reference is None else copies.get(given.reference, given.reference),
            control=tuple(control),
            positions=None if known is None else known[:, :2],
            positions_std=None if known is None else known[:, 2],
            gravity=None if upright is None else quarters.back.directions(upright),
        )

    def _links_of_copies(self, alignment: Alignment, pairs: Sequence[PairRegistration]) -> Iterator[LinkFit]:
        """How well the registered pairs agree that are no evidence."""
        known = {fit.images for fit in alignment.links}
        for pair in pairs:
            if pair.relation and pair.images not in known:
                errors = pair.errors(alignment.transfer)[pair.relation.inliers]
                agreeing = errors[errors < max(self.threshold, SAME_PX)]
                rms = float(np.sqrt(np.mean(agreeing**2))) if len(agreeing) else math.nan
                yield LinkFit(*pair.images, len(errors), len(agreeing), rms, Unused.COPY)

    def _counted_once(self, twice: Iterable[int]) -> Message:
        names = shortened(names_of(self.paths[k] for k in sorted(twice)))
        text = f"counted once, because they show almost only what other images show: {names}"
        return Message(text, severity="detail", code="copies")

    def _recalled(self, stage: str, task: AlignmentTask, compute: Callable[[], Computed]) -> Computed:
        """What comes of a task; from an earlier run where the cache has it."""
        of_links = (task.links, task.links_of_copies, sorted(task.near_copies.items()))
        inputs = (task.cameras, self.cache.digest(of_links), task.options, task.known)
        return self.cache.recall(stage, inputs, compute)

    def _upright(self, alignment: Alignment, task: AlignmentTask) -> Alignment:
        """An alignment of the images as they are stored as one of the upright images, each of its own size."""
        sizes = [self.quarters.back.camera(camera, k).image_size for k, camera in enumerate(self.cameras)]
        if any(camera.image_size != size for camera, size in zip(alignment.cameras, sizes, strict=True)):
            alignment = cut_alignment(alignment, sizes)
        return self.quarters.alignment(alignment, task.options.gravity, task.near_copies)

    def metric(self, aligned: AlignedPairs) -> AlignedPairs:
        """A draft of the same pairs by a model with metric poses, where the user left the choice of the model open."""
        if aligned.alignment.poses is not None or aligned.alignment.on_sphere or self.options.model != "auto":
            return aligned
        return replace(self, options=replace(self.options, model="pose")).draft(aligned.pairs)


def _filled(rows: ArrayLike, copies: Mapping[int, int]) -> FloatArray:
    """Rows (N, D), one an image, those that begin with NaN from a copy of the image."""
    result = np.array(rows, dtype=np.float64)
    for copy, first in copies.items():
        if np.isnan(result[first, 0]):
            result[first] = result[copy]
    return result


def _no_overlap(paths: Sequence[str], pairs: Sequence[PairRegistration]) -> str:
    """Why no pair was registered, by the example of the pair with the most matches."""
    if not pairs:
        return "no two images could be compared"
    best = max(pairs, key=lambda pair: len(pair.matches))
    first, second = names_of([paths[best.image1], paths[best.image2]])
    return (
        f"no two images overlap: of the likeliest pair, {first} and {second}, {best.relation.reason}; "
        "take images that overlap by a third or more"
    )
