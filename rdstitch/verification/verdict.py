"""Every run judges itself: can the result be relied on?"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from rdstitch.alignment.result import LinkFit
from rdstitch.cache import NO_CACHE, Cache
from rdstitch.errors import RegistrationError
from rdstitch.matching.match_graph import connected_components
from rdstitch.registration import Registration
from rdstitch.verification.overlap_check import CheckedLink, check_overlaps

Pair = tuple[int, int]

_LARGEST_RMS = 1.0  # of the whole, in thresholds
_LEAST_INLIERS = 0.5  # share of a pair's own inliers that agree with the whole
# The same over all pairs of a picture; right ones have been seen to have 83 % even with relief, others 52 %.
_LEAST_OF_A_PICTURE = 0.6
# Of the cells of an overlap that agree: chance lets up to 7 % do so, and right registrations of difficult pictures
# (low sun, parallax, blur) have been seen to have 20 %.
_LEAST_AGREEMENT, _DOUBTFUL_AGREEMENT = 0.10, 0.15
_LEAST_CELLS = 8  # below, the overlap has too little texture to say anything
_MOST_NAMED = 3  # pairs, pictures or cameras in one message
_FOCAL_SPREAD = 1.03  # ratio of focal lengths in EXIF from which on the lens was zoomed


@dataclass(frozen=True)
class Verdict:
    """Whether a result passed its checks.

    Attributes
    ----------
    ok : bool
    failures : tuple of str
        Why the result cannot be relied on, one clause each; empty if ``ok``.
    doubts : tuple of str
        What the user should look at although the result passed.
    """

    ok: bool
    failures: tuple[str, ...]
    doubts: tuple[str, ...]

    @property
    def complaints(self) -> tuple[str, ...]:
        """Everything that the user must be told: failures, which a forced result has, and doubts."""
        return (*(f"not reliable: {failure}" for failure in self.failures), *self.doubts)


class RefusedError(RegistrationError):
    """A registration failed its checks; it is kept for those who want to see why.

    Attributes
    ----------
    registration : Registration
    verdict : Verdict
    """

    def __init__(self, registration: Registration, verdict: Verdict) -> None:
        reasons = "; ".join(verdict.failures)
        super().__init__(f"no reliable result: {reasons} (--force writes it all the same)")
        self.registration, self.verdict = registration, verdict


def judge(
    registration: Registration,
    threshold: float,
    workers: int = 1,
    cache: Cache = NO_CACHE,
    *,
    lens_only: bool = False,
) -> Verdict:
    """Check an alignment against the pairs that it was made from, and against the pixels.

    What makes the places of pictures doubtful, a repeated pattern for one, leaves the lens as it is: a board shifted by
    a square is as straight as before. And pictures that mostly show what rests in them keep some matches of that,
    which agree with nothing, and look alike anywhere but where the moving plane puts them.

    Parameters
    ----------
    registration : Registration
    threshold : float
        Largest transfer error of an inlier of a pair, px.
    workers : int
        Pictures read at the same time.
    cache : Cache
    lens_only : bool
        Only the lens is wanted, so that doubts about the places of pictures do not make the result fail.
    """
    alignment = registration.alignment
    names = [source.name for source in registration.sources]
    used = [fit for fit in alignment.links if fit.used]
    failures: list[str] = []
    if not np.isfinite(alignment.rms) or alignment.rms > _LARGEST_RMS * threshold:
        failures.append(f"the pictures disagree by {alignment.rms:.1f} px, more than the threshold of {threshold:g} px")
    given, kept = sum(fit.count for fit in used), sum(fit.inliers for fit in used)
    if kept < _LEAST_INLIERS * given:
        failures.append(f"only {kept} of {given} matches of the pairs agree with the whole")
    failures.extend(_mixed(names, registration))
    disagreeing = _disagreeing(names, used)
    checked: list[CheckedLink] = []
    if not registration.resting:
        failures.extend(_misfits(names, used))
        checked = check_overlaps(registration, workers, cache)
    misplaced = {**_unlike(names, checked), **_ambiguous(names, checked)}
    suspicions = {**disagreeing, **misplaced}
    grave = {} if registration.resting else disagreeing if lens_only else suspicions
    decisive = _decisive(grave, used, len(names))
    failures.extend(suspicions[pair] for pair in decisive[:_MOST_NAMED])
    if len(decisive) > _MOST_NAMED:
        failures.append(f"{len(decisive) - _MOST_NAMED} more pairs like these")
    outvoted = _outvoted(names, [pair for pair in suspicions if pair not in decisive])
    return Verdict(not failures, tuple(failures), (*outvoted, *_little_alike(names, checked), *_inputs(registration)))


def _outvoted(names: Sequence[str], pairs: Sequence[Pair]) -> list[str]:
    """Suspicious pairs that decide nothing, in one clause."""
    if not pairs:
        return []
    named = _few([f"{names[i]} and {names[j]}" for i, j in pairs])
    return [f"{len(pairs)} of the pairs fit badly, and little depends on them: {named}; look at the seams between them"]


def _mixed(names: Sequence[str], registration: Registration) -> list[str]:
    """Two lenses whose pictures were not parted: it is not clear which are whose, or each has one picture only."""
    mixed = registration.mixed
    if mixed is None or mixed.certain:
        return []
    own, others = ([name for name, s in zip(names, mixed.second, strict=True) if s == k] for k in (True, False))
    return [
        f"two lenses or zooms are mixed: {_few(own)} (λ about {mixed.distortion[1]:.3f}) and {_few(others)} "
        f"({mixed.distortion[0]:.3f}); stitch those of each on their own"
    ]


def _misfits(names: Sequence[str], used: Sequence[LinkFit]) -> list[str]:
    """Pictures of whose matches too many, over all their pairs, do not fit into the whole."""
    given, kept = np.zeros(len(names), dtype=np.intp), np.zeros(len(names), dtype=np.intp)
    for fit in used:
        given[[fit.image1, fit.image2]] += fit.count
        kept[[fit.image1, fit.image2]] += fit.inliers
    misfits = np.flatnonzero(kept < _LEAST_OF_A_PICTURE * given).tolist()
    named = [
        f"{names[k]}: only {kept[k]} of {given[k]} of its matches agree with the whole; another camera or zoom?"
        for k in misfits[:_MOST_NAMED]
    ]
    return [*named, f"{len(misfits) - _MOST_NAMED} more pictures like these"] if len(misfits) > _MOST_NAMED else named


def _decisive(suspicions: Mapping[Pair, str], used: Sequence[LinkFit], count: int) -> list[Pair]:
    """The suspicious pairs without which the pictures fall apart; those of the others are held by better ones."""
    sound = [fit for fit in used if (fit.image1, fit.image2) not in suspicions]
    parts = connected_components(count, [fit.image1 for fit in sound], [fit.image2 for fit in sound])
    part = {picture: number for number, pictures in enumerate(parts) for picture in pictures}
    return [(i, j) for i, j in suspicions if part[i] != part[j]]


def _disagreeing(names: Sequence[str], used: Sequence[LinkFit]) -> dict[Pair, str]:
    """Pairs whose matches do not fit into the whole."""
    return {
        (fit.image1, fit.image2): f"{names[fit.image1]} and {names[fit.image2]}: only {fit.inliers} of {fit.count} "
        "matches agree with the whole; another camera or zoom, or no plane? stitch them on their own"
        for fit in used
        if fit.inliers < _LEAST_INLIERS * fit.count
    }


def _unlike(names: Sequence[str], checked: Sequence[CheckedLink]) -> dict[Pair, str]:
    """Pictures that were put together and do not look alike there."""
    return {
        link.pair: f"{names[link.fit.image1]} and {names[link.fit.image2]} do not look alike where they are put "
        f"together ({link.agreement.confirming} of {link.agreement.cells} places agree); leave one of them out"
        for link in checked
        if link.agreement.cells >= _LEAST_CELLS and link.agreement.share < _LEAST_AGREEMENT
    }


def _ambiguous(names: Sequence[str], checked: Sequence[CheckedLink]) -> dict[Pair, str]:
    """Pictures of a repeated pattern, of which nobody can say by how many periods they are apart."""
    return {
        link.pair: f"{names[link.fit.image1]} and {names[link.fit.image2]} fit as well elsewhere, "
        f"{link.ambiguity.shift:.0%} of a picture away (a repeated pattern?); take pictures that share something unique"
        for link in checked
        if link.ambiguity.ambiguous
    }


def _little_alike(names: Sequence[str], checked: Sequence[CheckedLink]) -> list[str]:
    return [
        f"{names[link.fit.image1]} and {names[link.fit.image2]}: only {link.agreement.confirming} of "
        f"{link.agreement.cells} places look alike; look at the seam between them"
        for link in checked
        if link.agreement.cells >= _LEAST_CELLS and _LEAST_AGREEMENT <= link.agreement.share < _DOUBTFUL_AGREEMENT
    ]


def _inputs(registration: Registration) -> list[str]:
    """What may be wrong with the pictures themselves."""
    return [*_several_cameras(registration), *_unmasked(registration)]


def _unmasked(registration: Registration) -> list[str]:
    """Pictures without a mask among others that have one: perhaps a name is misspelt."""
    without = [source.name for source in registration.sources if source.mask is None]
    if not 0 < len(without) < len(registration.sources):
        return []
    return [f"{len(without)} of {len(registration.sources)} pictures have no mask: {_few(without)}"]


def _several_cameras(registration: Registration) -> list[str]:
    """Pictures that say of themselves that they come from another camera, or were zoomed."""
    known = [source for source in registration.sources if source.metadata.model or source.metadata.serial]
    bodies: dict[str, list[str]] = {}
    for source in known:
        m = source.metadata
        bodies.setdefault(" ".join(filter(None, (m.make, m.model, m.serial))), []).append(source.name)
    if len(bodies) > 1:
        commonest = sorted(bodies.items(), key=lambda body: -len(body[1]))[:_MOST_NAMED]
        listed = "; ".join(f"{body} ({len(names)}: {_few(names)})" for body, names in commonest)
        return [f"the pictures come from {len(bodies)} cameras: {listed}; stitch those of each on their own"]
    focal = {s.name: s.metadata.focal_px / max(s.metadata.size) for s in known if s.metadata.focal_px is not None}
    if focal and max(focal.values()) > _FOCAL_SPREAD * min(focal.values()):
        near, far = min(focal, key=lambda name: focal[name]), max(focal, key=lambda name: focal[name])
        return [
            f"the lens was zoomed between the pictures, by up to {focal[far] / focal[near]:.2f} "
            f"(between {near} and {far}); stitch those of one zoom on their own"
        ]
    return []


def _few(names: Sequence[str]) -> str:
    """Names, or the first of them where they are many."""
    return ", ".join(names[:_MOST_NAMED]) + ", …" * (len(names) > _MOST_NAMED)
