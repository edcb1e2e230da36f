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
    blocks = [group for group in alignment.components if len(group) > 1]
    block_of = {picture: number for number, block in enumerate(blocks) for picture in block}
    messages = []
    for picture, path in enumerate(paths):
        if alignment.used[picture]:
            continue
        if picture in block_of:
            number, size = block_of[picture], len(blocks[block_of[picture]])
            reason = (
                f"in block {number + 1} of {len(blocks)}, whose {size} pictures overlap with none of the others; "
                "stitch them on their own, or add pictures between the blocks"
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
