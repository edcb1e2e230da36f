"""Files that change during a run, or whose pixels a decoder has doubts about: noticed once for all who read them."""

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path

from rdstitch.errors import InputError
from rdstitch.io.read import DecodedImage
from rdstitch.results.messages import Message, left_out
from rdstitch.system.file_access import ContentState, content_state

GuardState = tuple[dict[Path, ContentState | None], dict[Path, str]]
"""Stamps of files, and why they may be damaged."""


class InputGuard:
    """Notes on the input files of one run, shared by its sources and by threads; if strict, damage is refused.

    A file is unchanged while its size, and the time of its last change, are.
    """

    def __init__(self, strict: bool = False) -> None:
        self._strict = strict
        self._stamps: dict[Path, ContentState | None] = {}
        self.damaged: dict[Path, str] = {}  # files of which parts may be wrong, and why
        self.unreadable: dict[Path, str] = {}  # files that were left out, and why

    @contextmanager
    def reading(self, path: Path) -> Iterator[None]:
        """Read a file inside the block; it must be what it was before."""
        before = content_state(path)
        self._note(path, before)
        yield
        if content_state(path) != before:
            raise InputError(f"{path}: is being written to; run again when that has ended")

    def _note(self, path: Path, stamp: ContentState | None) -> None:
        if self._stamps.setdefault(path, stamp) != stamp:
            raise InputError(f"{path}: has changed during the run; run again")

    def check(self, path: Path, image: DecodedImage) -> None:
        """Take note of an image that may be damaged, or refuse it."""
        if not image.damage:
            return
        reason = f"is damaged, and parts of it may be wrong ({image.damage}); copy it again from its source"
        if self._strict:
            raise InputError(f"{path}: {reason}")
        self.damaged[path] = reason

    @property
    def messages(self) -> list[Message]:
        """Messages on damaged files."""
        return [Message(self.damaged[path], (str(path),), code="damaged") for path in sorted(self.damaged)]

    @property
    def warnings(self) -> list[Message]:
        """Messages on damaged and unreadable files: these may be why a run failed."""
        return [*(left_out(path, self.unreadable[path]) for path in sorted(self.unreadable)), *self.messages]

    def state_of(self, paths: Iterable[Path]) -> GuardState:
        """Notes on some files, for the guard of another process."""
        known = [path for path in paths if path in self._stamps]
        return (
            {path: self._stamps[path] for path in known},
            {path: self.damaged[path] for path in known if path in self.damaged},
        )

    def merge(self, notes: GuardState) -> None:
        """Take over the notes of a guard in another process, where files must have been the same."""
        stamps, damaged = notes
        for path, stamp in stamps.items():
            self._note(path, stamp)
        self.damaged |= damaged

    def __reduce__(self) -> tuple[type["InputGuard"], tuple[bool]]:
        """Copies and other processes begin anew."""
        return InputGuard, (self._strict,)
