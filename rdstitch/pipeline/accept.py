"""Stage: check a registration; what fails a check is left out by name, and the rest is aligned anew."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace

import numpy as np

from rdstitch.alignment.motion_models import MODELS
from rdstitch.alignment.result import Alignment, LinkFit, links_by_image
from rdstitch.alignment.unaligned import explain_unaligned
from rdstitch.choices import Purpose
from rdstitch.errors import PartialResultError, RegistrationError
from rdstitch.options.stitch_options import StitchOptions
from rdstitch.pipeline.aligner import AlignedPairs, Aligner, impossible_estimates_fail
from rdstitch.pipeline.working_size import at_full_size
from rdstitch.results.messages import Message, merge_by_reason, names_of
from rdstitch.results.registration import Registration
from rdstitch.system.cache import Cache
from rdstitch.verification.evidence import ResultEvidence
from rdstitch.verification.findings import Finding, Scope, messages_of
from rdstitch.verification.limits import Limits
from rdstitch.verification.rival_planes import planes_of_pairs
from rdstitch.verification.verdict import RefusedError, judge

_MAX_ROUNDS = 20  # times that something is left out; each takes one adjustment


Offenders = Mapping[tuple[int, ...], Message]
"""What is left out, with what is wrong: images (k,), and pairs (i, j) without which other images may fall off."""


@impossible_estimates_fail()
def accept(registration: Registration, options: StitchOptions, purpose: Purpose = Purpose.MOSAIC) -> Registration:
    """The registration of what passes all checks, with everything that the user should know of it.

    The registration comes and goes in pixels of the working size.
    """
    aligner = aligner_of(registration, options, purpose)
    undamaged = None if options.force else _without_damage(registration, aligner)
    if undamaged is not None and _is_simpler(undamaged.alignment.model, registration.alignment.model):
        registration, undamaged = undamaged, None

    def checked(candidate: Registration) -> tuple[Finding, ...]:
        return judge(ResultEvidence(candidate, options.threshold, options.threads, aligner.cache, purpose))

    current, findings = registration, checked(registration)
    first, first_findings = registration, findings
    if _fails(findings) and undamaged is not None and not _fails(judged := checked(undamaged)):
        current, findings = undamaged, judged
    if _fails(findings) and not options.force:
        plane = None if purpose.lens_only else plane_of_most(registration, options, aligner)
        judged = () if plane is None else checked(plane)
        if plane is not None and not any(map(_is_of_the_whole, judged)):
            current, findings = plane, judged
        start, left = current, dict[tuple[int, ...], Message]()
        for _ in range(_MAX_ROUNDS):
            if not _fails(findings):
                break
            if any(map(_is_of_the_whole, findings)):
                raise RefusedError(at_full_size(_told(current, findings)))
            worst = _worst(current, findings)
            left |= worst
            shrunk = _without(start, left, aligner) if worst else None
            # Where as many images fail as pass, nobody can say which of them are right.
            if shrunk is None or shrunk.alignment.used.sum() <= len(_images(left)):
                raise RefusedError(at_full_size(_told(first, first_findings)))
            current, findings = shrunk, checked(shrunk)
    if _fails(findings) and not options.force:
        raise RefusedError(at_full_size(_told(first, first_findings)))
    accepted = _told(current, findings)
    if accepted.failures and not options.force:  # of the alignment itself
        raise RefusedError(at_full_size(accepted))
    if options.strict and accepted.left_out:
        raise PartialResultError("; ".join(map(str, merge_by_reason(accepted.left_out))))
    return accepted


def aligner_of(registration: Registration, options: StitchOptions, purpose: Purpose) -> Aligner:
    """What aligns the images of a registration anew."""
    aligner = Aligner.of(registration.sources, options, Cache(options.cache), purpose)
    return replace(aligner, needs_poses=purpose.poses)


def realigned(registration: Registration, aligner: Aligner, wanted: Callable[[Alignment], bool]) -> Registration | None:
    """The pairs of a registration aligned by another aligner; None where a draft does not fit, or is not wanted."""
    try:
        draft = aligner.draft(registration.pairs)
        if draft.alignment.rms > Limits.rough_error.value * aligner.threshold or not wanted(draft.alignment):
            return None
        return _aligned_anew(registration, aligner.completed(draft), aligner.paths, {})
    except RegistrationError:
        return None


def _without_damage(registration: Registration, aligner: Aligner) -> Registration | None:
    """Without images of damaged files; None where none is used, or too few others are left.

    Flipped bits shift a part of an image: by a few pixels, that looks as if the camera had tilted, and all tilt then;
    by more, as if something moved.
    """
    used = registration.alignment.used
    known = registration.sources[0].guard.damaged  # all have one guard
    damaged = [k for k, source in enumerate(registration.sources) if source.path in known and used[k]]
    if not damaged:
        return None
    reason = Message("is damaged, and all others fit better without it; copy it again from its source")
    rest = _without(registration, {(k,): reason for k in damaged}, aligner)
    return rest if rest is not None and 2 * rest.alignment.used.sum() > used.sum() else None


def _is_simpler(model: str, former: str) -> bool:
    """Whether a motion in the plane has less freedom than a former one."""
    by_freedom = [name for name, each in MODELS.items() if not each.on_sphere]
    return {model, former} <= set(by_freedom) and by_freedom.index(model) < by_freedom.index(former)


def _fails(findings: Iterable[Finding]) -> bool:
    return any(finding.fails for finding in findings)


def _told(registration: Registration, findings: Sequence[Finding]) -> Registration:
    """A registration with what was found of it in words."""
    return registration.with_messages(messages_of(findings, registration))


def plane_of_most(registration: Registration, options: StitchOptions, aligner: Aligner) -> Registration | None:
    """Of two motions in the images that which may fill most of them; None where that is not to be seen."""
    if registration.static_background:
        return None
    pairs = planes_of_pairs(registration, options.threshold)
    if pairs is None:
        return None
    try:
        aligned = aligner.align(pairs)
    except RegistrationError:
        return None
    plane = _aligned_anew(replace(registration, pairs=tuple(aligner.used(aligned))), aligned, aligner.paths, {})
    return plane if 2 * plane.alignment.used.sum() > len(registration.sources) else None


def _is_of_the_whole(finding: Finding) -> bool:
    """Whether it is a failure that no image or pair is to blame for."""
    return finding.fails and finding.kind.scope is Scope.WHOLE


def _images(offenders: Offenders) -> dict[int, Message]:
    """Those that are images."""
    return {images[0]: message for images, message in offenders.items() if len(images) == 1}


def _worst(registration: Registration, findings: Iterable[Finding]) -> Offenders:
    """The worst images, no two of them linked, since a bad image spoils its neighbours; else the failing pairs."""
    failures = [finding for finding in findings if finding.fails]
    single = {finding.images[0]: finding for finding in failures if finding.kind.scope is Scope.IMAGE}
    if not single:
        pairs = [finding for finding in failures if finding.kind.scope is Scope.PAIR]
        said = zip(pairs, messages_of(pairs, registration), strict=True)
        return {finding.images: message for finding, message in said}
    used = [fit for fit in registration.alignment.links if fit.used]
    fit_share, links_of = agreement(used, len(registration.sources)), links_by_image(used)
    chosen = dict[tuple[int, ...], Message]()
    beside: set[int] = set()
    for image in sorted(single, key=lambda k: (fit_share[k], k)):
        if image not in beside:
            (chosen[image,],) = messages_of([single[image]], registration)
            beside |= {k for fit in links_of.get(image, []) for k in fit.images}
    return chosen


def agreement(links: Sequence[LinkFit], count: int) -> np.ndarray:
    """Share of the matches of each image that agree with the alignment of all, shape (N,); 1 without any."""
    given, kept = np.zeros(count), np.zeros(count)
    for fit in links:
        given[[fit.image1, fit.image2]] += fit.count
        kept[[fit.image1, fit.image2]] += fit.inliers
    return np.where(given > 0, kept / np.maximum(given, 1.0), 1.0)


def _held_by(registration: Registration, offenders: Mapping[int, Message]) -> dict[int, set[int]]:
    """The images left out that each other image is linked with."""
    held: dict[int, set[int]] = {}
    for fit in registration.alignment.links:
        for image, other in ((fit.image1, fit.image2), (fit.image2, fit.image1)):
            if fit.used and other in offenders and image not in offenders:
                held.setdefault(image, set()).add(other)
    return held


def _without(registration: Registration, offenders: Offenders, aligner: Aligner) -> Registration | None:
    """The rest, aligned anew; None where nothing that fits together would be left.

    Pairs that contradicted the offenders are judged again: it may have been the offenders that were wrong.
    """
    reasons = _images(offenders)
    pairs = [p for p in registration.pairs if not {*p.images} & reasons.keys() and p.images not in offenders]
    try:
        aligned = aligner.align(pairs)
    except RegistrationError:
        return None
    used = aligned.alignment.used
    held = _held_by(registration, reasons)
    for images, message in offenders.items():
        reasons |= {k: message for k in images if not used[k]}
    for image, others in held.items():
        named_others = ", ".join(names_of(aligner.paths[k] for k in sorted(others)))
        reasons.setdefault(
            image, Message(f"connected only through {named_others}, which was left out; add images around it")
        )
    return _aligned_anew(registration, aligned, aligner.paths, reasons)


def _aligned_anew(
    registration: Registration, aligned: AlignedPairs, paths: Sequence[str], reasons: Mapping[int, Message]
) -> Registration:
    """The registration with another alignment, and why images are not in it."""
    known = {k: message.text for k, message in reasons.items()}
    number = {path: k for k, path in enumerate(paths)}
    again = [message for message in registration.left_out if message.images[0] in number]  # the others were not read
    known |= {number[m.images[0]]: m.text for m in again}
    unused = explain_unaligned(aligned.alignment, paths, registration.keypoints, known)
    dropped = (*registration.alignment.messages, *again)
    whole = [message for message in registration.messages if message not in dropped]
    messages = (*aligned.alignment.messages, *whole, *unused)
    return replace(registration, alignment=aligned.alignment, messages=messages)


def scale_uncertainty(alignment: Alignment) -> list[Message]:
    """A warning where the focal length, and with it the length of every step, is hardly known."""
    if not alignment.length_std > Limits.length_std.value:
        return []
    off = f"all lengths may be off together by {alignment.length_std:.0%}"
    text = f"{off}: the images hardly show the focal length; give --focal"
    return [Message(text, code="focal-unknown")]
