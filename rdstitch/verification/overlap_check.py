"""A second opinion on a registration: do the pictures look alike where it puts them together?"""

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from itertools import chain

import numpy as np

from rdstitch.alignment.result import LinkFit
from rdstitch.alignment.rotation_model import nearest_rotation
from rdstitch.cache import NO_CACHE, Cache
from rdstitch.io.reduction import fitting_reduction
from rdstitch.registration import Registration
from rdstitch.verification.photometric_agreement import COMPARED_SIDE, Agreement, PlacedPicture, overlap_agreement
from rdstitch.verification.self_similarity import Ambiguity, draw, drawing_scale, placement_ambiguity

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
        (k, source.content(cache), cache.file(source.mask), alignment.cameras[k], alignment.homographies[k])
        for k, source in ((k, registration.sources[k]) for k in pictures)
    ]
    compute = partial(_compare, registration, chosen, pictures, workers)

    def valid(checked: list[CheckedLink]) -> bool:
        return [link.pair for link in checked] == [(fit.image1, fit.image2) for fit in chosen]

    kinds = (CheckedLink, LinkFit, Agreement, Ambiguity)
    return cache.recall("overlaps", kinds, (placed, chosen, registration.stretch), compute, valid=valid)


def share_alike(checked: Sequence[CheckedLink]) -> float:
    """Share of all overlaps together that looks alike, in [0, 1]; NaN where nothing was compared."""
    cells = sum(link.agreement.cells for link in checked)
    return sum(link.agreement.confirming for link in checked) / cells if cells else float("nan")


def _compare(
    registration: Registration, chosen: Sequence[LinkFit], pictures: Sequence[int], workers: int
) -> list[CheckedLink]:
    """Read the pictures, and compare those of the chosen links."""
    alignment = registration.alignment

    def place(index: int) -> PlacedPicture:
        source = registration.sources[index]
        picture = source.read(fitting_reduction(max(source.camera.image_size) / COMPARED_SIDE), keep=True)
        return PlacedPicture.of(picture, alignment.cameras[index], alignment.homographies[index], registration.stretch)

    def compare(fit: LinkFit, scale: float) -> CheckedLink:
        i, j = fit.image1, fit.image2
        ambiguity = placement_ambiguity(drawings[i, scale], drawings[j, scale])
        return CheckedLink(fit, overlap_agreement(placed[i], placed[j]), ambiguity)

    def compare_around(fit: LinkFit) -> CheckedLink:
        # No plane shows all pictures of a turn; one between the two shows both, and stretches neither much.
        both = alignment.homographies[[fit.image1, fit.image2]]
        rotations = both / np.linalg.norm(both, axis=1, keepdims=True)
        to_plane = nearest_rotation(rotations.sum(axis=0)).T @ both
        first = replace(placed[fit.image1], homography=to_plane[0])
        second = replace(placed[fit.image2], homography=to_plane[1])
        scale = drawing_scale(second)
        ambiguity = placement_ambiguity(draw(first, scale), draw(second, scale))
        return CheckedLink(fit, overlap_agreement(first, second), ambiguity)

    with ThreadPoolExecutor(workers) as pool:
        placed = dict(zip(pictures, pool.map(place, pictures), strict=True))
        if alignment.on_sphere:
            return list(pool.map(compare_around, chosen))
        scales = _scales([drawing_scale(placed[fit.image2]) for fit in chosen])
        wanted = sorted(
            {(k, scale) for fit, scale in zip(chosen, scales, strict=True) for k in (fit.image1, fit.image2)}
        )
        drawings = dict(zip(wanted, pool.map(lambda key: draw(placed[key[0]], key[1]), wanted), strict=True))
        return list(pool.map(compare, chosen, scales))


def _scales(fitting: Sequence[float]) -> list[float]:
    """The scales that fit, but few different ones, so that a picture is drawn once and not for every link."""
    middle = np.median(fitting)
    return [float(middle * 2.0 ** np.rint(np.log2(scale / middle))) for scale in fitting]


def _least_confirmed(links: Sequence[LinkFit]) -> list[LinkFit]:
    """The links in the fewest triangles, then those with the fewest inliers; in their own order."""
    beside: dict[int, set[int]] = {}
    for fit in links:
        beside.setdefault(fit.image1, set()).add(fit.image2)
        beside.setdefault(fit.image2, set()).add(fit.image1)
    doubtful = sorted(links, key=lambda fit: (len(beside[fit.image1] & beside[fit.image2]), fit.inliers))
    chosen = {(fit.image1, fit.image2) for fit in doubtful[:_MOST_LINKS]}
    return [fit for fit in links if (fit.image1, fit.image2) in chosen]
