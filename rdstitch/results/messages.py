"""What a user should know of a result, as one type: what it is, which images it concerns, and how grave it is."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

Severity = Literal["detail", "note", "warning", "left out", "failure"]

MAX_NAMED = 3  # images or pairs that one message names


@dataclass(frozen=True)
class Message:
    """One thing that the user should know.

    Attributes
    ----------
    text : str
        One sentence without its full stop; it names the images where there are several.
    images : tuple of str
        Paths of the images that it concerns; empty where it concerns all of them.
    severity : str
        "detail": what only who asks need know. "note": how the result was made. "warning": there is a result, to be
        looked at. "left out": the one image named, or each of several, is not in the result, for the reason that the
        text gives. "failure": the result cannot be relied on.
    code : str
        Heading in docs/troubleshooting.md; empty where the text says it all.
    kind : str
        What is alike of messages on different images; of findings only.
    """

    text: str
    images: tuple[str, ...] = ()
    severity: Severity = "warning"
    code: str = ""
    kind: str = ""

    def __str__(self) -> str:
        """The line for standard error."""
        code = f" [{self.code}]" if self.code else ""
        if self.severity == "left out":
            return f"left out {_listed(self.images)}: {self.text}{code}"
        return f"not reliable: {self.clause}{code}" if self.severity == "failure" else f"{self.clause}{code}"

    @property
    def clause(self) -> str:
        """The text with the image that it concerns, where it is one."""
        return f"{Path(self.images[0]).name}: {self.text}" if len(self.images) == 1 else self.text


def ignored(message: Message) -> None:
    """Report nothing."""


def left_out(path: str | Path, reason: str) -> Message:
    """An image that is not in the result."""
    return Message(reason.removeprefix(f"{path}: "), (str(path),), "left out", "left-out")


def merge_by_reason(messages: Iterable[Message]) -> list[Message]:
    """The same; images left out for the same reason are named in one, each once, which stands where the first did."""
    merged: dict[object, Message] = {}
    for number, message in enumerate(messages):
        key = message.text if message.severity == "left out" else number
        images = (*merged[key].images, *message.images) if key in merged else message.images
        merged[key] = replace(message, images=tuple(dict.fromkeys(images)))
    return list(merged.values())


def of_severity(messages: Iterable[Message], *severities: Severity) -> tuple[Message, ...]:
    """The messages that are so grave, in their order."""
    return tuple(message for message in messages if message.severity in severities)


def names_of(paths: Iterable[str]) -> list[str]:
    """File names without their folders, as messages call images."""
    return [Path(path).name for path in paths]


def bytes_in_words(size: int) -> str:
    """An amount of memory for people."""
    return f"{size / 2**30:.1f} GB" if size >= 2**30 else f"{max(1, round(size / 2**20))} MB"


def seconds_in_words(seconds: float) -> str:
    """A time for people."""
    return f"{seconds / 60:.0f} min" if seconds >= 120 else f"{max(1, round(seconds))} s"


def shortened(names: Sequence[str]) -> str:
    """Names, or the first of them where they are many."""
    return ", ".join(names[:MAX_NAMED]) + ", …" * (len(names) > MAX_NAMED)


def _listed(paths: Sequence[str]) -> str:
    """All of them; the folder is named where it changes."""
    folders = [None, *(Path(path).parent for path in paths)]
    named = zip(paths, names_of(paths), folders[:-1], folders[1:], strict=True)
    return ", ".join(name if folder == before else _within_temporary(path) for path, name, before, folder in named)


def _within_temporary(path: str) -> str:
    """A path; of a frame of a video that was extracted to a folder that nobody finds afterwards, its end."""
    parts = Path(path).parts
    inner = [k for k, part in enumerate(parts) if part.startswith("rdstitch-") and part.endswith(".part")]
    return "/".join(parts[inner[-1] + 2 :] or parts[-1:]) if inner else path
