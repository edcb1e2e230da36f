"""Images and pairs whose matches do not agree with the whole, and the likeliest reason, by what the pairs show."""

from collections.abc import Sequence

import numpy as np

from rdstitch.alignment import Alignment
from rdstitch.alignment.result import LinkFit
from rdstitch.alignment.unaligned import few_features
from rdstitch.messages import Message, names_of
from rdstitch.radial_homography import RadialHomography, lift
from rdstitch.registration import Registration

Pair = tuple[int, int]

_MIN_INLIERS = 0.5  # share of a pair's own inliers that agree with the whole
# The same over all pairs of an image; right ones have been seen to have 83 % even with relief, others 52 %.
_MIN_MATCHES_PER_IMAGE = 0.6

_FEW = 40
"""Matches: pairs of images of nothing in common have been seen to have up to 33 that fit one motion."""

_OBLIQUE = 9.0
"""Times as large as elsewhere in an image what another one sees in one scale: three times as long and as wide."""

_OTHER_LENS = 0.05
"""By how much λ differs at least between lenses; that of pairs scatters over trees and houses."""


def disagreeing_pairs(registration: Registration) -> dict[Pair, Message]:
    """Pairs of a used link of whose matches most do not fit into the whole."""
    paths = [str(source.path) for source in registration.sources]
    used = [fit for fit in registration.alignment.links if fit.used and fit.inliers < _MIN_INLIERS * fit.count]
    result = {}
    for fit in used:
        both = paths[fit.image1], paths[fit.image2]
        remedy = f"{_reason(registration, [fit])} stitch them on their own"
        text = (
            f"{' and '.join(names_of(both))}: only {fit.inliers} of {fit.count} matches agree with the whole; "
            f"{_few_features(registration, (fit.image1, fit.image2)) or remedy}"
        )
        result[fit.image1, fit.image2] = Message(text, both, "failure", "misfitting-pair")
    return result


def misfitting_images(registration: Registration, links: Sequence[LinkFit]) -> list[Message]:
    """Images of whose matches too many do not fit into the whole, over all these links."""
    result = []
    for k, source in enumerate(registration.sources):
        own = [fit for fit in links if k in (fit.image1, fit.image2)]
        given, kept = sum(fit.count for fit in own), sum(fit.inliers for fit in own)
        if kept < _MIN_MATCHES_PER_IMAGE * given:
            reason = _few_features(registration, (k,)) or _reason(registration, own)
            text = f"only {kept} of {given} of its matches agree with the whole; {reason}"
            result.append(Message(text, (str(source.path),), "failure", "misfitting-image"))
    return result


def agreement_of_all(used: Sequence[LinkFit]) -> list[Message]:
    """Matches of all pairs together."""
    given, kept = sum(fit.count for fit in used), sum(fit.inliers for fit in used)
    if kept >= _MIN_INLIERS * given:
        return []
    return [Message(f"only {kept} of {given} matches of the pairs agree with the whole", (), "failure")]


def _few_features(registration: Registration, images: Sequence[int]) -> str:
    """Which of some images have few features to be matched by; empty for none."""
    found = [(k, few_features(registration.keypoints, k)) for k in images]
    return ", ".join(f"{registration.sources[k].name} has {few}" for k, few in found if few)


def _reason(registration: Registration, links: Sequence[LinkFit]) -> str:
    """Why the matches of some links agree with each other only, as a question to the user."""
    if sum(fit.count for fit in links) < _FEW:
        return "too few to place it: little overlap, or none?"
    own = {(fit.image1, fit.image2) for fit in links if fit.inliers < _MIN_MATCHES_PER_IMAGE * fit.count}
    relations = [pair.relation for pair in registration.pairs if (pair.image1, pair.image2) in own]
    if not registration.alignment.on_sphere and any(map(_is_oblique, relations)):
        return "taken much more obliquely than the others, or the horizon in view?"
    if any(_has_another_lens(relation, registration.alignment) for relation in relations):
        return "another camera or zoom, or no plane?"
    return "they agree with each other: another plane, or none (trees, walls)?"


def _is_oblique(relation: RadialHomography) -> bool:
    """Whether one of two images, seen by the other, reaches the horizon, or far away."""
    both = ((relation.camera, relation.homography), (relation.camera2, np.linalg.inv(relation.homography)))
    for camera, homography in both:
        depth = lift(camera.normalize(camera.outline(8)), camera.distortion, camera.higher) @ homography[2]
        if depth.min() <= 0.0 or (depth.max() / depth.min()) ** 3 > _OBLIQUE:
            return True
    return False


def _has_another_lens(relation: RadialHomography, alignment: Alignment) -> bool:
    """Whether a pair shows a λ that is clearly another one than that of the whole."""
    apart = abs(relation.distortion - alignment.distortion)
    return apart > max(3.0 * relation.distortion_std, _OTHER_LENS)
