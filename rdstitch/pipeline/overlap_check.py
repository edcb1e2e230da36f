"""A second opinion on a registration: do the pictures look alike where it puts them together?"""

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from itertools import chain

from rdstitch.compositing.agreement import Agreement, Grey, overlap_agreement, reduced_grey
from rdstitch.compositing.ambiguity import Ambiguity, placement_ambiguity
from rdstitch.pipeline.cache import NO_CACHE, Cache
from rdstitch.pipeline.register import Registration
from rdstitch.registration.alignment import LinkFit

_MOST_LINKS = 40
"""Links that are looked at in a large set; the least confirmed ones."""


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
    """

    fit: LinkFit
    agreement: Agreement
    ambiguity: Ambiguity

    @property
    def pair(self) -> tuple[int, int]:
        """Its pictures."""
        return self.fit.image1, self.fit.image2


def check_overlaps(registration: Registration, workers: int = 1, cache: Cache = NO_CACHE) -> list[CheckedLink]:
    """Compare the pictures of every used link, or of those that the fewest others confirm.

    Parameters
    ----------
    registration : Registration
    workers : int
        Pictures read at the same time.
    cache : Cache

    Raises
    ------
    InputError
        When a picture can no longer be read.
    """
    alignment = registration.alignment
    chosen = _least_confirmed([fit for fit in alignment.links if fit.used])
    pictures = sorted(set(chain.from_iterable((fit.image1, fit.image2) for fit in chosen)))
    placed = [
        (k, cache.file(source.path), cache.file(source.mask), alignment.cameras[k], alignment.homographies[k])
        for k, source in ((k, registration.sources[k]) for k in pictures)
    ]
    compute = partial(_compare, registration, chosen, pictures, workers)
    return cache.recall("overlaps", (CheckedLink, LinkFit, Agreement, Ambiguity), (placed, chosen), compute)


def _compare(
    registration: Registration, chosen: Sequence[LinkFit], pictures: Sequence[int], workers: int
) -> list[CheckedLink]:
    """Read the pictures, and compare those of the chosen links."""
    alignment = registration.alignment

    def grey(index: int) -> Grey:
        return reduced_grey(registration.sources[index].read())

    def compare(fit: LinkFit) -> CheckedLink:
        i, j = fit.image1, fit.image2
        pair = greys[i], greys[j], cameras[i], cameras[j], alignment.homographies[i], alignment.homographies[j]
        return CheckedLink(fit, overlap_agreement(*pair), placement_ambiguity(*pair))

    with ThreadPoolExecutor(workers) as pool:
        greys = dict(zip(pictures, pool.map(grey, pictures), strict=True))
        cameras = {k: alignment.cameras[k].resized((grey.shape[1], grey.shape[0])) for k, grey in greys.items()}
        return list(pool.map(compare, chosen))


def _least_confirmed(links: Sequence[LinkFit]) -> list[LinkFit]:
    """The links in the fewest triangles, then those with the fewest inliers; in their own order."""
    beside: dict[int, set[int]] = {}
    for fit in links:
        beside.setdefault(fit.image1, set()).add(fit.image2)
        beside.setdefault(fit.image2, set()).add(fit.image1)
    doubtful = sorted(links, key=lambda fit: (len(beside[fit.image1] & beside[fit.image2]), fit.inliers))
    chosen = {(fit.image1, fit.image2) for fit in doubtful[:_MOST_LINKS]}
    return [fit for fit in links if (fit.image1, fit.image2) in chosen]
