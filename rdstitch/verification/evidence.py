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
        """The alignment of the registration."""
        return self.registration.alignment

    @property
    def static(self) -> bool:
        """Whether the images mostly show what is static in them.

        Some matches of that remain, which agree with nothing, and it looks alike anywhere but where the moving plane
        puts it.
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
        return {link.pair: link for link in self.checked if link.ambiguous}

    def explained_by_depth(self, images: Sequence[int] | None) -> bool:
        """Whether matches disagree where a picture is more alike than by chance: it has depth, or something moved.

        ``images``: the image or pair whose overlaps are looked at; None for all overlaps.
        """
        if not self.purpose.picture:
            return False
        overlaps = [link.agreement for link in self.checked if images is None or {*images} <= {*link.pair}]
        cells, confirming = sum(each.cells for each in overlaps), sum(each.confirming for each in overlaps)
        if cells < Limits.min_cells or confirming < Limits.max_unlike_fraction * cells:
            return False
        return binomial_tail(confirming, cells, Limits.alike_by_chance) < Limits.max_chance

    @cached_property
    def alike_fraction(self) -> float | None:
        """How much alike images look where most pairs put them, [0, 1]; None where there is nothing to see."""
        fractions = [link.agreement.confirming_fraction for link in self.checked]
        known = [fraction for fraction in fractions if fraction is not None]
        return float(np.median(known)) if known else None

    def is_alike(self, fraction: float) -> bool:
        """Whether images are seen to look alike by a fraction or more."""
        return self.alike_fraction is not None and self.alike_fraction >= fraction

    @property
    def held_by_three(self) -> bool:
        """Whether three or more images are said to show one plane and hold it together.

        Where the camera turned, and of two images, only overlaps can be wrong, and they are looked at.
        """
        return not self.alignment.on_sphere and int(self.alignment.used.sum()) > 2
