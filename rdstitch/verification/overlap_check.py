"""A second opinion on a registration: do the images look alike where it puts them together?"""

import functools
from collections.abc import Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from itertools import chain

import numpy as np

from rdstitch.alignment.motion_models.rotation import nearest_rotation
from rdstitch.alignment.result import LinkFit
from rdstitch.arrays import FloatArray
from rdstitch.cache import NO_CACHE, Cache
from rdstitch.camera import Camera
from rdstitch.executors import in_order
from rdstitch.inputs.input_guard import GuardNotes
from rdstitch.inputs.source import Source
from rdstitch.io.reduction import fitting_reduction
from rdstitch.registration import Registration
from rdstitch.verification.photometric_agreement import (
    COMPARED_SIDE,
    Agreement,
    ComparedImage,
    Parallax,
    as_compared,
    overlap_agreement,
)
from rdstitch.verification.self_similarity import SLACK, Ambiguity, Drawing, draw, drawing_scale, placement_ambiguity
from rdstitch.verification.unique_places import unique_shifts

_MAX_LINKS = 40
"""Links that are looked at in a large set; the least confirmed ones."""

_LINKS_AT_ONCE = 5
"""Links of a task at the most, so that a few keep several workers busy."""


@dataclass(frozen=True)
class CheckedLink:
    """A link and what the pixels say of it.

    Attributes
    ----------
    fit : LinkFit
    agreement : Agreement
        Whether the two look alike where they are put together.
    ambiguity : Ambiguity
        Whether they would look as much alike elsewhere.
    unique : bool
        Whether they would, but for something unique that both show, which shows that they lie here.
    """

    fit: LinkFit
    agreement: Agreement
    ambiguity: Ambiguity
    unique: bool = False

    @property
    def pair(self) -> tuple[int, int]:
        """Its images."""
        return self.fit.image1, self.fit.image2


@dataclass(frozen=True)
class OverlapTask:
    """Links to be looked at together.

    Attributes
    ----------
    links : sequence of (LinkFit, float)
        With the scale that the two images are drawn at, pixels a unit of the plane.
    sources : mapping of int to Source
        The images of these links.
    cameras : mapping of int to Camera
    homographies : mapping of int to ndarray of shape (3, 3)
    stretch : (float, float) or None
        Grey levels of black and white.
    on_sphere : bool
        Whether the homographies lead to directions.
    metric : bool
        Whether they lead to a plane on which a period of a pattern is the same everywhere.
    parallax : mapping of (int, int) to Parallax
        Of the links over rough ground, pixels of the size that features are detected at.
    """

    links: Sequence[tuple[LinkFit, float]]
    sources: Mapping[int, Source]
    cameras: Mapping[int, Camera]
    homographies: Mapping[int, FloatArray]
    stretch: tuple[float, float] | None
    on_sphere: bool
    metric: bool
    parallax: Mapping[tuple[int, int], Parallax]


def check_overlaps(registration: Registration, executor: Executor, cache: Cache = NO_CACHE) -> list[CheckedLink]:
    """Compare the images of every used link, or of those that the fewest others confirm.

    Parameters
    ----------
    registration : Registration
    executor : concurrent.futures.Executor
        Where batches of links are looked at.
    cache : Cache

    Raises
    ------
    InputError
        When an image can no longer be read.
    """
    alignment = registration.alignment
    chosen = _least_confirmed([fit for fit in alignment.links if fit.used])
    images = sorted(set(chain.from_iterable((fit.image1, fit.image2) for fit in chosen)))
    placed = [
        (k, source.content(cache), source.mask_content(cache), alignment.cameras[k], alignment.homographies[k])
        for k, source in ((k, registration.sources[k]) for k in images)
    ]

    parallax = _parallax(registration, chosen)

    def compute() -> list[CheckedLink]:
        checked: list[CheckedLink] = []
        for found, notes in in_order(executor, compare_overlaps, _tasks(registration, chosen, parallax)):
            registration.sources[0].guard.learn(notes)
            checked += found
        return checked

    inputs = (placed, chosen, registration.stretch, list(parallax.values()))
    return cache.recall("overlaps", inputs, compute)


def share_alike(checked: Sequence[CheckedLink]) -> float:
    """Share of all overlaps together that looks alike, in [0, 1]; NaN where nothing was compared."""
    cells = sum(link.agreement.cells for link in checked)
    return sum(link.agreement.confirming for link in checked) / cells if cells else float("nan")


def _parallax(registration: Registration, chosen: Sequence[LinkFit]) -> dict[tuple[int, int], Parallax]:
    """Of links over rough ground, as their inliers show it; nothing where the ground is flat."""
    alignment = registration.alignment
    if alignment.on_sphere or not alignment.relief.found:
        return {}
    pairs = {(pair.image1, pair.image2): pair for pair in registration.pairs}
    result = {}
    for images in ((fit.image1, fit.image2) for fit in chosen):
        link = pairs[images].link()
        expected = alignment.transfer(*images, link.points1)
        seen = np.isfinite(expected).all(axis=1)
        if seen.any():
            result[images] = Parallax(expected[seen], (link.points2 - expected)[seen])
    return result


def _tasks(
    registration: Registration, chosen: Sequence[LinkFit], parallax: Mapping[tuple[int, int], Parallax]
) -> list[OverlapTask]:
    """Batches of links that follow one another, which have images in common."""
    alignment = registration.alignment
    scales = [1.0] * len(chosen)
    if not alignment.on_sphere:
        compared = (as_compared(alignment.cameras[fit.image2]) for fit in chosen)
        fitting = [
            drawing_scale(camera, alignment.homographies[fit.image2])
            for camera, fit in zip(compared, chosen, strict=True)
        ]
        scales = _scales(fitting)
    tasks = []
    for start in range(0, len(chosen), _LINKS_AT_ONCE):
        links = list(zip(chosen, scales, strict=True))[start : start + _LINKS_AT_ONCE]
        own = sorted({k for fit, _ in links for k in (fit.image1, fit.image2)})
        sources = {k: registration.sources[k] for k in own}
        cameras, places = {k: alignment.cameras[k] for k in own}, {k: alignment.homographies[k] for k in own}
        metric = alignment.poses is not None
        known = {pair: parallax[pair] for pair in ((fit.image1, fit.image2) for fit, _ in links) if pair in parallax}
        tasks.append(
            OverlapTask(links, sources, cameras, places, registration.stretch, alignment.on_sphere, metric, known)
        )
    return tasks


def compare_overlaps(task: OverlapTask) -> tuple[list[CheckedLink], GuardNotes]:
    """Read the images of a task, and compare those of each link; and what was noticed of the files."""
    placed = {
        k: placed_image(source, task.cameras[k], task.homographies[k], task.stretch)
        for k, source in task.sources.items()
    }

    @functools.cache
    def drawing(index: int, scale: float) -> Drawing:
        return draw(placed[index], scale)

    def compare(fit: LinkFit, scale: float) -> CheckedLink:
        if task.on_sphere:
            return _compare_around(fit, placed[fit.image1], placed[fit.image2])
        i, j = fit.image1, fit.image2
        ambiguity = placement_ambiguity(drawing(i, scale), drawing(j, scale))
        moved = task.parallax.get((i, j))
        if moved is not None:
            moved = moved.resized(task.cameras[j], placed[j].camera)
        return CheckedLink(fit, overlap_agreement(placed[i], placed[j], moved), ambiguity)

    checked = [compare(*link) for link in task.links]
    if task.metric:
        checked = _by_what_is_unique(placed, checked)
    sources = list(task.sources.values())
    return checked, sources[0].guard.notes_on([source.path for source in sources])


def placed_image(
    source: Source, camera: Camera, homography: FloatArray, stretch: tuple[float, float] | None
) -> ComparedImage:
    """Read an image small, and put it where an alignment has it.

    Raises
    ------
    InputError
        When it can no longer be read.
    """
    image = source.read(fitting_reduction(max(source.camera.image_size) / COMPARED_SIDE), keep=True)
    return ComparedImage.of(image, camera, homography, stretch)


def _by_what_is_unique(placed: Mapping[int, ComparedImage], checked: Sequence[CheckedLink]) -> list[CheckedLink]:
    """The same links; those that are ambiguous but for something unique are known to be."""
    shifts = unique_shifts(placed, [link.pair for link in checked if link.ambiguity.ambiguous])

    def lies_here(link: CheckedLink) -> bool:
        there = placed[link.fit.image2]
        off = np.hypot(*shifts[link.pair].shift) * drawing_scale(there.camera, there.homography)
        return bool(off <= SLACK)

    return [replace(link, unique=link.pair in shifts and lies_here(link)) for link in checked]


def _compare_around(fit: LinkFit, first: ComparedImage, second: ComparedImage) -> CheckedLink:
    """No plane shows all images of a turn; one between the two shows both, and stretches what both show the least.

    What both show has the pixels there that the middle of an image has on a plane that it sees straight on.
    """
    both = np.stack([first.homography, second.homography])
    intrinsics = np.linalg.norm(both, axis=1)
    scale = drawing_scale(second.camera, np.diag(intrinsics[1]))
    to_plane = nearest_rotation((both / intrinsics[:, None]).sum(axis=0)).T @ both
    first, second = replace(first, homography=to_plane[0]), replace(second, homography=to_plane[1])
    ambiguity = placement_ambiguity(draw(first, scale), draw(second, scale))
    return CheckedLink(fit, overlap_agreement(first, second), ambiguity)


def _scales(fitting: Sequence[float]) -> list[float]:
    """The scales that fit, but few different ones, so that an image is drawn once and not for every link."""
    middle = np.median(fitting)
    return [float(middle * 2.0 ** np.rint(np.log2(scale / middle))) for scale in fitting]


def _least_confirmed(links: Sequence[LinkFit]) -> list[LinkFit]:
    """The links in the fewest triangles, then those with the fewest inliers; in their own order."""
    beside: dict[int, set[int]] = {}
    for fit in links:
        beside.setdefault(fit.image1, set()).add(fit.image2)
        beside.setdefault(fit.image2, set()).add(fit.image1)
    doubtful = sorted(links, key=lambda fit: (len(beside[fit.image1] & beside[fit.image2]), fit.inliers))
    chosen = {(fit.image1, fit.image2) for fit in doubtful[:_MAX_LINKS]}
    return [fit for fit in links if (fit.image1, fit.image2) in chosen]
