"""What a user should know of a result, as one type: what it is, which pictures it concerns, and how grave it is."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

Severity = Literal["note", "warning", "left out", "failure"]

MAX_NAMED = 3
"""Pictures or pairs that one message names."""


@dataclass(frozen=True)
class Message:
    """One thing that the user should know.

    Attributes
    ----------
    text : str
        One sentence without its full stop; it names the pictures where there are several.
    images : tuple of str
        Paths of the pictures that it concerns; empty where it concerns all of them.
    severity : str
        "note": how the result was made. "warning": there is a result, to be looked at. "left out": the one picture
        named is not in the result, for the reason that the text gives. "failure": the result cannot be relied on.
    code : str
        Heading in docs/troubleshooting.md; empty where the text says it all.
    """

    text: str
    images: tuple[str, ...] = ()
    severity: Severity = "warning"
    code: str = ""

    def __str__(self) -> str:
        """The line for standard error."""
        code = f" [{self.code}]" if self.code else ""
        if self.severity == "left out":
            return f"left out {self.images[0]}: {self.text}{code}"
        return f"not reliable: {self.clause}{code}" if self.severity == "failure" else f"{self.clause}{code}"

    @property
    def clause(self) -> str:
        """The text with the picture that it concerns, where it is one."""
        return f"{Path(self.images[0]).name}: {self.text}" if len(self.images) == 1 else self.text


def ignored(message: Message) -> None:
    """Report nothing."""


def left_out(path: str | Path, reason: str) -> Message:
    """A picture that is not in the result."""
    return Message(reason.removeprefix(f"{path}: "), (str(path),), "left out", "left-out")


def of_severity(messages: Iterable[Message], *severities: Severity) -> tuple[Message, ...]:
    """The messages that are so grave, in their order."""
    return tuple(message for message in messages if message.severity in severities)


def names_of(paths: Iterable[str]) -> list[str]:
    """File names without their folders, as messages call pictures."""
    return [Path(path).name for path in paths]


def shortened(names: Sequence[str], most: int = MAX_NAMED) -> str:
    """Names, or the first of them where they are many."""
    return ", ".join(names[:most]) + ", …" * (len(names) > most)
