"""The rules that a result is judged by, and what is found with them.

A warning is for what puts this result at risk. A picture is judged by its seams once it is laid out
(:mod:`rdstitch.compositing.seam_quality`): only what is placed wrongly fails here, and what matches say of depth or of
errors is a detail.
"""

from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import NamedTuple

import numpy as np

from rdstitch.alignment.result import LinkFit, Unused, links_by_image
from rdstitch.alignment.sentences import few_features
from rdstitch.choices import Purpose
from rdstitch.io.metadata import Metadata
from rdstitch.results.messages import Severity
from rdstitch.verification.evidence import ResultEvidence
from rdstitch.verification.findings import Bodies, Finding, Images, Kind, Misfit, Value
from rdstitch.verification.limits import Limits
from rdstitch.verification.overlap_check import wrong_at_most
from rdstitch.verification.second_motions import max_plane_fraction


def _disagreeing_pairs(evidence: ResultEvidence) -> Iterator[Finding]:
    """Pairs of whose matches most do not fit into the whole."""
    for fit in evidence.used:
        few = fit.inliers < Limits.min_pair_inlier_fraction * fit.count
        if few and not evidence.explained_by_depth(fit.images):
            values: dict[str, Value] = {**_counts([fit]), "misfit": _misfit(evidence, fit.images, [fit])}
            yield Finding(Kind.PAIR_MISFITS, "failure", fit.images, values)


def _misfitting_images(evidence: ResultEvidence) -> Iterator[Finding]:
    """Images of whose matches too many do not fit into the whole, over all pairs that do; copies by their own pairs."""
    of_copies = links_by_image(fit for fit in evidence.alignment.links if fit.reason is Unused.COPY)
    links_of = of_copies | links_by_image(evidence.used)
    for k, links in sorted((k, links) for k, links in links_of.items() if evidence.alignment.used[k]):
        fits = [fit for fit in links if fit.inliers >= Limits.min_pair_inlier_fraction * fit.count]
        fits = fits or [fit for fit in links if not fit.used]
        compared = (k,) if links[0].used else None  # copies are not
        counts = _counts(fits)
        few = counts["inliers"] < Limits.min_image_inlier_fraction * counts["count"]
        if few and not evidence.explained_by_depth(compared):
            values: dict[str, Value] = {**counts, "misfit": _misfit(evidence, (k,), fits)}
            yield Finding(Kind.IMAGE_MISFITS, "failure", (k,), values)


def _matches_disagree(evidence: ResultEvidence) -> Iterator[Finding]:
    counts = _counts(evidence.used)
    few = counts["inliers"] < Limits.min_pair_inlier_fraction * counts["count"]
    if few and not evidence.explained_by_depth(None):
        yield Finding(Kind.MATCHES_DISAGREE, "failure", (), counts)


def _counts(fits: Sequence[LinkFit]) -> dict[str, int]:
    return {"inliers": sum(fit.inliers for fit in fits), "count": sum(fit.count for fit in fits)}


def _misfit(evidence: ResultEvidence, images: Sequence[int], fits: Sequence[LinkFit]) -> Misfit:
    if any(few_features(evidence.registration.keypoints, k) for k in images):
        return Misfit.FEW_FEATURES
    return Misfit.FEW_MATCHES if sum(fit.count for fit in fits) < Limits.few_matches else Misfit.OTHER_MOTION


def _mixed_lenses(evidence: ResultEvidence) -> Iterator[Finding]:
    """Two lenses whose images were not separated: it is not clear which are whose, or each has one image only."""
    mixed = evidence.registration.mixed
    if mixed is not None and not mixed.certain:
        images1, images2 = (Images(np.flatnonzero(mixed.second == which).tolist()) for which in (False, True))
        lens1, lens2 = mixed.distortion
        values: dict[str, Value] = {"images1": images1, "images2": images2, "lens1": lens1, "lens2": lens2}
        yield Finding(Kind.LENSES_MIXED, "failure", (), values)


def _errors(evidence: ResultEvidence) -> Iterator[Finding]:
    """Errors of all pairs together; of a picture its seams say whether they are seen."""
    alignment, threshold = evidence.alignment, evidence.threshold
    rms, relief = alignment.rms, alignment.relief
    worst = evidence.worst
    if rms <= Limits.max_rms * threshold:
        return
    largest = Limits.max_relief_rms * 2.0 * max(camera.scale for camera in alignment.cameras)
    # Without what neighbours have in common, errors are those of a plane.
    explained = rms <= largest and rms**2 - relief.size**2 <= (Limits.max_rms * threshold) ** 2
    # Where the pixels agree, depth that one surface does not explain has been found a place all the same.
    rough = (rms <= Limits.max_rough_rms * threshold and evidence.is_alike(Limits.min_alike_fraction)) or (
        relief.found and explained and evidence.is_alike(Limits.min_clearly_alike_fraction)
    )
    values = {"rms": rms, "threshold": threshold}
    if worst is not None and (rough or evidence.purpose.picture):
        severity = _warning_if(evidence.held_by_three or _depth_seen(evidence))
        yield Finding(Kind.ROUGH, severity, worst.images, values)
    elif not evidence.purpose.picture:
        yield Finding(Kind.ERRORS, "failure", (), values)


def _depth(evidence: ResultEvidence) -> Iterator[Finding]:
    """Errors that neighbouring matches have in common, and where they are largest."""
    relief, worst = evidence.alignment.relief, evidence.worst
    if relief.found and worst is not None:
        kind = Kind.DEPTH_OF_A_TURN if evidence.alignment.on_sphere else Kind.RELIEF
        # Even where seams hold a bent plane adds up from image to image, and tilts take most of it up.
        bent = not evidence.purpose.picture or relief.size > Limits.max_shared_error * evidence.threshold
        severity = _warning_if((evidence.held_by_three and bent) or _depth_seen(evidence))
        yield Finding(kind, severity, worst.images, {"relief": relief, "rms": worst.rms})


def _depth_seen(evidence: ResultEvidence) -> bool:
    """Whether depth leaves the images unlike; pictures have their seams."""
    return not evidence.purpose.picture and not evidence.is_alike(Limits.min_alike_fraction)


def _warning_if(warns: bool) -> Severity:
    return "warning" if warns else "detail"


def _free_homographies(evidence: ResultEvidence) -> Iterator[Finding]:
    """A homography for each of three or more images: their chain bends with whatever is not modelled."""
    alignment, worst = evidence.alignment, evidence.worst
    if worst is not None and evidence.held_by_three and alignment.focal is None:
        yield Finding(Kind.FREE_HOMOGRAPHIES, _warning_if(alignment.relief.found), worst.images)


def _unlike(evidence: ResultEvidence) -> Iterator[Finding]:
    """Images that were put together and are no more alike there than by chance.

    In a picture, they must be unlike at a coarse scale too: depth shifts what it shows a little nearly everywhere.
    """
    for link in evidence.checked:
        agreement = link.agreement
        alike = evidence.purpose.picture and agreement.coarse_similarity >= Limits.min_plane_fraction
        fraction = agreement.confirming_fraction
        if fraction is not None and fraction < Limits.max_unlike_fraction and not alike:
            values = {"confirming": agreement.confirming, "cells": agreement.cells}
            yield Finding(Kind.UNLIKE, "failure", link.pair, values)


def _compared_overlaps(evidence: ResultEvidence) -> Iterator[Finding]:
    """How many of many overlaps were compared in their pixels, and what that says of the others."""
    checked, wrong_fraction = evidence.checked, wrong_at_most(evidence.checked)
    if wrong_fraction < Limits.max_wrong_overlaps:
        sampled = sum(link.sampled for link in checked)
        values = {"of": len(evidence.used), "count": len(checked), "sampled": sampled, "fraction": wrong_fraction}
        yield Finding(Kind.OVERLAPS_SAMPLED, "detail", (), values)


def _ambiguous(evidence: ResultEvidence) -> Iterator[Finding]:
    for pair, link in evidence.ambiguous.items():
        yield Finding(Kind.AMBIGUOUS, "failure", pair, {"shift": link.ambiguity.shift})


def _pattern(evidence: ResultEvidence) -> Iterator[Finding]:
    """A pattern over so many pairs that leaving some of them out proves nothing; or one in which the unique decided."""
    if len(evidence.ambiguous) > Limits.max_ambiguous_pairs * len(evidence.checked):
        yield Finding(Kind.PATTERN, "failure", (), {"count": len(evidence.ambiguous), "of": len(evidence.checked)})
    if settled := [link for link in evidence.checked if link.decided_by_unique_content]:
        compared = [link.agreement for link in settled]
        fractions = [each.confirming / each.cells if each.cells else 1.0 for each in compared]
        least_alike = settled[fractions.index(min(fractions))]
        yield Finding(Kind.SETTLED_PATTERN, "warning", least_alike.pair)


def _rival_motion(evidence: ResultEvidence) -> Iterator[Finding]:
    """Poses by something that fills less than half of the images: what drives ahead, say."""
    fraction = max_plane_fraction(link.agreement for link in evidence.checked)
    if fraction < Limits.min_plane_fraction:
        yield Finding(Kind.RIVAL_MOTION, "failure", (), {"fraction": fraction})


def _two_left(evidence: ResultEvidence) -> Iterator[Finding]:
    """Two images without a third, taken for one of another lens, which is all that tells a curved wall from a plane."""
    used = evidence.alignment.used
    if evidence.registration.mixed is not None and used.sum() == 2:
        yield Finding(Kind.TWO_OF_ONE_LENS, "warning", tuple(used.nonzero()[0].tolist()))


def _inputs(evidence: ResultEvidence) -> Iterator[Finding]:
    """Images of several cameras or zoom settings, and images without a mask among others, by headers and files."""
    sources = evidence.registration.sources
    headers = [(k, source.metadata) for k, source in enumerate(sources)]
    bodies: dict[str, list[int]] = {}
    numbered = {(header.make, header.model) for _, header in headers if header.serial}
    for k, header in headers:
        # A program that edits an image often leaves its serial number out: one without may be any of its model.
        if header.serial or (header.model and (header.make, header.model) not in numbered):
            bodies.setdefault(" ".join(filter(None, (header.make, header.model, header.serial))), []).append(k)
    ratio, near, far = focal_ratio(header for _, header in headers)
    if len(bodies) > 1:
        by_body = Bodies({body: Images(images) for body, images in bodies.items()})
        yield Finding(Kind.SEVERAL_CAMERAS, "warning", (), {"number": len(bodies), "bodies": by_body})
    elif ratio > Limits.max_focal_ratio:
        yield Finding(Kind.ZOOMED, "warning", (), {"ratio": ratio, "near": Images([near]), "far": Images([far])})
    without = Images(k for k, source in enumerate(sources) if source.mask is None)
    if 0 < len(without) < len(sources):
        yield Finding(Kind.UNMASKED, "warning", (), {"count": len(without), "of": len(sources), "without": without})


def focal_ratio(headers: Iterable[Metadata]) -> tuple[float, int, int]:
    """The largest ratio of two focal lengths by headers, and the images with the shorter and the longer one.

    Of millimetres, or of pixels of images of one size: a crop is no zoom.
    """
    groups: dict[object, dict[int, float]] = {}
    for k, header in enumerate(headers):
        for group, focal in (("mm", header.focal_mm), (tuple(sorted(header.size)), header.focal_px)):
            if focal is not None:
                groups.setdefault(group, {})[k] = focal
    ends = [(min(each, key=each.__getitem__), max(each, key=each.__getitem__), each) for each in groups.values()]
    return max(((focal[far] / focal[near], near, far) for near, far, focal in ends), default=(1.0, 0, 0))


class Rule(NamedTuple):
    """What finds something, and the recipes that it applies to."""

    find: Callable[[ResultEvidence], Iterable[Finding]]
    purposes: frozenset[Purpose] = frozenset(Purpose)


_PLACES = frozenset(Purpose) - {Purpose.CALIBRATE}
"""A board shifted by a square is as straight as before: the lens is the same."""

_POSES = frozenset({Purpose.TRAJECTORY})  # pictures have their seams, a lens is the same

OF_MATCHES = Rule(_mixed_lenses), Rule(_matches_disagree), Rule(_misfitting_images)
"""Failures by matches: images are left out before any pixels are compared."""

OF_MATCHED_PAIRS = (Rule(_disagreeing_pairs, _PLACES),)
"""The same of pairs: failures where images are connected by them alone."""

OF_PAIRS = *OF_MATCHED_PAIRS, Rule(_unlike, _PLACES), Rule(_ambiguous, _PLACES)
"""Suspicions of pairs, of which the last of each pair counts."""

OF_THE_WHOLE = (
    Rule(_compared_overlaps),
    Rule(_pattern, _PLACES),
    Rule(_rival_motion, _POSES),
    Rule(_two_left),
    Rule(_inputs),
    Rule(_free_homographies, _PLACES),
    Rule(_errors),
    Rule(_depth),
)
"""Everything else, of one topic the gravest first."""


def findings(rules: Iterable[Rule], evidence: ResultEvidence) -> list[Finding]:
    """What those of some rules find that apply to the recipe."""
    return [finding for rule in rules if evidence.purpose in rule.purposes for finding in rule.find(evidence)]
