"""Why pictures found no place in an alignment, with a remedy."""

from collections.abc import Sequence

from rdstitch.alignment.result import CONTRADICTS, Alignment
from rdstitch.messages import Message, left_out, names_of


def explain_unaligned(alignment: Alignment, paths: Sequence[str]) -> list[Message]:
    """One message for each picture that the alignment does not use.

    Parameters
    ----------
    alignment : Alignment
    paths : sequence of str
        Of all its pictures.
    """
    contradicting: dict[int, list[int]] = {}
    for fit in alignment.links:
        if not fit.used and fit.reason == CONTRADICTS:
            contradicting.setdefault(fit.image1, []).append(fit.image2)
            contradicting.setdefault(fit.image2, []).append(fit.image1)
    aligned = int(alignment.used.sum())
    group_of = {picture: group for group in alignment.components for picture in group}
    messages = []
    for picture, path in enumerate(paths):
        if alignment.used[picture]:
            continue
        size = len(group_of[picture])
        if size > 1:
            reason = (
                f"one of {size} pictures that overlap with none of the {aligned} aligned ones; "
                "add pictures between them, or stitch them on their own"
            )
        elif picture in contradicting:
            others = ", ".join(names_of(paths[other] for other in sorted(contradicting[picture])))
            reason = (
                f"its overlap with {others} contradicts the other pictures (repeated structure?); "
                "add pictures with more overlap"
            )
        else:
            reason = "no reliable overlap with any other picture; add pictures with more overlap"
        messages.append(left_out(path, reason))
    return messages
