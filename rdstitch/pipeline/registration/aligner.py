"""Stage: the alignment of all images by their registered pairs, as a draft and complete."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Self, TypeVar

import numpy as np

from rdstitch.alignment import Alignment, AlignmentOptions, AlignmentTask, most_matches_read
from rdstitch.alignment.distinct_pairs import DistinctPairs, links_of_copies
from rdstitch.alignment.frames.cut_outs import common_size, cut_alignment, framed_camera, framed_link
from rdstitch.alignment.frames.quarter_turns import QuarterTurns
from rdstitch.alignment.known_model import KnownModel
from rdstitch.choices import Purpose
from rdstitch.errors import ImpossibleCameraError, RegistrationError
from rdstitch.geometry.camera import Camera
from rdstitch.inputs.source import Source
from rdstitch.matching.rough_ground import over_rough_ground
from rdstitch.matching.two_view import PairRegistration
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


@contextmanager
def impossible_estimates_fail() -> Iterator[None]:
    """Turn errors of an impossible estimate into a RegistrationError; as a block, or decorator of a stage."""
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
class TaskOfPairs:
    """An alignment task, with the pairs that its evidence was chosen from."""

    pairs: Sequence[PairRegistration]
    distinct: DistinctPairs
    task: AlignmentTask


@dataclass(frozen=True)
class AlignedPairs:
    """Pairs, and the alignment that was made from them."""

    pairs: tuple[PairRegistration, ...]  # every pair that was compared, in the order of the images
    alignment: Alignment
    rough: bool  # whether the inliers that it was made from are those over rough ground


@dataclass(frozen=True)
class DraftedPairs(AlignedPairs):
    """Pairs, and a draft of their alignment, by a few matches of each."""

    task: TaskOfPairs  # what it is a draft of
    known: KnownModel | None  # what a draft by more pairs can start from


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
        """From options, images and their headers; see :class:`AlignmentOptions`."""
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
        """Align the images by their registered pairs."""
        return self.completed(self.draft(pairs))

    @impossible_estimates_fail()
    def draft(self, pairs: Sequence[PairRegistration], known: KnownModel | None = None) -> DraftedPairs:
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

    @impossible_estimates_fail()
    def completed(self, draft: DraftedPairs) -> AlignedPairs:
        """The images adjusted to all matches."""
        task = draft.task.task
        alignment = self._of_all_images(self._recalled("alignment", task, lambda: task.result), draft.task)
        return AlignedPairs(draft.pairs, alignment, draft.rough)

    def used(self, aligned: AlignedPairs) -> Sequence[PairRegistration]:
        """The pairs with the inliers that the alignment was made from."""
        return over_rough_ground(aligned.pairs, self.threshold) if aligned.rough else aligned.pairs

    def _explains(
        self, alignment: Alignment, pairs: Sequence[PairRegistration], ground: Sequence[PairRegistration]
    ) -> bool:
        """Whether an alignment predicts most matches that rough ground would add: then it was the lens, not the ground.

        A camera that turns on the spot has no ground near it.
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
    ) -> DraftedPairs:
        """Draft the alignment; near copies are placed afterwards, except those ``counted`` as evidence."""
        if not any(pair.relation for pair in pairs):
            raise RegistrationError(_no_overlap(self.paths, pairs))
        distinct = DistinctPairs.of(pairs, self.options, self.quarters, counted)
        task = self._task(distinct, known)
        of_pairs = TaskOfPairs(pairs, distinct, task)
        drafted, draft_model = self._recalled("draft", task, lambda: (task.draft, task.draft_model))
        draft = self._of_all_images(drafted, of_pairs)
        if misfits := distinct.misfits(draft):
            with_them = self._drafted(pairs, counted=counted | misfits)
            if with_them.alignment.model != draft.model:  # so little new ground tells of motion, but not of the lens
                return with_them
        return DraftedPairs(tuple(pairs), draft, rough=False, task=of_pairs, known=draft_model)

    def _of_all_images(self, alignment: Alignment, of_pairs: TaskOfPairs) -> Alignment:
        """The alignment of a task as that of all upright images, copies included."""
        distinct = of_pairs.distinct
        alignment = self._upright(alignment, of_pairs.task)
        compared = [distinct.registered[ends].images for ends in distinct.evidence]
        alignment = alignment.with_copies(distinct.copies, compared)
        others = links_of_copies(alignment, of_pairs.pairs, self.threshold)
        alignment = replace(alignment, links=(*alignment.links, *others))
        twice = sorted({*distinct.copies, *distinct.near_copies})
        if not twice:
            return alignment
        names = shortened(names_of(self.paths[k] for k in twice))
        text = f"counted once, because they show almost only what other images show: {names}"
        return alignment.with_messages([Message(text, severity="detail", code="copies")])

    def _task(self, distinct: DistinctPairs, known: KnownModel | None) -> AlignmentTask:
        """The task of aligning images as they are stored; images cut to several sizes in a common frame."""
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
        return AlignmentTask(cameras, links[:count], distinct.options, distinct.near_copies, links[count:], known)

    def _recalled(self, stage: str, task: AlignmentTask, compute: Callable[[], Computed]) -> Computed:
        """A result of a task, from the cache if it is there."""
        of_links = (task.links, task.links_of_copies, sorted(task.near_copies.items()))
        inputs = (task.cameras, self.cache.digest(of_links), task.options, task.known)
        return self.cache.recall(stage, inputs, compute)

    def _upright(self, alignment: Alignment, task: AlignmentTask) -> Alignment:
        """Convert an alignment of stored images to one of upright images, each of its own size."""
        sizes = [self.quarters.back.camera(camera, k).image_size for k, camera in enumerate(self.cameras)]
        if any(camera.image_size != size for camera, size in zip(alignment.cameras, sizes, strict=True)):
            alignment = cut_alignment(alignment, sizes)
        return self.quarters.alignment(alignment, task.options.gravity, task.near_copies)

    def metric(self, aligned: DraftedPairs) -> DraftedPairs:
        """A draft of the same pairs by a model with metric poses, where the user left the choice of the model open."""
        if aligned.alignment.poses is not None or aligned.alignment.on_sphere or self.options.model != "auto":
            return aligned
        return replace(self, options=replace(self.options, model="pose")).draft(aligned.pairs)


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
