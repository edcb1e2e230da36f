"""Stage: the layout of a picture, judged by its seams.

Where those of the most probable layout are seen to break, or it stretches what it shows as nobody would, other
hypotheses that join the same images are laid out at the size that seams are found at, and the one of which a person
sees the least is taken: without local alignment, by another surface of the scene, a turn of the camera, a plane, free
homographies, and, where something fills a good part of the images and moves of its own, what lies behind it.
What is chosen is composed without deciding exposure and seams again.
"""

import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cache, partial

import numpy as np

from rdstitch.alignment.frames.reference_frame import frontal_reference, in_frame_of
from rdstitch.alignment.motion_models import MODELS
from rdstitch.alignment.result import Alignment
from rdstitch.alignment.whole_pixels import on_whole_pixels
from rdstitch.arrays import FloatArray, evenly_spaced
from rdstitch.choices import ModelName, Purpose
from rdstitch.compositing.seam_quality import DIAGONAL
from rdstitch.errors import ArgumentError, LimitError
from rdstitch.local_alignment import LocalAlignment, no_local_alignment
from rdstitch.matching.copies import copies_of, without_copies
from rdstitch.options.stitch_options import StitchOptions
from rdstitch.pipeline.composition.lay_out import (
    IMAGE_GRID,
    CandidateLayout,
    RegistrationLayout,
    align_registration_locally,
    is_stretched,
    lay_out,
    straight_edges,
)
from rdstitch.pipeline.registration.aligner import Aligner
from rdstitch.pipeline.registration.realign import by_second_motions, plane_of_most, realigned
from rdstitch.pipeline.registration.working_size import at_full_size
from rdstitch.results.messages import Message
from rdstitch.results.registration import Registration
from rdstitch.verification.verdict import RefusedError

# What a camera can have done: turned, moved over a plane, or anything that joins images of a plane.
_MODELS: tuple[ModelName, ...] = ("rotation", "pose", "homography")
_CLEARLY = 0.5  # share of the broken places up to which another layout is clearly better
_MISFIT = 2.0  # times the errors of the most probable layout that another one may have
_SAMPLED_PAIRS = 500  # pairs whose matches say how large errors are
# Of an image's diagonal: by how much another layout must move more than a few places of the overlaps for its seams to
# be others.
_MIN_SHIFT, _SHIFT_QUANTILE = 3.0 / DIAGONAL, 0.95
_BY_CHANCE = Message(
    "the images are no more alike where they were put together than anywhere else; take images that overlap more",
    severity="failure",
)


@dataclass(frozen=True, eq=False)
class _Trials:
    """Lays out registrations of the same images as the output would have them."""

    options: StitchOptions
    pano: bool
    edges_of: Callable[[int], FloatArray]  # straight edges in an image

    def lay_out(self, registration: Registration, local: LocalAlignment | None = None) -> RegistrationLayout:
        """Lay out a registration in pixels of the working size."""
        options = self.options
        whole = _with_frontal_reference(at_full_size(registration), options, always=self.pano)
        whole = replace(whole, alignment=on_whole_pixels(whole.alignment, whole.pairs))
        if local is None:
            local = align_registration_locally(whole, options.local_alignment, self.edges_of, options.threads)
        return lay_out(whole, local, options.compositing)

    def judge(self, registration: Registration, local: LocalAlignment | None = None) -> CandidateLayout:
        """The same, with exposure and seams."""
        return self.lay_out(registration, local).judged()

    def attempt(self, registration: Registration) -> CandidateLayout | None:
        """Lay out an alternative registration; None where it has no canvas, or none that the options can turn."""
        with suppress(LimitError, ArgumentError):
            return self.judge(registration)
        return None


def choose_layout(registration: Registration, options: StitchOptions, aligner: Aligner) -> RegistrationLayout:
    """Choose the layout whose seams hold, or break least; that of a panorama is in the frame of an image.

    Pixels are those of the working size.
    """
    edges_of = cache(lambda image: straight_edges(registration.sources[image]))
    trials = _Trials(options, aligner.options.purpose is Purpose.PANO, edges_of)
    if options.dry_run:
        return trials.lay_out(registration)
    first, too_large = None, None
    try:
        first = trials.judge(registration)
    except LimitError as error:
        too_large = error
    if first is None or first.seams.mostly_unlike:
        registration, first = _plane_behind(registration, first, trials, aligner)
    tried = [] if first is None else [first]
    for other in _alternatives(registration, first, trials, aligner):
        tried.append(other)
        # Of those that nothing speaks against, the most probable is taken.
        if other.clipped <= tried[0].clipped and not other.faults:
            break
    if too_large is not None and not tried:
        raise too_large
    best = _least_broken(tried, keep_first=first is not None)
    if best.seams.no_better_than_chance and not options.force:
        raise RefusedError(best.registration.with_messages([_BY_CHANCE]))
    return best


def _with_frontal_reference(registration: Registration, options: StitchOptions, *, always: bool) -> Registration:
    """The same registration with an undistorted image as its plane; directions of a turn on the spot stay.

    That is the reference image, unless it was chosen here and another one crosses its horizon. With ``always`` a
    rectified plane, that of one camera's poses, gives way too.
    """
    alignment = registration.alignment
    if alignment.on_sphere or (not always and alignment.poses is not None):
        return registration
    reference = alignment.reference if options.reference is not None else frontal_reference(alignment)
    if not always and reference == alignment.reference:
        return registration
    return replace(registration, alignment=in_frame_of(alignment, reference))


def _plane_behind(
    registration: Registration, first: CandidateLayout | None, trials: _Trials, aligner: Aligner
) -> tuple[Registration, CandidateLayout | None]:
    """The plane behind moving objects, with its layout, if its images look more alike; else what is given."""
    plane = plane_of_most(registration, aligner, trials.options.threads)
    if plane is None or not _joins(plane, registration, aligner.threshold):
        return registration, first
    behind = trials.attempt(plane)
    # What is put where it does not belong is unlike all over what the images show.
    if behind is None or (first is not None and behind.seams.fills <= first.seams.fills):
        return registration, first
    return plane, behind


def _alternatives(
    registration: Registration, first: CandidateLayout | None, trials: _Trials, aligner: Aligner
) -> Iterator[CandidateLayout]:
    """Alternative layouts, likeliest first, if the first has faults or no canvas."""
    if first is not None:
        if not first.faults:
            return
        if first.local.fields and trials.options.local_alignment == "auto":
            yield trials.judge(registration, no_local_alignment("seams hold better without it"))
        if first.local.by_heights:
            return  # parallax that the places of the cameras explain is not that of another model
        if (other_surface := _other_surface(registration, first, trials, aligner)) is not None:
            yield other_surface
    for other in _other_models(registration, first, trials.options, aligner):
        if (laid_out := trials.attempt(other)) is not None:
            yield laid_out


def _other_surface(
    registration: Registration, first: CandidateLayout, trials: _Trials, aligner: Aligner
) -> CandidateLayout | None:
    """The layout by the second motion of the images whose seams break; None if they do not look more alike."""
    used = np.flatnonzero(registration.alignment.used).tolist()
    broken = [(used[one.images[0]], used[one.images[1]]) for one in first.seams.misfits]
    other = by_second_motions(registration, broken, aligner)
    if other is None or not _joins(other, registration, _MISFIT * _error(registration)):
        return None
    reason = f"{other.alignment.model_reason}; by another surface of the scene, where seams break less"
    laid_out = trials.attempt(replace(other, alignment=replace(other.alignment, model_reason=reason)))
    if laid_out is None or laid_out.seams.fills < first.seams.fills:
        return None
    return laid_out


def _least_broken(tried: Sequence[CandidateLayout], *, keep_first: bool) -> CandidateLayout:
    """The layout with the fewest faults; or the first, unless another is clearly better."""
    first = tried[0]
    best = min((one for one in tried if one.clipped <= first.clipped), key=lambda one: (one.faults, one.broken))
    broken = 0 if first.seams.seams_fit else first.broken
    clearly = best.faults < first.faults or best.broken <= _CLEARLY * broken
    return best if clearly or not keep_first else first


def _other_models(
    registration: Registration, first: CandidateLayout | None, options: StitchOptions, aligner: Aligner
) -> Iterator[Registration]:
    """The images aligned by other motion models, if each still finds its place."""
    alignment = registration.alignment
    # What breaks along seams may have moved, and proves nothing against a layout that fits; one that is stretched does.
    stretched = first is None or is_stretched(first.layout)
    allowed = max(options.threshold * stretched, _MISFIT * _error(registration))
    names = [name for name in _MODELS if name != alignment.model] if options.model == "auto" else []
    if first is not None and first.layout.placed.has_place:  # a map needs a plane with a metric
        names = [name for name in names if MODELS[name].has_metric_poses]
    for name in names:
        by_name = replace(aligner, options=replace(aligner.options, model=name))
        other = realigned(registration, by_name, partial(_differs, registration, allowed, stretched=stretched))
        if other is not None and _joins(other, registration, allowed):
            reason = f"seams break less than with a {alignment.model} model"
            yield replace(other, alignment=replace(other.alignment, model_reason=reason))


def _joins(other: Registration, first: Registration, allowed: float) -> bool:
    """Whether another registration uses all images of the first, with errors up to ``allowed``, pixels.

    Without this limit local alignment would make the seams of any registration hold.
    """
    return bool((other.alignment.used >= first.alignment.used).all()) and _error(other) <= allowed


def _error(registration: Registration) -> float:
    """Median error of the inliers of the pairs, pixels.

    All count, also those that do not fit the alignment: a turn that fits every other match well is no measure of a
    homography that fits all of them.
    """
    used, transfer = registration.alignment.used, registration.alignment.transfer
    distinct_pairs = without_copies(registration.pairs, copies_of(registration.pairs)).values()
    pairs = [pair for pair in distinct_pairs if used[pair.image1] and used[pair.image2]]
    some = [pairs[k] for k in evenly_spaced(len(pairs), _SAMPLED_PAIRS).tolist()]
    errors = np.concatenate([np.zeros(0), *(pair.errors(transfer)[pair.relation.inliers] for pair in some)])
    return float(np.median(errors)) if len(errors) else math.inf


def _differs(registration: Registration, allowed: float, other: Alignment, *, stretched: bool) -> bool:
    """Whether another alignment can change the seams: it joins the images and moves their overlaps."""
    alignment = registration.alignment
    if not _joins(replace(registration, alignment=other), registration, allowed):
        return False
    if stretched:
        return True
    moved = [np.zeros(1)]
    for i, j in alignment.support:
        points = IMAGE_GRID * alignment.cameras[i].image_size
        before, after = (one.transfer(i, j, points) for one in (alignment, other))
        inside = ((before >= 0.0) & (before < alignment.cameras[j].image_size)).all(axis=1)
        moved.append(np.linalg.norm(after - before, axis=1)[inside] / (2.0 * alignment.cameras[j].scale))
    shifts = np.nan_to_num(np.concatenate(moved), nan=np.inf)  # where a lens cannot see them
    return not np.quantile(shifts, _SHIFT_QUANTILE, method="higher") <= _MIN_SHIFT
