"""What speaks for and against a registration: its matches, its pixels, and motions that it does not explain."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from rdstitch.alignment.result import Alignment, LinkFit
from rdstitch.matching.two_view import Pair
from rdstitch.results.registration import Registration
from rdstitch.system.cache import NO_CACHE, Cache
from rdstitch.verification.limits import limit
from rdstitch.verification.overlap_check import CheckedLink, ComparedImages, check_overlaps
from rdstitch.verification.second_motion import (
    MotionComparison,
    SecondMotion,
    compare_motions,
    find_second_motions,
    unexplained,
)


@dataclass(frozen=True)
class Evidence:
    """Everything that rules look at; what takes long is computed when the first of them asks for it."""

    registration: Registration
    threshold: float  # largest transfer error of an inlier of a pair, pixels
    threads: int = 1  # pairs of images that are compared at the same time
    cache: Cache = NO_CACHE  # of results of earlier runs
    # only the lens is wanted, so that doubts about the places of images do not make the result fail, and are not
    # reported where a repeated pattern explains them
    lens_only: bool = False

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
    def motions(self) -> list[SecondMotion]:
        """What moves differently, pair by pair."""
        return find_second_motions(self.alignment, self.registration.pairs, self.threshold)

    @cached_property
    def compared(self) -> MotionComparison | None:
        """Which of the two motions is the plane, by the pixels."""
        return compare_motions(self._images, self.motions, [] if self.alignment.on_sphere else self.checked)

    @cached_property
    def seen(self) -> Sequence[CheckedLink]:
        """The checked links; where what moves differently is the smaller part, without what that may explain."""
        return unexplained(self.checked, self.motions, self.compared)

    @cached_property
    def ambiguous(self) -> dict[Pair, CheckedLink]:
        """Pairs of a repeated pattern, of which nobody can say by how many periods they are apart."""
        return {link.pair: link for link in self.seen if link.ambiguity.ambiguous and not link.unique}

    @cached_property
    def alike(self) -> float:
        """How much alike images look where most pairs put them, [0, 1]; 0 where there is nothing to see."""
        shares = [link.agreement.share for link in self.checked if link.agreement.cells >= limit("cells")]
        return float(np.median(shares)) if shares else 0.0

    @property
    def flat(self) -> bool:
        """Whether the images are said to show a plane that three or more of them hold together: of a turn, and of two
        images, only overlaps can be wrong, and they are looked at.
        """
        return not self.alignment.on_sphere and int(self.alignment.used.sum()) > 2

    @property
    def depth(self) -> bool:
        """Whether the scene has depth: relief, a second motion as small as tree tops have, or any of a turn."""
        moved = [motion for motion in self.motions if motion.area]
        near = bool(moved) and (self.alignment.on_sphere or not any(motion.is_far for motion in moved))
        return self.alignment.relief.found or near
