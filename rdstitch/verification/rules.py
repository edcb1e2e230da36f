"""Which findings are said aloud, in one table; what is not goes into the report and ``-v`` as a detail.

A warning is for what puts this result at risk. Where images look alike in the pixels, what their matches say of depth
or of errors has been hidden by local alignment and seams, and does not.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace

from rdstitch.messages import Message

MAX_WARNINGS = 3
"""Lines of one run."""


@dataclass(frozen=True)
class Situation:
    """What the rules look at.

    Attributes
    ----------
    alike : float
        Median share of the overlaps that looks alike, [0, 1].
    flat : bool
        Whether the images are said to show a plane that three or more of them hold together: of a turn, and of two
        images, only overlaps can be wrong, and they are looked at.
    depth : bool
        Whether the scene has depth, or the camera moved while it turned.
    shape_doubtful : bool
        Whether the shape of the whole may be off, by less than an image.
    """

    alike: float
    flat: bool
    depth: bool
    shape_doubtful: bool


@dataclass(frozen=True)
class Rule:
    """When a finding is said.

    Attributes
    ----------
    code : str
        Of the message.
    kind : str
        What it is about; of one kind the first is said.
    speaks : callable
    """

    code: str
    kind: str
    speaks: Callable[[Situation], bool]


_HIDDEN = 0.25
"""Share of the overlaps that looks alike from which on depth leaves no break that is seen: 0.26 to 1 in 22 published
sets of hand-held images that a person would keep (``python -m tests.benchmarks.world``)."""

RULES = (
    Rule("shape", "flatness", lambda found: found.flat and found.shape_doubtful),
    Rule("relief", "flatness", lambda found: found.flat or found.alike < _HIDDEN),
    Rule("parallax", "flatness", lambda found: found.alike < _HIDDEN),
    Rule("rival-motion", "rival-motion", lambda found: found.flat or not found.depth),
    Rule("doubtful-seam", "doubtful-seam", lambda found: not found.depth or found.alike < _HIDDEN),
)
"""The gravest first; what has no rule is always said, and before these."""


def spoken(messages: Iterable[Message], found: Situation) -> tuple[Message, ...]:
    """Make details of warnings that their rule silences, of all but the first of a kind, and of more than a few."""
    given, order = list(messages), {rule.code: number for number, rule in enumerate(RULES)}
    kinds: set[str] = set()
    aloud: set[int] = set()
    for number in sorted(range(len(given)), key=lambda index: order.get(given[index].code, -1)):
        message = given[number]
        rule = RULES[order[message.code]] if message.code in order else None
        kind = message.code if rule is None else rule.kind
        silent = (kind and kind in kinds) or (rule is not None and not rule.speaks(found))
        if message.severity == "warning" and not silent and len(aloud) < MAX_WARNINGS:
            aloud.add(number)
            kinds.add(kind)
    return tuple(
        replace(message, severity="detail") if message.severity == "warning" and number not in aloud else message
        for number, message in enumerate(given)
    )


def one_of_each(failures: Iterable[Message]) -> list[Message]:
    """Return the first failure of each code, of few codes: what one line can say."""
    first: dict[str, Message] = {}
    for failure in failures:
        first.setdefault(failure.code or failure.text, failure)
    return list(first.values())[:MAX_WARNINGS]
