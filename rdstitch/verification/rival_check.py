"""What the checks of overlaps come to where something moves differently from the plane."""

from collections.abc import Sequence
from dataclasses import replace

from rdstitch.registration import Registration
from rdstitch.verification.competing_motions import FILLED_BY_A_PLANE, Contest, contest
from rdstitch.verification.overlap_check import CheckedLink, share_alike
from rdstitch.verification.rival_motion import RivalMotion, is_apart
from rdstitch.verification.self_similarity import Ambiguity

_SAME_SHIFT = 0.05
"""Share of the longer side of an image by which two shifts differ that are the same: matches show theirs where they
are, pixels in the mean of all that they cover."""


def compare_with_rivals(
    registration: Registration, rivals: Sequence[RivalMotion], checked: Sequence[CheckedLink]
) -> Contest | None:
    """The alignment and what moves otherwise, compared with the pixels.

    Only where the latter is a motion of its own and covers a good part; or where what was aligned fills less than half
    of the images, and something else moves in any of them. None otherwise.
    """
    apart = is_apart(rivals)
    far = any(rival.relation is not None and rival.is_far for rival in rivals)
    if registration.alignment.on_sphere or not (apart or (far and share_alike(checked) < FILLED_BY_A_PLANE)):
        return None
    relations = {(rival.image1, rival.image2): rival.relation for rival in rivals if rival.relation is not None}
    compared = contest(registration, [link.pair for link in checked], relations)
    return compared if apart or compared.lost else None


def outside_rivals(
    checked: Sequence[CheckedLink], rivals: Sequence[RivalMotion], compared: Contest | None
) -> Sequence[CheckedLink]:
    """The same links by what their images show where nothing moves otherwise, if that is seen to be the smaller part.

    A pair that fits as well where its rival puts it shows no repeated pattern, but the rival.
    """
    if compared is None or not compared.won:
        return checked
    shifts = {
        (rival.image1, rival.image2): rival.disagreement / max(rival.relation.camera.image_size)
        for rival in rivals
        if rival.relation is not None
    }

    def outside(link: CheckedLink) -> CheckedLink:
        by_rival = abs(link.ambiguity.shift - shifts.get(link.pair, float("inf"))) <= _SAME_SHIFT
        return replace(
            link,
            agreement=compared.outside.get(link.pair, link.agreement),
            ambiguity=Ambiguity(link.ambiguity.here, 0.0, 0.0) if by_rival else link.ambiguity,
        )

    return [outside(link) for link in checked]
