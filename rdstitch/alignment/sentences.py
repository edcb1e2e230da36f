"""What the user reads of an alignment: of what was given, of lens and relief, and why images found no place."""

import math
from collections.abc import Mapping, Sequence

import numpy as np

from rdstitch.alignment.lens.lens_selection import LensEvidence
from rdstitch.alignment.motion_models import MotionModel
from rdstitch.alignment.noise import COHERENT_CORRELATION, Coherence, shows_relief
from rdstitch.alignment.result import Alignment, Unused
from rdstitch.arrays import FloatArray
from rdstitch.choices import Purpose
from rdstitch.results.messages import Message, left_out, names_of

REFERENCE_LEFT_OUT = Message("the reference image that was named is not among those aligned; another one is taken")


def focal_contradicted(given: float, shown: float, log_std: float) -> Message:
    """Where images show another focal length than was given, pixels."""
    text = f"the images contradict the given focal length of {given:.1f} pixels, which is not used: "
    return Message(f"{text}they show {shown:.1f} ± {log_std * shown:.1f}", code="focal-contradicted")


def focal_overruled(ratio: float) -> Message:
    """Where images show a focal length of so many times the one in EXIF."""
    times = f"{ratio:.1f} times the one" if ratio > 1.0 else f"1/{1.0 / ratio:.1f} of the one"
    return Message(f"the images show a focal length that is {times} in EXIF, which was not used; give the right one")


def attitudes_late(delay: float, std: float) -> Message:
    """Of attitudes whose times are so many seconds late."""
    text = f"the times of the attitudes are {1e3 * delay:.0f} ± {1e3 * std:.0f} ms late, which is allowed for"
    return Message(text, severity="note", code="attitudes-late")


def attitudes_scatter(attitudes: str, scatter: float, stated: float) -> Message:
    """Of attitudes that scatter more than was stated, radians."""
    text = f"{attitudes} agree with the images to {math.degrees(scatter):.2g} degrees, which is taken for their "
    return Message(f"{text}standard deviation instead of {math.degrees(stated):.2g}", severity="note")


def tilt_contradicted(given: FloatArray, shown: FloatArray) -> Message:
    """Of a given tilt (ψ, θ), radians, and the one that images show."""
    text = "the images contradict the given tilt of {:.2f}, {:.2f} degrees".format(*np.degrees(given))
    text += ", which is not used: they show {:.2f}, {:.2f}".format(*np.degrees(shown))
    return Message(text, code="attitudes-contradicted")


def attitudes_contradicted(
    attitudes: str, scatter: float, change: FloatArray | None, scatter_changed: float
) -> Message:
    """Of attitudes that scatter by so much, radians, and by less with other signs or order (2, 2), if these help."""
    text = f"the images contradict {attitudes} by {math.degrees(scatter):.1f} degrees; they are not used: "
    if change is None:
        text += "no signs and no order of psi and theta make them fit"
    else:
        rows = ("-psi" if row[0] < 0 else "psi" if row[0] else "-theta" if row[1] < 0 else "theta" for row in change)
        changes = [f"{new} for {old}" for new, old in zip(rows, ("psi", "theta"), strict=True) if new != old]
        text += f"with {' and '.join(changes)} they would fit to {math.degrees(scatter_changed):.2g} degrees"
    return Message(text, code="attitudes-contradicted")


def map_contradicted(places: str, distance: float | None, growth: float) -> Message:
    """Of places on the map, by name, with which errors grow so many times, or half of which are so many metres off."""
    why = f"with them the errors of the matches grow by {growth - 1.0:.0%}"
    if distance is not None:
        why = f"half of them are {distance:.0f} m or more from where the images were taken"
    return Message(f"the {places} contradict the images ({why}) and were not used for the alignment")


def relief_explained(left: Coherence, model: MotionModel, links: int) -> str:
    """What the agreement of neighbours that a model leaves means for the scene."""
    relief = shows_relief(left)
    agreement = f"errors of neighbours agree (correlation {left.correlation:.2f}, {left.size:.1f} pixels in common)"
    if model.on_sphere:
        moved = "the camera moved between the images (parallax): what is near does not fit; turn about the lens"
        return f"{agreement}: {moved}" if relief else f"the camera hardly moved (correlation {left.correlation:.2f})"
    if relief:
        wrong = f"the scene is not one plane, or the {model.name} model does not describe the camera; λ may be off"
        return f"{agreement}: {wrong}"
    if left.correlation > COHERENT_CORRELATION:
        return f"{agreement}, as over a scene that is nearly flat"
    seen = "the scene is flat" if links > 1 else "no relief shows, but hills as wide as one overlap would not"
    return f"errors of neighbours hardly agree (correlation {left.correlation:.2f}): {seen}"


def lens_not_observable(purpose: Purpose, evidence: LensEvidence) -> Message:
    """That λ is not known, because of depth or of too little motion.

    An image can be right whatever the lens is, and a path by what is known of the lens.
    """
    cause, remedy = "the images hardly move, or only turn about the optical axis", "images that overlap by less"
    depth = evidence is LensEvidence.DEPTH
    if depth:
        cause, remedy = "what the images show has depth, which looks like a lens in so few of them", "more images"
    text = f"λ is not observable: {cause}; give λ, a camera file, or {remedy}"
    severity = "failure" if depth and not purpose.picture else purpose.unknown_lens
    return Message(text, severity=severity, code="lambda-not-observable")


def few_images(count: int, enough: int, off: float, purpose: Purpose) -> Message:
    """That so few images leave the corners off by so many pixels."""
    text = (
        f"from {count} images the lens distortion is known to about {off:.2g} pixels at the corners; {enough} or more "
        "images, or a camera file, make it surer"
    )
    return Message(text, severity="detail" if purpose.picture else "warning", code="few-images")


def not_converged(purpose: Purpose) -> Message:
    """That the adjustment did not converge: of seven such results two were off.

    Of adverse sets: ``python -m examples.benchmarks.trust --kind adverse``.
    """
    text = "the adjustment did not converge, from another start neither, so that λ is not known; add images"
    return Message(text, severity=purpose.unknown_lens, code="not-converged")


_FEW = 1.0 / 3.0
"""Of the features that most images have: a blur of several pixels leaves a quarter and less, even where all others
have as many as are looked for at the most."""


def explain_unaligned(
    alignment: Alignment, paths: Sequence[str], keypoints: Sequence[int], reasons: Mapping[int, str]
) -> list[Message]:
    """One message for each image that the alignment does not use, by the paths of all and their numbers of features.

    ``reasons`` are those that are known beforehand, by image.
    """
    contradicting: dict[int, list[int]] = {}
    for fit in alignment.links:
        if fit.reason is Unused.CONTRADICTS:
            contradicting.setdefault(fit.image1, []).append(fit.image2)
            contradicting.setdefault(fit.image2, []).append(fit.image1)
    blocks = [group for group in alignment.components if len(group) > 1]
    block_of = {image: number for number, block in enumerate(blocks) for image in block}
    messages = []
    for image, path in enumerate(paths):
        if alignment.used[image]:
            continue
        if image in reasons:
            reason = reasons[image]
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
