"""Stage: check a registration; what fails a check is left out by name, and the rest is aligned anew."""

from collections.abc import Iterable, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from rdstitch.alignment.motion_models import PLANAR_MODELS
from rdstitch.alignment.result import Alignment, LinkFit
from rdstitch.alignment.unaligned import explain_unaligned
from rdstitch.cache import Cache
from rdstitch.errors import PartialResultError, RegistrationError
from rdstitch.messages import Message, left_out, names_of, told_once
from rdstitch.options import StitchOptions
from rdstitch.pipeline.aligner import AlignedPairs, Aligner, impossible_estimates_fail
from rdstitch.pipeline.working_size import at_full_size
from rdstitch.registration import Registration
from rdstitch.verification.competing_motions import planes_of_pairs
from rdstitch.verification.verdict import RefusedError, judge

_MAX_SCALE_UNCERTAINTY = 0.05  # share that lengths may be off by, as far as the focal length is, without a word
_MAX_ROUNDS = 20  # times that something is left out; each takes one adjustment

_FEW_PAIRS = 500
"""Pairs up to which every failure is reason enough to look for a second motion in each: that takes 20 seconds then. In
larger sets something has been seen to move otherwise, or the failure is one of the whole."""


@dataclass(frozen=True)
class _Offenders:
    """What one round leaves out: images, and links without which other images may fall off.

    Attributes
    ----------
    reasons : mapping of int to Message
        What is wrong with an image, by its index.
    links : mapping of (int, int) to Message
        What is wrong with a pair of images.
    """

    reasons: Mapping[int, Message]
    links: Mapping[tuple[int, int], Message]

    def __bool__(self) -> bool:
        """Whether there are any."""
        return bool(self.reasons or self.links)

    def __or__(self, other: "_Offenders") -> "_Offenders":
        """Those of both."""
        return _Offenders({**self.reasons, **other.reasons}, {**self.links, **other.links})


@impossible_estimates_fail()
def accept(
    registration: Registration,
    options: StitchOptions,
    executor: Executor,
    *,
    metric: bool = False,
    lens_only: bool = False,
    prefer_turn: bool = False,
) -> Registration:
    """The registration of what passes all checks, with everything that the user should know of it.

    Parameters
    ----------
    registration : Registration
        In pixels of the working size; the result is in those of the images.
    executor : concurrent.futures.Executor
        Where images are compared.
    metric : bool
        Metric poses are needed, also of what remains.
    lens_only : bool
        Only the lens is wanted, so that doubts about the places of images do not matter.
    prefer_turn : bool
        As for :func:`rdstitch.pipeline.register.register`.

    Raises
    ------
    RefusedError
        When nothing trustworthy remains, unless ``options.force``: then everything is kept.
    PartialResultError
        When an image is left out, under ``options.strict``.
    """
    cache = Cache(options.cache)
    layout_matters = not (lens_only or metric)
    aligner = Aligner.of(registration.sources, options, cache, prefer_turn=prefer_turn, layout_matters=layout_matters)
    aligner = replace(aligner, needs_poses=metric)
    undamaged = None if options.force else _without_damage(registration, aligner)
    if undamaged is not None and _is_simpler(undamaged.alignment.model, registration.alignment.model):
        registration, undamaged = undamaged, None
    checked = partial(judge, threshold=options.threshold, executor=executor, cache=cache, lens_only=lens_only)
    current, found = registration, checked(registration)
    first = registration.with_messages(found)
    if not first.ok and undamaged is not None and undamaged.with_messages(judged := checked(undamaged)).ok:
        current, found = undamaged, judged
    elif not first.ok and not options.force:
        left = _Offenders({}, {})
        plane = None
        if not lens_only and (len(registration.pairs) <= _FEW_PAIRS or _may_be_another_plane(found)):
            plane = _plane_of_most(registration, options.threshold, aligner)
        judged = () if plane is None else checked(plane)
        if plane is not None and not _concerns_all(judged):
            registration, current, found = plane, plane, judged
        for _ in range(_MAX_ROUNDS):
            if current.with_messages(found).ok:
                break
            if _concerns_all(found):
                raise RefusedError(at_full_size(first if current is registration else current.with_messages(found)))
            worst = _worst(current, found)
            left |= worst
            shrunk = _without(registration, left, aligner) if worst else None
            # Where as many images fail as pass, nobody can say which of them are right.
            if shrunk is None or shrunk.alignment.used.sum() <= len(left.reasons):
                raise RefusedError(at_full_size(first))
            current, found = shrunk, checked(shrunk)
    accepted = at_full_size(current).with_messages(found)
    if not accepted.ok and not options.force:
        raise RefusedError(at_full_size(first))
    if options.strict and accepted.left_out:
        raise PartialResultError("; ".join(map(str, told_once(accepted.left_out))))
    return accepted


def _without_damage(registration: Registration, aligner: Aligner) -> Registration | None:
    """Without images of damaged files; None where none is used, or too few others are left.

    Flipped bits shift a part of an image: by a few pixels, that looks as if the camera had tilted, and all tilt then;
    by more, as if something moved.
    """
    used = registration.alignment.used
    index = {str(source.path): k for k, source in enumerate(registration.sources)}
    reported = (message.images[0] for message in registration.sources[0].guard.messages)
    damaged = [index[path] for path in reported if path in index and used[index[path]]]
    if not damaged:
        return None
    reason = Message("is damaged, and all others fit better without it; copy it again from its source")
    rest = _without(registration, _Offenders(dict.fromkeys(damaged, reason), {}), aligner)
    return rest if rest is not None and 2 * rest.alignment.used.sum() > used.sum() else None


def _is_simpler(model: str, former: str) -> bool:
    """Whether a motion in the plane has less freedom than a former one."""
    by_freedom = list(PLANAR_MODELS)
    return {model, former} <= PLANAR_MODELS.keys() and by_freedom.index(model) < by_freedom.index(former)


def _plane_of_most(registration: Registration, threshold: float, aligner: Aligner) -> Registration | None:
    """Of two motions in the images that which may fill most of them; None where that is not to be seen."""
    if registration.static_background:
        return None
    pairs = planes_of_pairs(registration, threshold)
    if pairs is None:
        return None
    try:
        aligned = aligner.align(pairs)
    except RegistrationError:
        return None
    plane = _aligned_anew(replace(registration, pairs=tuple(aligner.used(aligned))), aligned, aligner.paths, {})
    return plane if 2 * plane.alignment.used.sum() > len(registration.sources) else None


def _may_be_another_plane(found: Iterable[Message]) -> bool:
    """Whether something moves differently from what was registered, or the whole fails."""
    return any(
        message.code == "rival-motion" or (message.severity == "failure" and not message.images) for message in found
    )


def _concerns_all(found: Iterable[Message]) -> bool:
    """Whether something fails that no image or pair is to blame for, so that leaving one out would only hide it."""
    return any(message.severity == "failure" and len(message.images) > 2 for message in found)


def _worst(registration: Registration, found: Iterable[Message]) -> _Offenders:
    """The worst images, no two of them linked, since a bad image spoils its neighbours; else the failing pairs."""
    index = {str(source.path): k for k, source in enumerate(registration.sources)}
    failures = [message for message in found if message.severity == "failure"]
    single = {index[m.images[0]]: m for m in failures if len(m.images) == 1}
    if not single:
        pairs = (m for m in failures if len(m.images) == 2)
        return _Offenders({}, {(index[m.images[0]], index[m.images[1]]): m for m in pairs})
    used = [fit for fit in registration.alignment.links if fit.used]
    fit_share = agreement(used, len(registration.sources))
    chosen: dict[int, Message] = {}
    for image in sorted(single, key=lambda k: (fit_share[k], k)):
        linked = {fit.image1 + fit.image2 - image for fit in used if image in (fit.image1, fit.image2)}
        if not linked & chosen.keys():
            chosen[image] = single[image]
    return _Offenders(chosen, {})


def agreement(links: Sequence[LinkFit], count: int) -> np.ndarray:
    """Share of the matches of each image that agree with the whole, shape (N,); 1 without any."""
    given, kept = np.zeros(count), np.zeros(count)
    for fit in links:
        given[[fit.image1, fit.image2]] += fit.count
        kept[[fit.image1, fit.image2]] += fit.inliers
    return np.where(given > 0, kept / np.maximum(given, 1.0), 1.0)


def _held_by(registration: Registration, offenders: _Offenders) -> dict[int, set[int]]:
    """The images left out that each other image is linked with."""
    held: dict[int, set[int]] = {}
    for fit in registration.alignment.links:
        for own, other in ((fit.image1, fit.image2), (fit.image2, fit.image1)):
            if fit.used and other in offenders.reasons and own not in offenders.reasons:
                held.setdefault(own, set()).add(other)
    return held


def _without(registration: Registration, offenders: _Offenders, aligner: Aligner) -> Registration | None:
    """The rest, aligned anew; None where nothing that fits together would be left.

    Pairs that contradicted the offenders are judged again: it may have been the offenders that were wrong.
    """
    pairs = [
        pair
        for pair in registration.pairs
        if not {pair.image1, pair.image2} & offenders.reasons.keys()
        and (pair.image1, pair.image2) not in offenders.links
    ]
    try:
        aligned = aligner.align(pairs)
    except RegistrationError:
        return None
    used = aligned.alignment.used
    reasons = dict(offenders.reasons)
    for pair, message in offenders.links.items():
        reasons.update({k: message for k in pair if not used[k]})
    for image, others in _held_by(registration, offenders).items():
        named_others = ", ".join(names_of(aligner.paths[k] for k in sorted(others)))
        reasons.setdefault(image, Message(f"hangs on {named_others}, which was left out; add images around it"))
    return _aligned_anew(registration, aligned, aligner.paths, reasons)


def _aligned_anew(
    registration: Registration, aligned: AlignedPairs, paths: Sequence[str], reasons: Mapping[int, Message]
) -> Registration:
    """The registration with another alignment, and why images are not in it."""
    known = {message.images: message for message in registration.left_out}
    unaligned = np.flatnonzero(~aligned.alignment.used).tolist()
    explained = zip(unaligned, explain_unaligned(aligned.alignment, paths, registration.keypoints), strict=True)
    unused = [
        known.get(message.images, left_out(paths[k], reasons[k].text) if k in reasons else message)
        for k, message in explained
    ]
    dropped = (*registration.alignment.messages, *registration.left_out)
    whole = [message for message in registration.messages if message not in dropped]
    messages = (*aligned.alignment.messages, *whole, *unused)
    return replace(registration, alignment=aligned.alignment, messages=messages)


def scale_uncertainty(alignment: Alignment) -> list[Message]:
    """A warning where the focal length, and with it the length of every step, is hardly known."""
    if not alignment.length_std > _MAX_SCALE_UNCERTAINTY:
        return []
    off = f"all lengths may be off together by {alignment.length_std:.0%}"
    text = f"{off}: the images hardly show the focal length; give --focal"
    return [Message(text, code="focal-unknown")]
