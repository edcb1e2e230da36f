"""Which findings are said aloud, in one table; what is not goes into the sidecar, the report and ``-v`` as a note.

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
    depth : bool
        Whether the scene has depth, or the camera moved while it turned.
    shape_shown : bool
        Whether the errors show that the shape of the whole is off, by less than an image.
    """

    alike: float
    depth: bool
    shape_shown: bool


@dataclass(frozen=True)
class Rule:
    """When one kind of finding is said.

    Attributes
    ----------
    kind : str
        Code of the message.
    speaks : callable
    """

    kind: str
    speaks: Callable[[Situation], bool]


_HIDDEN = 0.25
"""Share of the overlaps that looks alike from which on depth leaves no break that is seen: 0.43 to 1 in 24 published
sets of hand-held images that a person would keep, and a flight over trees (``python -m tests.benchmarks.world``)."""

RULES = (
    Rule("parallax", lambda found: found.alike < _HIDDEN),
    Rule("relief", lambda found: found.alike < _HIDDEN),
    Rule("shape", lambda found: found.shape_shown and not found.depth),
    Rule("rival-motion", lambda found: not found.depth),
)
"""By how much they put a result at risk, the gravest first; kinds without a rule speak always, and before these."""


def spoken(messages: Iterable[Message], found: Situation) -> tuple[Message, ...]:
    """Make notes of warnings that their rule silences, of all but the first of a kind, and of more than a few."""
    order = {rule.kind: number for number, rule in enumerate(RULES)}
    given = list(messages)
    said: set[str] = set()
    aloud: set[int] = set()
    for number in sorted(range(len(given)), key=lambda index: order.get(given[index].code, -1)):
        message = given[number]
        if message.severity != "warning" or len(aloud) == MAX_WARNINGS or (message.code and message.code in said):
            continue
        if message.code in order and not RULES[order[message.code]].speaks(found):
            continue
        aloud.add(number)
        said.add(message.code)
    return tuple(
        replace(message, severity="note") if message.severity == "warning" and number not in aloud else message
        for number, message in enumerate(given)
    )
