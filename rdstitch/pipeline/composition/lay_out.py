"""Stages: local alignment, and the layout of a registration on the canvas of the output, with its faults."""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from rdstitch.arrays import FloatArray
from rdstitch.choices import LocalAlignmentMode
from rdstitch.compositing.projection import PLANE
from rdstitch.compositing.seam_quality import SeamQuality
from rdstitch.features.line_segments import MEGAPIXELS, line_segments
from rdstitch.inputs.source import Source
from rdstitch.local_alignment import LocalAlignment, PutativeMatches, align_locally, no_local_alignment
from rdstitch.matching.two_view import PairRegistration
from rdstitch.options.composite_options import CompositeOptions
from rdstitch.pipeline.composition.compose import CanvasLayout, DecidedLayout
from rdstitch.pipeline.composition.straighten import oriented
from rdstitch.results.messages import Message
from rdstitch.results.placed_images import PlacedImages
from rdstitch.results.registration import Registration
from rdstitch.verification.limits import Limits

# Places (25, 2) all over an image, in shares of its width and height.
IMAGE_GRID = np.stack(np.meshgrid(*[[0.02, 0.25, 0.5, 0.75, 0.98]] * 2), axis=-1).reshape(-1, 2)


@dataclass(frozen=True)
class RegistrationLayout:
    """A registration in the frame of the output, with its images on a canvas."""

    registration: Registration
    local: LocalAlignment
    layout: CanvasLayout
    messages: tuple[Message, ...] = ()

    def judged(self) -> "CandidateLayout":
        """The same with seams, by which layouts are compared."""
        return CandidateLayout(self.registration, self.local, self.layout.decided(), self.messages)


@dataclass(frozen=True)
class CandidateLayout(RegistrationLayout):
    """A layout that may be chosen, by its seams."""

    layout: DecidedLayout

    @property
    def seams(self) -> SeamQuality:
        """What its seams are like."""
        return self.layout.decisions.quality

    @cached_property
    def faults(self) -> int:
        """Number of faults, 0 to 4: misfitting seams, stretching, unlike overlaps, unjudged local alignment."""
        seams = self.seams
        unjudged = bool(self.local.fields) and not len(seams.places)
        return int(not seams.seams_fit) + int(is_stretched(self.layout)) + int(seams.mostly_unlike) + int(unjudged)

    @property
    def clipped(self) -> int:
        """Number of images of which only the near part is drawn."""
        return sum(part is not None for part in self.layout.canvas.near)

    @property
    def broken(self) -> int:
        """Number of places at which its seams do not fit; places are equally spaced in every layout."""
        return int(self.seams.misfit.sum())


def straight_edges(source: Source) -> FloatArray:
    """Ends (N, 2, 2) of the straight edges in an image, pixels."""
    return line_segments(source.view(MEGAPIXELS))[0]


def align_registration_locally(
    registration: Registration,
    choice: LocalAlignmentMode,
    edges: Callable[[int], FloatArray] | None = None,
    threads: int = 1,
) -> LocalAlignment:
    """Estimate displacement fields of the images used, in their order, from the matches of all pairs.

    ``edges`` are those of an image that fields should not bend.
    """
    if choice == "off":
        return no_local_alignment("switched off")
    alignment = registration.alignment
    used, poses = np.flatnonzero(alignment.used), alignment.poses
    position = np.cumsum(alignment.used) - 1
    pairs = [pair for pair in registration.used_pairs if pair.relation]

    def match(pair: PairRegistration) -> PutativeMatches:
        found = pair.correspondences
        return PutativeMatches(int(position[pair.image1]), int(position[pair.image2]), found.points1, found.points2)

    def edges_of(images: list[int]) -> list[FloatArray]:
        with ThreadPoolExecutor(threads) as pool:
            return list(pool.map(edges or (lambda k: straight_edges(registration.sources[k])), used[images].tolist()))

    return align_locally(
        map(match, pairs),
        [alignment.cameras[k] for k in used],
        alignment.homographies[used],
        choice,
        pairs=len(pairs),
        on_sphere=alignment.on_sphere,
        centers=None if poses is None or alignment.on_sphere else np.column_stack([poses.position, poses.height])[used],
        edges=edges_of,
    )


def lay_out(registration: Registration, local: LocalAlignment, options: CompositeOptions) -> RegistrationLayout:
    """Lay the images of a registration out on the canvas of the output."""
    placed, messages = oriented(PlacedImages.of(registration, local.fields or None), options)
    if placed.orientation is not None:
        homographies = placed.orientation @ registration.alignment.homographies
        registration = replace(registration, alignment=replace(registration.alignment, homographies=homographies))
    return RegistrationLayout(registration, local, CanvasLayout.of(placed, options), tuple(messages))


def is_stretched(layout: CanvasLayout) -> bool:
    """Whether a plane magnifies some places much more than most, or stretches them in one direction, lens aside."""
    canvas = layout.canvas
    if canvas.projection != PLANE:
        return False
    magnification = []
    for image in layout.images:
        size = np.array(image.camera.image_size)
        at, step = IMAGE_GRID * size, 1e-3 * size[1]
        # A fisheye's border is stretched on any plane.
        flat = replace(image.camera, distortion=0.0, distortion2=0.0, distortion3=0.0, image_circle=None)
        middle, right, down = (canvas.place(flat, image.homography, at + d) for d in ((0, 0), (step, 0), (0, step)))
        visible = np.isfinite(middle + right + down).all(axis=1)
        jacobian = np.stack([right - middle, down - middle], axis=-1)[visible] / step
        magnification.append(np.linalg.svd(jacobian, compute_uv=False))
    every = np.concatenate(magnification)
    largest = float(every[:, 0].max() / np.median(every[:, 0]))
    aspect = float(np.median(every[:, 0] / every[:, 1]))
    return largest > Limits.max_magnification or aspect > Limits.max_aspect
