"""Stage: the layout of a picture, judged by its seams.

Where those of the most probable layout are seen to break, or it stretches what it shows as nobody would, other
hypotheses that join the same images are laid out at the size that seams are found at, and the one of which a person
sees the least is taken: without local alignment, a turn of the camera, a plane, free homographies, and, where something
fills a good part of the images and moves of its own, what lies behind it.
"""

from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cache, partial

import numpy as np

from rdstitch.alignment.result import Alignment
from rdstitch.arrays import FloatArray
from rdstitch.choices import Purpose
from rdstitch.compositing.projection import PLANE
from rdstitch.compositing.seam_quality import DIAGONAL
from rdstitch.errors import ArgumentError, LimitError, RdstitchError
from rdstitch.local_alignment import LocalAlignment, no_local_alignment
from rdstitch.options.composite_options import CompositeOptions
from rdstitch.options.stitch_options import StitchOptions
from rdstitch.pipeline.accept import plane_of_most, realigned
from rdstitch.pipeline.aligner import Aligner
from rdstitch.pipeline.compose import Layout
from rdstitch.pipeline.placed_images import PlacedImages, align_registration_locally, straight_edges
from rdstitch.pipeline.register import with_frontal_reference
from rdstitch.pipeline.straighten import turned
from rdstitch.pipeline.whole_pixels import on_whole_pixels
from rdstitch.pipeline.working_size import at_full_size
from rdstitch.results.messages import Message
from rdstitch.results.registration import Registration
from rdstitch.verification.verdict import RefusedError

_MODELS = ("rotation", "pose", "homography")
"""What a camera can have done: turned, moved over a plane, or anything that joins images of a plane."""

_MAX_MAGNIFICATION, _MAX_ASPECT = 4.0, 2.0
"""Of a place over the median one, and of its two directions: those of a plane seen 60 degrees off its normal."""

_CLEARLY = 0.5
"""Share of the broken places up to which another layout is clearly better."""

_MISFIT = 2.0
"""Times the errors of the most probable layout that another one may have."""

_ELSEWHERE, _MOST = 3.0 / DIAGONAL, 0.95
"""Of an image's diagonal: by how much another layout must move more than a few places of the overlaps for its seams to
be others."""

_BY_CHANCE = Message(
    "the images are no more alike where they were put together than anywhere else; take images that overlap more",
    severity="failure",
)

_GRID = np.stack(np.meshgrid(*[[0.02, 0.25, 0.5, 0.75, 0.98]] * 2), axis=-1).reshape(-1, 2)


@dataclass(frozen=True)
class LaidOut:
    """A registration in the frame of the output, with its layout."""

    registration: Registration
    local: LocalAlignment
    layout: Layout
    messages: tuple[Message, ...] = ()

    @property
    def faults(self) -> int:
        """What speaks against it: broken seams, stretched places, overlaps that do not look alike, and local alignment
        whose seams lie nowhere where they could be judged, 0 to 4.
        """
        seams = self.layout.seams
        unjudged = bool(self.local.fields) and not len(seams.places)
        return int(seams.seen) + int(_is_stretched(self.layout)) + int(seams.contradicted) + int(unjudged)

    @property
    def clipped(self) -> int:
        """Number of images of which only the near part is drawn."""
        return sum(part is not None for part in self.layout.canvas.near)

    @property
    def broken(self) -> int:
        """Number of places at which its seams are broken; they are as far apart in every layout."""
        return int(self.layout.seams.broken.sum())


def lay_out(registration: Registration, local: LocalAlignment, options: CompositeOptions) -> LaidOut:
    """Images of a registration on the canvas of the output."""
    placed, said = turned(PlacedImages.of(registration, local.fields or None), options)
    if placed.orientation is not None:
        homographies = placed.orientation @ registration.alignment.homographies
        registration = replace(registration, alignment=replace(registration.alignment, homographies=homographies))
    return LaidOut(registration, local, Layout.of(placed, options), tuple(said))


def choose_layout(registration: Registration, options: StitchOptions, aligner: Aligner) -> LaidOut:
    """The layout whose seams hold, or break the least; of a panorama always in the frame of an image.

    Pixels are those of the working size.
    """
    pano = aligner.options.purpose is Purpose.PANO

    @cache
    def edges(image: int) -> FloatArray:
        return straight_edges(registration.sources[image])

    def laid(candidate: Registration, local: LocalAlignment | None = None) -> LaidOut:
        whole = on_whole_pixels(with_frontal_reference(at_full_size(candidate), options, always=pano))
        if local is None:
            local = align_registration_locally(whole, options.local_alignment, edges, options.threads)
        one = lay_out(whole, local, options.composite)
        return one if options.dry_run else replace(one, layout=one.layout.decided(options.compositing))

    failed: RdstitchError | None = None
    tried: list[LaidOut] = []
    try:
        tried.append(laid(registration))
    except LimitError as error:
        failed = error
    if not options.dry_run and not (tried and not tried[0].layout.seams.contradicted):
        plane = plane_of_most(registration, options, aligner)
        if plane is not None and _joins(plane.alignment, registration.alignment, options.threshold):
            with suppress(LimitError):
                rival = laid(plane)
                # What is put where it does not belong is unlike all over what the images show.
                if not tried or rival.layout.seams.fills > tried[0].layout.seams.fills:
                    registration, tried, failed = plane, [rival], None
    if options.dry_run or (tried and not tried[0].faults):
        return _first(tried, failed)
    if tried and tried[0].local.fields and options.local_alignment == "auto":
        tried.append(laid(registration, no_local_alignment("seams hold better without it")))
    others = _others(registration, options, aligner, tried[0] if tried else None)
    # Of those that nothing speaks against, the most probable is taken.
    while not (tried and tried[-1].clipped <= tried[0].clipped and not tried[-1].faults):
        if (other := next(others, None)) is None:
            break
        try:
            tried.append(laid(other))
        except (LimitError, ArgumentError):
            continue
    first = _first(tried, failed)
    whole = [one for one in tried if one.clipped <= first.clipped]
    best = min(whole, key=lambda one: (one.faults, one.broken))
    broken = first.broken if first.layout.seams.seen else 0
    if failed is None and best.faults == first.faults and best.broken > _CLEARLY * broken:
        best = first
    if best.layout.seams.by_chance and not options.force:
        raise RefusedError(best.registration.with_messages([_BY_CHANCE]))
    return best


def _first(tried: list[LaidOut], failed: RdstitchError | None) -> LaidOut:
    if tried:
        return tried[0]
    assert failed is not None
    raise failed


def _others(
    registration: Registration, options: StitchOptions, aligner: Aligner, first: LaidOut | None
) -> Iterator[Registration]:
    """Other registrations that use every image that this one does."""
    alignment = registration.alignment
    # What breaks along seams may have moved, and proves nothing against a layout that fits; one that is stretched does.
    stretched = first is None or _is_stretched(first.layout)
    allowed = max(options.threshold * stretched, _MISFIT * alignment.rms)
    names = [name for name in _MODELS if name != alignment.model] if options.model == "auto" else []
    if first is not None and first.layout.placed.has_place:  # a map needs a plane with a metric
        names = [name for name in names if name == "pose"]
    for name in names:
        by_name = replace(aligner, options=replace(aligner.options, model=name))
        other = realigned(registration, by_name, partial(_differs, registration, allowed, stretched=stretched))
        if other is not None and _joins(other.alignment, alignment, allowed):
            reason = f"{other.alignment.model_reason.removesuffix('; as requested')}; seams break less than with a "
            reason += f"{alignment.model} model"
            yield replace(other, alignment=replace(other.alignment, model_reason=reason))


def _joins(other: Alignment, alignment: Alignment, allowed: float) -> bool:
    """Whether another alignment uses all images of one, with errors that are allowed: local alignment makes seams hold
    that nothing else does.
    """
    return bool((other.used >= alignment.used).all()) and other.rms <= allowed


def _differs(registration: Registration, allowed: float, other: Alignment, *, stretched: bool) -> bool:
    """Whether another alignment can have other seams: it joins the images, and puts them elsewhere on each other."""
    alignment = registration.alignment
    if not _joins(other, alignment, allowed):
        return False
    if stretched:
        return True
    moved = [np.zeros(1)]
    for i, j in alignment.support:
        points = _GRID * alignment.cameras[i].image_size
        before, after = (one.transfer(i, j, points) for one in (alignment, other))
        inside = ((before >= 0.0) & (before < alignment.cameras[j].image_size)).all(axis=1)
        moved.append(np.linalg.norm(after - before, axis=1)[inside] / (2.0 * alignment.cameras[j].scale))
    return not np.quantile(np.nan_to_num(np.concatenate(moved), nan=np.inf), _MOST) <= _ELSEWHERE


def _is_stretched(layout: Layout) -> bool:
    """Whether a plane shows some places much larger than most, or much longer than wide, lens apart."""
    canvas = layout.canvas
    if canvas.projection != PLANE:
        return False
    magnification = []
    for image in layout.images:
        size = np.array(image.camera.image_size)
        at, step = _GRID * size, 1e-3 * size[1]
        # A fisheye's border is stretched on any plane.
        flat = replace(image.camera, distortion=0.0, distortion2=0.0, distortion3=0.0, image_circle=None)
        middle, right, down = (canvas.place(flat, image.homography, at + d) for d in ((0, 0), (step, 0), (0, step)))
        shown = np.isfinite(middle + right + down).all(axis=1)
        jacobian = np.stack([right - middle, down - middle], axis=-1)[shown] / step
        magnification.append(np.linalg.svd(jacobian, compute_uv=False))
    every = np.concatenate(magnification)
    largest = float(every[:, 0].max() / np.median(every[:, 0]))
    return largest > _MAX_MAGNIFICATION or float(np.median(every[:, 0] / every[:, 1])) > _MAX_ASPECT
