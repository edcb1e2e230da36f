"""Links by what their images show where nothing moves otherwise."""

from typing import Any

import numpy as np
import pytest

from rdstitch.alignment.result import LinkFit
from rdstitch.camera import Camera
from rdstitch.radial_homography import RadialHomography
from rdstitch.verification.competing_motions import Contest
from rdstitch.verification.overlap_check import CheckedLink
from rdstitch.verification.photometric_agreement import Agreement
from rdstitch.verification.rival_check import outside_rivals
from rdstitch.verification.rival_motion import RivalMotion
from rdstitch.verification.self_similarity import Ambiguity

LENS = Camera((400, 300))
RELATION = RadialHomography(np.eye(3), LENS, LENS, np.ones(20, dtype=np.bool_))


def _link(first: int, second: int, shift: float) -> CheckedLink:
    return CheckedLink(LinkFit(first, second, 100, 90, 0.5, True), Agreement(100, 20), Ambiguity(0.4, 0.6, shift))


def _won(*pairs: tuple[int, int]) -> Contest:
    return Contest(0.8, 0.3, {pair: Agreement(50, 45) for pair in pairs}, frozenset())


@pytest.mark.parametrize(("moves", "ambiguous"), [(180.0, False), (196.0, False), (120.0, True)])
def test_what_fits_where_the_rival_puts_it_is_no_pattern(moves: float, ambiguous: bool) -> None:
    """Within a twentieth of an image."""
    rival = RivalMotion(0, 1, 40, 60, (30.0, 40.0), moves, RELATION)
    first, second = outside_rivals([_link(0, 1, 0.45), _link(1, 2, 0.45)], [rival], _won((0, 1)))
    assert first.ambiguity.ambiguous is ambiguous
    assert second.ambiguity.ambiguous
    assert (first.agreement, second.agreement) == (Agreement(50, 45), Agreement(100, 20))


@pytest.mark.parametrize("compared", [None, Contest(0.8, 0.6, {(0, 1): Agreement(50, 45)}, frozenset())])
def test_where_no_motion_is_seen_to_be_smaller_links_stay(compared: Any) -> None:
    links = [_link(0, 1, 0.45)]
    rival = RivalMotion(0, 1, 40, 60, (30.0, 40.0), 180.0, RELATION)
    assert outside_rivals(links, [rival], compared) is links
