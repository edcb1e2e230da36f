"""A second opinion on a registration: do the images look alike where it puts them together?"""

from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import chain
from threading import Lock

import numpy as np

from rdstitch.alignment.result import Alignment, LinkFit
from rdstitch.arrays import FloatArray
from rdstitch.geometry.camera import Camera
from rdstitch.geometry.planar_motion import nearest_rotation
from rdstitch.inputs.source import Source
from rdstitch.io.reduction import fitting_reduction
from rdstitch.results.registration import Registration
from rdstitch.system.cache import NO_CACHE, Cache
from rdstitch.verification.limits import Limits
from rdstitch.verification.photometric_agreement import (
    COMPARED_SIDE,
    Agreement,
    ComparedImage,
    overlap_agreement,
)
from rdstitch.verification.self_similarity import SLACK, Ambiguity, drawing_scale, find_ambiguity
from rdstitch.verification.unique_places import IMAGES_AT_ONCE, unique_shifts

_MAX_LINKS = 40  # up to which all are looked at; of more, so many of the least confirmed, and some of all at random
# Links that are taken at random, at most: if none of 300 is wrong, with a confidence of 95 % less than one in a hundred
# is, however many there are.
_MOST_SAMPLED = 300
_SAMPLED_FRACTION = 0.05  # of all links, that are taken at random
_CONFIDENCE = 1.645  # standard deviations that a normal variable exceeds with a probability of 5 %
_CACHED_IMAGES = 128  # that are kept while pairs are compared, 1 MB each


@dataclass(frozen=True)
class CheckedLink:
    """A link and what the pixels say of it."""

    fit: LinkFit
    agreement: Agreement  # whether the two look alike where they are put together
    ambiguity: Ambiguity  # whether they would look as much alike elsewhere
    # whether they would, but for something unique that both show, which shows that they lie here
    decided_by_unique_content: bool = False
    sampled: bool = False  # whether it was taken at random from more

    @property
    def ambiguous(self) -> bool:
        """Whether nothing decides between this place and another."""
        return self.ambiguity.ambiguous and not self.decided_by_unique_content

    @property
    def pair(self) -> tuple[int, int]:
        """Its images."""
        return self.fit.images


class ComparedImages:
    """The images of a set as they are compared, each of them read once.

    ``stretch``: grey levels of black and white; ``threads``: images that are read and pairs that are compared at the
    same time.
    """

    def __init__(self, sources: Sequence[Source], stretch: tuple[float, float] | None, threads: int = 1) -> None:
        self.threads = threads
        self._locks = [Lock() for _ in sources]  # links of one image are compared at the same time

        @lru_cache(_CACHED_IMAGES)
        def read(k: int) -> ComparedImage:
            reduction = fitting_reduction(max(sources[k].camera.image_size) / COMPARED_SIDE)
            return ComparedImage.of(sources[k].read(reduction, keep=True), sources[k].camera, np.eye(3), stretch)

        self._read = read

    def placed(self, k: int, camera: Camera, homography: FloatArray) -> ComparedImage:
        """An image where a homography puts it, with a camera of any size."""
        with self._locks[k]:
            image = self._read(k)
        return replace(image, camera=camera.resized(image.camera.image_size), homography=homography)

    def aligned(self, alignment: Alignment, images: Iterable[int]) -> dict[int, ComparedImage]:
        """Some images where an alignment puts them."""
        chosen = sorted(set(images))
        with ThreadPoolExecutor(self.threads) as pool:
            every = pool.map(lambda k: self.placed(k, alignment.cameras[k], alignment.homographies[k]), chosen)
            return dict(zip(chosen, every, strict=True))


def check_overlaps(registration: Registration, images: ComparedImages, cache: Cache = NO_CACHE) -> list[CheckedLink]:
    """Compare the images of every used link; of many, of the least confirmed and of some at random."""
    alignment = registration.alignment
    used = [fit for fit in alignment.links if fit.used]
    sampled = _at_random(used)
    looked_at = _least_confirmed(used) | sampled
    chosen = [fit for fit in used if fit.images in looked_at]
    every = sorted(set(chain.from_iterable(fit.images for fit in chosen)))
    described = [
        (k, source.content(cache), source.mask_content(cache), alignment.cameras[k], alignment.homographies[k])
        for k, source in ((k, registration.sources[k]) for k in every)
    ]

    def compute() -> list[CheckedLink]:
        def compare(fit: LinkFit) -> CheckedLink:
            one, two = (images.placed(k, alignment.cameras[k], alignment.homographies[k]) for k in fit.images)
            both = _between(one, two) if alignment.on_sphere else (one, two)
            return CheckedLink(fit, overlap_agreement(*both), find_ambiguity(*both), sampled=fit.images in sampled)

        with ThreadPoolExecutor(images.threads) as pool:
            checked = list(pool.map(compare, chosen))
        if alignment.poses is None or alignment.on_sphere:
            # On a plane that is not metric a period of a pattern is another shift at every place.
            return checked
        return _resolve_by_departures(images, alignment, checked)

    inputs = (described, chosen, registration.stretch, alignment.on_sphere, alignment.poses is None)
    return cache.recall("overlaps", inputs, compute)


def wrong_at_most(checked: Sequence[CheckedLink]) -> float:
    """Fraction of all links that may look unlike, by those taken at random (Wilson's upper bound, 95 %); 1 without."""
    sampled = [link.agreement.confirming_fraction for link in checked if link.sampled]
    known = [fraction for fraction in sampled if fraction is not None]
    if not known:
        return 1.0
    count, wrong, z = len(known), sum(fraction < Limits.max_unlike_fraction for fraction in known), _CONFIDENCE
    middle = wrong + z**2 / 2.0
    return float((middle + z * np.sqrt(wrong * (count - wrong) / count + z**2 / 4.0)) / (count + z**2))


def _resolve_by_departures(
    images: ComparedImages, alignment: Alignment, checked: Sequence[CheckedLink]
) -> list[CheckedLink]:
    """The same links; of those that are ambiguous, what is unique in both images decides some."""
    decided: set[tuple[int, int]] = set()
    for pairs in _few_images([link.pair for link in checked if link.ambiguity.ambiguous]):
        placed = images.aligned(alignment, chain.from_iterable(pairs))
        for (first, second), unique in unique_shifts(placed, pairs, images.threads).items():
            image = placed[second]
            if np.hypot(*unique.shift) * drawing_scale(image.camera, image.homography) <= SLACK:
                decided.add((first, second))
    return [replace(link, decided_by_unique_content=link.pair in decided) for link in checked]


def _few_images(pairs: Iterable[tuple[int, int]]) -> Iterator[list[tuple[int, int]]]:
    """Pairs in groups, each of no more images than may be compared by what is unique at once."""
    group: list[tuple[int, int]] = []
    for pair in pairs:
        if len({*pair, *chain.from_iterable(group)}) > IMAGES_AT_ONCE:
            yield group
            group = []
        group.append(pair)
    yield group


def _between(first: ComparedImage, second: ComparedImage) -> tuple[ComparedImage, ComparedImage]:
    """Two images of a turn on a plane between them, as no plane shows all: it stretches what both show the least."""
    both = np.stack([first.homography, second.homography])
    to_plane = nearest_rotation((both / np.linalg.norm(both, axis=1)[:, None]).sum(axis=0)).T @ both
    return replace(first, homography=to_plane[0]), replace(second, homography=to_plane[1])


def _at_random(links: Sequence[LinkFit]) -> set[tuple[int, int]]:
    """Pairs of links that are taken at random, where there are too many for all to be looked at."""
    if len(links) <= _MAX_LINKS:
        return set()
    count = min(_MOST_SAMPLED, int(_SAMPLED_FRACTION * len(links)))
    return {links[k].images for k in np.random.default_rng(0).choice(len(links), count, replace=False)}


def _least_confirmed(links: Sequence[LinkFit]) -> set[tuple[int, int]]:
    """Pairs of the links in the fewest triangles, then of those with the fewest inliers."""
    neighbours: dict[int, set[int]] = {}
    for fit in links:
        neighbours.setdefault(fit.image1, set()).add(fit.image2)
        neighbours.setdefault(fit.image2, set()).add(fit.image1)
    doubtful = sorted(links, key=lambda fit: (len(neighbours[fit.image1] & neighbours[fit.image2]), fit.inliers))
    return {fit.images for fit in doubtful[:_MAX_LINKS]}
