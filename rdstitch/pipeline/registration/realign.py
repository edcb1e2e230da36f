"""Aligning the pairs of a registration again: without failed images or pairs, or as another motion."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace

from rdstitch.alignment.result import Alignment
from rdstitch.alignment.sentences import explain_unaligned
from rdstitch.errors import RegistrationError
from rdstitch.matching.copies import copies_of
from rdstitch.matching.two_view import Pair, PairRegistration
from rdstitch.pipeline.registration.aligner import AlignedPairs, Aligner
from rdstitch.pipeline.run import Run
from rdstitch.results.messages import names_of
from rdstitch.results.registration import Registration
from rdstitch.system.cache import Cache
from rdstitch.verification.second_motions import planes_of_pairs, second_motions

Rejected = Mapping[tuple[int, ...], str]
"""What is left out, with what is wrong: images (k,), and pairs (i, j) without which other images may fall off."""


def aligner_of(registration: Registration, run: Run) -> Aligner:
    """The aligner for aligning the images of a registration again."""
    aligner = Aligner.of(registration.sources, run.options, Cache.at(run.cache), run.purpose)
    return replace(aligner, needs_poses=run.purpose.poses)


def with_reference_of(registration: Registration, aligner: Aligner) -> Registration:
    """Align the pairs of a registration again, with the reference image of the aligner."""
    return _aligned_anew(registration, aligner.align(registration.pairs), aligner)


def realigned(registration: Registration, aligner: Aligner, wanted: Callable[[Alignment], bool]) -> Registration | None:
    """Align the used images by another aligner; None if that fails or its draft is not wanted."""
    try:
        draft = aligner.draft(registration.used_pairs)
        if not wanted(draft.alignment):
            return None
        return _aligned_anew(registration, aligner.completed(draft), aligner)
    except RegistrationError:
        return None


def plane_of_most(registration: Registration, aligner: Aligner, threads: int) -> Registration | None:
    """The registration by the other of two motions if it may fill most of the images; else None."""
    if registration.static_background:
        return None
    pairs = planes_of_pairs(registration, aligner.threshold, threads)
    if pairs is None:
        return None
    plane = _with_pairs(registration, pairs, aligner)
    return plane if plane and 2 * plane.alignment.used.sum() > len(registration.sources) else None


def by_second_motions(registration: Registration, chosen: Iterable[Pair], aligner: Aligner) -> Registration | None:
    """The registration with some pairs, and their copies, by a second motion among their outliers.

    Where a scene has two surfaces, matches may say as much for one as for the other. None without a second motion.
    """
    copies = copies_of(registration.pairs)

    def originals(pair: Pair) -> frozenset[int]:
        return frozenset(copies.get(k, k) for k in pair)

    wanted = {originals(pair) for pair in chosen}
    used = registration.used_pairs
    pairs = [pair for pair in used if pair.relation and originals(pair.images) in wanted]
    motions = second_motions(registration.alignment.cameras, pairs, aligner.threshold)
    if not motions:
        return None
    changed = [replace(pair, relation=motions.get(pair.images, pair.relation)) for pair in used]
    return _with_pairs(registration, changed, aligner)


def _with_pairs(registration: Registration, pairs: Sequence[PairRegistration], aligner: Aligner) -> Registration | None:
    """Align the images by other pairs; None if these do not fit together."""
    try:
        aligned = aligner.align(pairs)
    except RegistrationError:
        return None
    return _aligned_anew(replace(registration, pairs=tuple(aligner.used(aligned))), aligned, aligner)


def without(registration: Registration, rejected: Rejected, aligner: Aligner) -> Registration | None:
    """Align the rest again; None if nothing that fits together is left.

    Pairs that contradicted the rejected are judged again: it may have been the rejected that were wrong.
    """
    reasons = left_out_images(rejected)
    pairs = [p for p in registration.pairs if not {*p.images} & reasons.keys() and p.images not in rejected]
    try:
        aligned = aligner.align(pairs)
    except RegistrationError:
        return None
    used = aligned.alignment.used
    neighbours = _neighbours_of(reasons, registration)
    for images, reason in rejected.items():
        reasons |= {k: reason for k in images if not used[k]}
    for image, others in neighbours.items():
        named_others = ", ".join(names_of(aligner.paths[k] for k in sorted(others)))
        reasons.setdefault(image, f"connected only through {named_others}, which was left out; add images around it")
    return _aligned_anew(registration, aligned, aligner, reasons)


def left_out_images(rejected: Rejected) -> dict[int, str]:
    """The images among the rejected."""
    return {images[0]: reason for images, reason in rejected.items() if len(images) == 1}


def _neighbours_of(rejected: Mapping[int, str], registration: Registration) -> dict[int, set[int]]:
    """The rejected that each other image was linked with."""
    linked: dict[int, set[int]] = {}
    for fit in registration.alignment.holding:
        for image, other in (fit.images, fit.images[::-1]):
            if other in rejected and image not in rejected:
                linked.setdefault(image, set()).add(other)
    return linked


def _aligned_anew(
    registration: Registration, aligned: AlignedPairs, aligner: Aligner, reasons: Mapping[int, str] | None = None
) -> Registration:
    """The registration with another alignment, and messages on the images that are not in it."""
    number = {path: k for k, path in enumerate(aligner.paths)}
    again = [message for message in registration.left_out if message.images[0] in number]  # the others were not read
    known = {**(reasons or {}), **{number[m.images[0]]: m.text for m in again}}
    unused = explain_unaligned(aligned.alignment, aligner.paths, registration.keypoints, known)
    dropped = (*registration.alignment.messages, *again)
    whole = [message for message in registration.messages if message not in dropped]
    messages = (*aligned.alignment.messages, *whole, *unused)
    return replace(registration, alignment=aligned.alignment, messages=messages)
