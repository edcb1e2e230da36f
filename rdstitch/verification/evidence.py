"""What speaks for and against a registration: its matches, its pixels, and motions that it does not explain."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from rdstitch.alignment.result import Alignment, LinkFit
from rdstitch.choices import Purpose
from rdstitch.matching.two_view import Pair
from rdstitch.results.registration import Registration
from rdstitch.robust.chance import binomial_tail
from rdstitch.system.cache import NO_CACHE, Cache
from rdstitch.verification.limits import Limits
from rdstitch.verification.overlap_check import CheckedLink, ComparedImages, check_overlaps


@dataclass(frozen=True)
class ResultEvidence:
    """Everything that rules look at; what takes long is computed when the first of them asks for it."""

    registration: Registration
    threshold: float  # largest transfer error of an inlier of a pair, pixels
    threads: int = 1  # pairs of images that are compared at the same time
    cache: Cache = NO_CACHE  # of results of earlier runs
    purpose: Purpose = Purpose.MOSAIC

    @property
    def alignment(self) -> Alignment:
        """Of the registration."""
        return self.registration.alignment

    @property
    def static(self) -> bool:
        """Whether the images mostly show what is static in them: some matches of that remain, which agree with nothing,
        and it looks alike anywhere but where the moving plane puts it.
        """
        return self.registration.static_background

    @cached_property
    def used(self) -> list[LinkFit]:
        """The links that the alignment uses."""
        return [fit for fit in self.alignment.links if fit.used]

    @property
    def worst(self) -> LinkFit | None:
        """The link with the largest errors; None where none is used."""
        return max(self.used, key=lambda fit: fit.rms, default=None)

    @cached_property
    def _images(self) -> ComparedImages:
        return ComparedImages(self.registration.sources, self.registration.stretch, self.threads)

    @cached_property
    def checked(self) -> list[CheckedLink]:
        """What the pixels say of each used link, or of the least confirmed of many."""
        if self.static:
            return []
        return check_overlaps(self.registration, self._images, self.cache)

    @cached_property
    def ambiguous(self) -> dict[Pair, CheckedLink]:
        """Pairs of a repeated pattern, of which nobody can say by how many periods they are apart."""
        return {link.pair: link for link in self.checked if link.ambiguity.ambiguous and not link.unique}

    def explained_by_depth(self, images: Sequence[int]) -> bool:
        """Whether matches of an image, of a pair, or of all if empty, disagree where a picture is more alike than by
        chance: it has depth, or something moved.
        """
        if not self.purpose.picture:
            return False
        overlaps = [link.agreement for link in self.checked if len({*images} & {*link.pair}) == len(images)]
        cells, confirming = sum(each.cells for each in overlaps), sum(each.confirming for each in overlaps)
        if cells < Limits.min_cells or confirming < Limits.max_unlike_fraction * cells:
            return False
        return binomial_tail(confirming, cells, Limits.alike_by_chance) < Limits.max_chance

    @cached_property
    def alike_fraction(self) -> float:
        """How much alike images look where most pairs put them, [0, 1]; 0 where there is nothing to see."""
        shares = [
            link.agreement.confirming_fraction for link in self.checked if link.agreement.cells >= Limits.min_cells
        ]
        return float(np.median(shares)) if shares else 0.0

    @property
    def flat(self) -> bool:
        """Whether the images are said to show a plane that three or more of them hold together: of a turn, and of two
        images, only overlaps can be wrong, and they are looked at.
        """
        return not self.alignment.on_sphere and int(self.alignment.used.sum()) > 2
