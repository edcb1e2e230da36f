"""Every run judges itself: can the result be relied on? Evidence, rules, findings."""

from collections.abc import Collection, Iterable, Sequence
from dataclasses import replace

from rdstitch.alignment.result import LinkFit
from rdstitch.errors import RegistrationError
from rdstitch.matching.match_graph import connected_components
from rdstitch.matching.two_view import Pair
from rdstitch.results.messages import Message
from rdstitch.results.registration import Registration
from rdstitch.verification import rules
from rdstitch.verification.evidence import ResultEvidence
from rdstitch.verification.findings import Finding, Kind, Pairs

_MAX_WARNINGS = 3  # lines of one run
_NOT_FLAT = frozenset({Kind.FREE_HOMOGRAPHIES, Kind.ROUGH, Kind.RELIEF, Kind.DEPTH_OF_A_TURN})  # one topic


class RefusedError(RegistrationError):
    """A registration failed its checks; it is kept for those who want to see why.

    Attributes
    ----------
    registration : Registration
    """

    code = "not-reliable"

    def __init__(self, registration: Registration) -> None:
        first: dict[str, Message] = {}
        for message in registration.failures:
            first.setdefault(message.kind or message.text, message)
        chosen = list(first.values())[:_MAX_WARNINGS]
        reasons = "; ".join(message.clause for message in chosen)
        if rest := len(registration.failures) - len(chosen):
            reasons += f"; and {rest} more"
        super().__init__(f"no reliable result: {reasons} (--force writes it all the same)")
        self.registration = registration


def judge(evidence: ResultEvidence) -> tuple[Finding, ...]:
    """Check an alignment against the pairs that it was made from, and against the pixels.

    Gives failures, with the images that they concern where that is clear, and warnings; none for a good result.
    """
    if failures := failures_of_matches(evidence):
        return failures
    decisive, outvoted = _split_by_dependence(rules.findings(rules.OF_PAIRS, evidence), evidence)
    whole = rules.findings(rules.OF_THE_WHOLE, evidence)
    return _limit_warnings([*decisive, *whole, *_outvoted(outvoted)])


def failures_of_matches(evidence: ResultEvidence) -> tuple[Finding, ...]:
    """Failures by matches alone: where there are any, pixels are not looked at before images are left out."""
    findings = rules.findings(rules.OF_MATCHES, evidence)
    if evidence.static:  # matches of what is static in the images agree with nothing
        return tuple(finding for finding in findings if not finding.images)
    return *findings, *_split_by_dependence(rules.findings(rules.OF_MATCHED_PAIRS, evidence), evidence)[0]


def _split_by_dependence(
    suspicions: Iterable[Finding], evidence: ResultEvidence
) -> tuple[list[Finding], list[Finding]]:
    """Suspicions of pairs without which the images fall apart, and those of pairs on which nothing depends."""
    by_pair = {(finding.images[0], finding.images[1]): finding for finding in suspicions}
    count = len(evidence.registration.sources)
    decisive = set[Pair]() if evidence.static else set(decisive_pairs(by_pair, evidence.used, count))
    essential = [finding for pair, finding in by_pair.items() if pair in decisive]
    return essential, [finding for pair, finding in by_pair.items() if pair not in decisive]


def decisive_pairs(suspicious: Collection[Pair], used: Sequence[LinkFit], count: int) -> list[Pair]:
    """The suspicious pairs without which the images fall apart; those of the others are held by better ones."""
    sound = [fit for fit in used if (fit.image1, fit.image2) not in suspicious]
    parts = connected_components(count, [fit.image1 for fit in sound], [fit.image2 for fit in sound])
    part = {image: number for number, images in enumerate(parts) for image in images}
    return [(i, j) for i, j in suspicious if part[i] != part[j]]


def _outvoted(suspicions: Iterable[Finding]) -> list[Finding]:
    """Suspicious pairs on which nothing depends: those that fit badly, and those that fit twice, together each."""
    kinds: dict[Kind, list[tuple[int, ...]]] = {Kind.OUTVOTED: [], Kind.OUTVOTED_PATTERN: []}
    for finding in suspicions:
        kinds[Kind.OUTVOTED_PATTERN if finding.kind is Kind.AMBIGUOUS else Kind.OUTVOTED].append(finding.images)
    return [
        Finding(kind, "detail", tuple(sorted({k for pair in pairs for k in pair})), {"pairs": Pairs(pairs)})
        for kind, pairs in kinds.items()
        if pairs
    ]


def _limit_warnings(findings: Iterable[Finding]) -> tuple[Finding, ...]:
    """Make details of all warnings but the first of each topic, and of more than a few."""
    topics, limited = set[object](), list[Finding]()
    for finding in findings:
        topic = _NOT_FLAT if finding.kind in _NOT_FLAT else finding.kind
        warns = finding.severity == "warning" and topic not in topics and len(topics) < _MAX_WARNINGS
        topics |= {topic} if warns else set()
        limited.append(replace(finding, severity="detail") if finding.severity == "warning" and not warns else finding)
    return tuple(limited)
