"""The rules that a result is judged by, and what is found with them.

A warning is for what puts this result at risk. A picture is judged by its seams once it is laid out
(:mod:`rdstitch.compositing.seam_quality`): only what is placed wrongly fails here, and what matches say of depth or of
errors is a detail.
"""

from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import NamedTuple

from rdstitch.alignment.result import LinkFit, links_by_image
from rdstitch.alignment.unaligned import few_features
from rdstitch.inputs.source import Source
from rdstitch.verification.evidence import Evidence
from rdstitch.verification.findings import Finding, Kind
from rdstitch.verification.limits import limit
from rdstitch.verification.overlap_check import wrong_at_most
from rdstitch.verification.rival_planes import fills_at_most

MAX_WARNINGS = 3
"""Lines of one run."""


_TELLING = 0.1
"""Share of overlaps that may be wrong, below which a sample of them says something."""


def disagreeing_pairs(evidence: Evidence) -> Iterator[Finding]:
    """Pairs of whose matches most do not fit into the whole."""
    for fit in evidence.used:
        if fit.inliers < limit("inliers of a pair") * fit.count:
            reason = _reason(evidence, (fit.image1, fit.image2), [fit], "stitch them on their own")
            yield _of_matches(Kind.PAIR_MISFITS, (fit.image1, fit.image2), [fit], reason)


def _misfitting_images(evidence: Evidence) -> Iterator[Finding]:
    """Images of whose matches too many do not fit into the whole, over all pairs that do."""
    for k, links in sorted(links_by_image(evidence.used).items()):
        fits = [fit for fit in links if fit.inliers >= limit("inliers of a pair") * fit.count]
        if sum(fit.inliers for fit in fits) < limit("inliers of an image") * sum(fit.count for fit in fits):
            yield _of_matches(Kind.IMAGE_MISFITS, (k,), fits, _reason(evidence, (k,), fits))


def _matches_disagree(evidence: Evidence) -> Iterator[Finding]:
    if sum(fit.inliers for fit in evidence.used) < limit("inliers of a pair") * sum(fit.count for fit in evidence.used):
        yield _of_matches(Kind.MATCHES_DISAGREE, (), evidence.used)


def _of_matches(kind: Kind, images: tuple[int, ...], fits: Sequence[LinkFit], reason: str = "") -> Finding:
    inliers, count = sum(fit.inliers for fit in fits), sum(fit.count for fit in fits)
    return Finding(kind, images, values={"inliers": inliers, "count": count, "reason": reason})


def _reason(evidence: Evidence, images: Sequence[int], fits: Sequence[LinkFit], remedy: str = "") -> str:
    """Why matches agree with each other only."""
    few = [(evidence.registration.sources[k].name, few_features(evidence.registration.keypoints, k)) for k in images]
    if any(why for _, why in few):
        return ", ".join(f"{name} has {why}" for name, why in few if why)
    why = "they fit each other: does it show another surface, or come from another camera or zoom?"
    if sum(fit.count for fit in fits) < limit("few matches"):
        why = "too few to place it: little overlap, or none?"
    return f"{why} {remedy}".strip()


def _mixed_lenses(evidence: Evidence) -> Iterator[Finding]:
    """Two lenses whose images were not separated: it is not clear which are whose, or each has one image only."""
    mixed = evidence.registration.mixed
    if mixed is not None and not mixed.certain:
        images1, images2 = ([k for k, other in enumerate(mixed.second) if other == which] for which in (False, True))
        lens1, lens2 = mixed.distortion
        values = {"images1": images1, "images2": images2, "lens1": lens1, "lens2": lens2}
        yield Finding(Kind.LENSES_MIXED, values=values)


def _errors(evidence: Evidence) -> Iterator[Finding]:
    """Errors of all pairs together; of a picture its seams say whether they are seen."""
    alignment, threshold = evidence.alignment, evidence.threshold
    rms, relief = alignment.rms, alignment.relief
    if rms <= limit("error") * threshold:
        return
    largest = limit("error that relief explains") * 2.0 * max(camera.scale for camera in alignment.cameras)
    # Without what neighbours have in common, errors are those of a plane.
    explained = rms <= largest and rms**2 - relief.size**2 <= (limit("error") * threshold) ** 2
    # Where the pixels agree, depth that one surface does not explain has been found a place all the same.
    rough = (rms <= limit("error of rough ground") * threshold and evidence.alike >= limit("alike")) or (
        relief.found and explained and evidence.alike >= limit("clearly alike")
    )
    values = {"rms": rms, "threshold": threshold}
    if rough or evidence.purpose.picture:
        yield Finding(Kind.ROUGH, max(evidence.used, key=lambda fit: fit.rms).images, "warning", values)
    else:
        yield Finding(Kind.ERRORS, values=values)


def _depth(evidence: Evidence) -> Iterator[Finding]:
    """Errors that neighbouring matches have in common, and where they are largest."""
    if evidence.alignment.relief.found:
        fit = max(evidence.used, key=lambda fit: fit.rms)
        what = evidence.alignment.relief.explanation
        kind = Kind.DEPTH_OF_A_TURN if evidence.alignment.on_sphere else Kind.RELIEF
        yield Finding(kind, (fit.image1, fit.image2), "warning", {"what": what, "rms": fit.rms})


def _free_homographies(evidence: Evidence) -> Iterator[Finding]:
    """A homography for each of three or more images: their chain bends with whatever is not modelled."""
    alignment = evidence.alignment
    if evidence.flat and alignment.focal is None:
        fit = max(evidence.used, key=lambda fit: fit.rms)
        yield Finding(Kind.FREE_HOMOGRAPHIES, fit.images, "warning" if alignment.relief.found else "detail")


def _unlike(evidence: Evidence) -> Iterator[Finding]:
    """Images that were put together and are no more alike there than by chance; of a picture also at a coarse scale,
    as depth shifts what it shows by a little nearly everywhere.
    """
    for link in evidence.checked:
        coarsely = evidence.purpose.picture and link.agreement.coarsely >= limit("filled by a plane")
        if link.agreement.cells >= limit("cells") and link.agreement.share < limit("unlike") and not coarsely:
            values = {"confirming": link.agreement.confirming, "cells": link.agreement.cells}
            yield Finding(Kind.UNLIKE, link.pair, "failure", values)


def _looked_at(evidence: Evidence) -> Iterator[Finding]:
    """How many of many overlaps were compared in their pixels, and what that says of the others."""
    checked, share = evidence.checked, wrong_at_most(evidence.checked)
    if share < _TELLING:
        sampled = sum(link.sampled for link in checked)
        values = {"of": len(evidence.used), "count": len(checked), "sampled": sampled, "share": share}
        yield Finding(Kind.LOOKED_AT, (), "detail", values)


def _ambiguous(evidence: Evidence) -> Iterator[Finding]:
    for pair, link in evidence.ambiguous.items():
        yield Finding(Kind.AMBIGUOUS, pair, values={"shift": link.ambiguity.shift})


def _pattern(evidence: Evidence) -> Iterator[Finding]:
    """A pattern over so many pairs that leaving some of them out proves nothing; or one in which the unique decided."""
    if len(evidence.ambiguous) > limit("pattern") * len(evidence.checked):
        yield Finding(Kind.PATTERN, values={"count": len(evidence.ambiguous), "of": len(evidence.checked)})
    settled = [link for link in evidence.checked if link.unique]
    if settled:
        yield Finding(Kind.SETTLED_PATTERN, min(settled, key=lambda link: link.agreement.share).pair, "warning")


def _rival_motion(evidence: Evidence) -> Iterator[Finding]:
    """Poses by something that fills less than half of the images: what drives ahead, say. Pictures have their seams, a
    lens is the same.
    """
    share = fills_at_most(link.agreement for link in evidence.checked) if evidence.purpose.poses else 1.0
    if share < limit("filled by a plane"):
        yield Finding(Kind.RIVAL_MOTION, values={"share": share})


def _two_left(evidence: Evidence) -> Iterator[Finding]:
    """Two images without a third, taken for one of another lens, which is all that tells a curved wall from a plane."""
    used = evidence.alignment.used
    if evidence.registration.mixed is not None and used.sum() == 2:
        yield Finding(Kind.TWO_OF_ONE_LENS, tuple(used.nonzero()[0].tolist()), "warning")


def _inputs(evidence: Evidence) -> Iterator[Finding]:
    """Images of several cameras or zoom settings, and images without a mask among others, by headers and files."""
    sources = evidence.registration.sources
    bodies: dict[str, list[int]] = {}
    for k, source in enumerate(sources):
        m = source.metadata
        if m.model or m.serial:
            bodies.setdefault(" ".join(filter(None, (m.make, m.model, m.serial))), []).append(k)
    focal = {k: _focal_share(source) for k, source in enumerate(sources) if source.metadata.focal_px is not None}
    if len(bodies) > 1:
        yield Finding(Kind.SEVERAL_CAMERAS, (), "warning", {"bodies": bodies})
    elif focal and max(focal.values()) > limit("zoom") * min(focal.values()):
        near, far = min(focal, key=lambda k: focal[k]), max(focal, key=lambda k: focal[k])
        yield Finding(Kind.ZOOMED, (), "warning", {"ratio": focal[far] / focal[near], "near": near, "far": far})
    without = [k for k, source in enumerate(sources) if source.mask is None]
    if 0 < len(without) < len(sources):
        yield Finding(Kind.UNMASKED, (), "warning", {"without": without})


def _focal_share(source: Source) -> float:
    return float(source.metadata.focal_px or 0.0) / max(source.metadata.size)


Find = Callable[[Evidence], Iterable[Finding]]

OF_MATCHES: tuple[Find, ...] = (_mixed_lenses, _matches_disagree, _misfitting_images)
"""Failures by which the pixels need not be asked: of images that may be left out."""

OF_PAIRS: tuple[Find, ...] = (disagreeing_pairs, _unlike, _ambiguous)
"""Suspicions of pairs, the last of each counts: a failure where images hang on it alone."""

OF_THE_WHOLE: tuple[Find, ...] = (
    _errors,
    _depth,
    _free_homographies,
    _looked_at,
    _pattern,
    _rival_motion,
    _two_left,
    _inputs,
)
"""Everything else."""

OF_PLACES = {
    Kind.FREE_HOMOGRAPHIES, Kind.PATTERN, Kind.SETTLED_PATTERN, Kind.AMBIGUOUS,
    Kind.OUTVOTED, Kind.OUTVOTED_PATTERN,
}  # fmt: skip
"""Kinds that make the places of images doubtful and leave the lens as it is: a board shifted by a square is as straight
as before."""


def _bent(evidence: Evidence) -> bool:
    """Whether what neighbours share shows a bent plane, even where seams hold: it adds up from image to image, and
    tilts take most of it up.
    """
    return evidence.flat and evidence.alignment.relief.size > limit("bent") * evidence.threshold


def _depth_seen(evidence: Evidence) -> bool:
    """Whether depth leaves the images unlike; pictures have their seams."""
    return not evidence.purpose.picture and evidence.alike < limit("alike")


class Aloud(NamedTuple):
    """When a warning of a kind is one, and not a detail; of one topic the first is."""

    topic: str
    speaks: Callable[[Evidence], bool] = lambda evidence: True


ALOUD = {
    Kind.FREE_HOMOGRAPHIES: Aloud("flatness"),
    Kind.ROUGH: Aloud("flatness", lambda evidence: evidence.flat or _depth_seen(evidence)),
    Kind.RELIEF: Aloud(
        "flatness",
        lambda evidence: _bent(evidence) or (evidence.flat and not evidence.purpose.picture) or _depth_seen(evidence),
    ),
    Kind.DEPTH_OF_A_TURN: Aloud("flatness", _depth_seen),
}
"""The gravest first; other kinds are always said, and before these."""
