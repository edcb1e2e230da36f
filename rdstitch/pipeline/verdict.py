"""Every run judges itself: can the result be relied on?"""

from dataclasses import dataclass

import numpy as np

from rdstitch.pipeline.register import Registration

_LARGEST_RMS = 1.0  # of the whole, in thresholds
_LEAST_INLIERS = 0.5  # share of a pair's own inliers that agree with the whole


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


def judge(registration: Registration, threshold: float) -> Verdict:
    """Check an alignment against the pairs that it was made from.

    Parameters
    ----------
    registration : Registration
    threshold : float
        Largest transfer error of an inlier of a pair, px.
    """
    alignment = registration.alignment
    failures: list[str] = []
    doubts: list[str] = []
    used = [fit for fit in alignment.links if fit.used]
    names = [source.name for source in registration.sources]
    if not np.isfinite(alignment.rms) or alignment.rms > _LARGEST_RMS * threshold:
        failures.append(f"the pictures disagree by {alignment.rms:.1f} px, more than the threshold of {threshold:g} px")
    given, kept = sum(fit.count for fit in used), sum(fit.inliers for fit in used)
    if kept < _LEAST_INLIERS * given:
        failures.append(f"only {kept} of {given} matches of the pairs agree with the whole")
    doubts.extend(
        f"{names[fit.image1]} and {names[fit.image2]}: only {fit.inliers} of {fit.count} matches agree with the whole; "
        "look at the seam between them"
        for fit in used
        if fit.inliers < _LEAST_INLIERS * fit.count
    )
    return Verdict(not failures, tuple(failures), tuple(doubts))
