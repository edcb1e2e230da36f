"""Why pictures found no place in an alignment, with a remedy."""

from collections.abc import Sequence

import numpy as np

from rdstitch.alignment.result import CONTRADICTS, Alignment
from rdstitch.messages import Message, left_out, names_of

_FEW = 1.0 / 3.0
"""Of the features that most pictures have: a blur of several pixels leaves a quarter and less, even where all others
have as many as are looked for at the most."""


def explain_unaligned(alignment: Alignment, paths: Sequence[str], keypoints: Sequence[int]) -> list[Message]:
    """One message for each picture that the alignment does not use.

    Parameters
    ----------
    alignment : Alignment
    paths : sequence of str
        Of all its pictures.
    keypoints : sequence of int
        Number of features of each.
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
            few = few_features(keypoints, picture)
            remedy = f"it has {few}" if few else "add pictures with more overlap"
            reason = f"no reliable overlap with any other picture; {remedy}"
        messages.append(left_out(path, reason))
    return messages


def few_features(keypoints: Sequence[int], picture: int) -> str:
    """That a picture has few features, and why that may be; empty where it has about as many as the others."""
    few = keypoints[picture] < _FEW * float(np.median(keypoints))
    return "less than a third of the features that others have (blurred?)" if few else ""
