"""Files that change during a run, or whose pixels a decoder has doubts about: noticed once for all who read them."""

import zlib
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from threading import Lock

from rdstitch.errors import InputError
from rdstitch.file_access import is_url, open_regular, remote_status
from rdstitch.io.read import DecodedImage
from rdstitch.messages import Message

_BLOCK_BYTES = 2**20
_DIGITS = 16

_Stamp = tuple[int, int, int, int]

GuardNotes = tuple[dict[Path, _Stamp | None], dict[Path, int], dict[Path, str]]
"""Stamps and checksums of files, and why they may be damaged."""


class InputGuard:
    """What is known of the input files of one run; shared by its sources, and by threads."""

    def __init__(self, strict: bool = False) -> None:
        self._strict = strict
        self._stamps: dict[Path, _Stamp | None] = {}
        self._checksums: dict[Path, int] = {}
        self._damaged: dict[Path, str] = {}
        self._lock = Lock()

    @contextmanager
    def reading(self, path: Path) -> Iterator[None]:
        """Read a file inside the block; its content must be what it was before."""
        before = _stamp(path)
        yield
        # One after the other: of two that read a file first, both would take it for unknown.
        with self._lock:
            if path not in self._checksums or before != self._stamps[path]:
                checksum = _checksum(path)
                if self._checksums.setdefault(path, checksum) != checksum:
                    raise InputError(f"{path}: its content has changed during the run; run again")
            self._stamps[path] = before
        if _stamp(path) != before:
            raise InputError(f"{path}: is being written to; run again when that has ended")

    def check(self, path: Path, image: DecodedImage) -> None:
        """Take note of an image that may be damaged."""
        if not image.damage:
            return
        reason = f"is damaged, and parts of it may be wrong ({image.damage}); copy it again from its source"
        if self._strict:
            raise InputError(f"{path}: {reason}")
        self._damaged[path] = reason

    @property
    def messages(self) -> list[Message]:
        """What the user should know of the files."""
        return [Message(self._damaged[path], (str(path),), code="damaged") for path in sorted(self._damaged)]

    def notes_on(self, paths: Iterable[Path]) -> GuardNotes:
        """What was noticed of some files, for the guard of another process."""
        known = [path for path in paths if path in self._checksums]
        return (
            {path: self._stamps[path] for path in known},
            {path: self._checksums[path] for path in known},
            {path: self._damaged[path] for path in known if path in self._damaged},
        )

    def learn(self, notes: GuardNotes) -> None:
        """Take over what a guard in another process has noticed."""
        stamps, checksums, damaged = notes
        with self._lock:
            for path, checksum in checksums.items():
                if self._checksums.setdefault(path, checksum) != checksum:
                    raise InputError(f"{path}: its content has changed during the run; run again")
                self._stamps.setdefault(path, stamps[path])
            self._damaged |= damaged

    def __reduce__(self) -> tuple[type["InputGuard"], tuple[bool]]:
        """Copies and other processes begin anew."""
        return InputGuard, (self._strict,)


def _stamp(path: Path) -> _Stamp | None:
    """What changes with every change of a file, and is cheap to see; None where there is none."""
    try:
        if is_url(path):
            return int(remote_status(path)[2][:_DIGITS], 16), 0, 0, 0
        status = path.stat()
    except OSError:
        return None
    return status.st_ino, status.st_size, status.st_mtime_ns, status.st_ctime_ns


def _checksum(path: Path) -> int:
    """CRC-32 of the content: against accidents, not against forgers."""
    value = 0
    try:
        with open_regular(path) as stream:
            while piece := stream.read(_BLOCK_BYTES):
                value = zlib.crc32(piece, value)
    except OSError as error:
        raise InputError(f"{path}: cannot be read any more: {error.strerror}; run again") from error
    return value
