"""Why images found no place in an alignment, with a remedy."""

from collections.abc import Mapping, Sequence

import numpy as np

from rdstitch.alignment.result import Alignment, Unused
from rdstitch.results.messages import Message, left_out, names_of

_FEW = 1.0 / 3.0
"""Of the features that most images have: a blur of several pixels leaves a quarter and less, even where all others
have as many as are looked for at the most."""


def explain_unaligned(
    alignment: Alignment, paths: Sequence[str], keypoints: Sequence[int], known: Mapping[int, str]
) -> list[Message]:
    """One message for each image that the alignment does not use, by the paths of all and their numbers of features.

    ``known`` are the reasons of those of which it is known beforehand.
    """
    contradicting: dict[int, list[int]] = {}
    for fit in alignment.links:
        if not fit.used and fit.reason is Unused.CONTRADICTS:
            contradicting.setdefault(fit.image1, []).append(fit.image2)
            contradicting.setdefault(fit.image2, []).append(fit.image1)
    blocks = [group for group in alignment.components if len(group) > 1]
    block_of = {image: number for number, block in enumerate(blocks) for image in block}
    messages = []
    for image, path in enumerate(paths):
        if alignment.used[image]:
            continue
        if image in known:
            reason = known[image]
        elif image in block_of:
            number, size = block_of[image], len(blocks[block_of[image]])
            reason = (
                f"in block {number + 1} of {len(blocks)}, whose {size} images overlap too little with the others; "
                "stitch them on their own, or add images between the blocks"
            )
        elif image in contradicting:
            others = ", ".join(names_of(paths[other] for other in sorted(contradicting[image])))
            reason = (
                f"its overlap with {others} contradicts the other images (repeated structure?); "
                "add images with more overlap"
            )
        else:
            few = few_features(keypoints, image)
            remedy = f"it has {few}" if few else "add images with more overlap"
            reason = f"no reliable overlap with any other image; {remedy}"
        messages.append(left_out(path, reason))
    return messages


def few_features(keypoints: Sequence[int], image: int) -> str:
    """That an image has few features, and why that may be; empty where it has about as many as the others."""
    few = keypoints[image] < _FEW * float(np.median(keypoints))
    return "less than a third of the features that others have (blurred?)" if few else ""
