"""Results that lie on disk until they are needed, so that thousands of them need not fit into memory."""

import tempfile
import weakref
from collections import OrderedDict
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from threading import Lock
from typing import Any, Generic, TypeVar, cast

from rdstitch.errors import InputError
from rdstitch.file_access import read_limited
from rdstitch.io.packing import unpack
from rdstitch.outputs import StagingFolder

Value = TypeVar("Value")

_MAX_ENTRY = 2**31  # bytes
_CAPACITY = 16 * 2**20  # bytes of files whose content is kept in memory


class TemporaryFolder:
    """A folder that is removed when nobody refers to it any more, and at the end of the process at the latest.

    Copies in other processes name it, but do not own it; back in the process that made it, they are the folder itself.
    """

    def __init__(self, path: Path | None = None, *, parent: Path | None = None) -> None:
        if path is not None:
            self.path = path
            return
        # Locked by this process: the next run removes it where this one is killed.
        folder = StagingFolder(Path(parent or tempfile.gettempdir()), prefix="rdstitch-")
        self.path = folder.path
        _own[self.path] = self
        weakref.finalize(self, folder.close)

    def __reduce__(self) -> tuple[Callable[[Path], "TemporaryFolder"], tuple[Path]]:
        """See the class."""
        return _folder, (self.path,)


_own: weakref.WeakValueDictionary[Path, TemporaryFolder] = weakref.WeakValueDictionary()


def _folder(path: Path) -> TemporaryFolder:
    return _own.get(path) or TemporaryFolder(path)


@dataclass(frozen=True)
class Stored(Generic[Value]):
    """A result that is read when it is needed; one that could not be kept on disk stays in memory."""

    file: Path | None = None  # entry of a cache
    value: Value | None = None  # the result itself, without a file
    folder: TemporaryFolder | None = field(default=None, compare=False, repr=False)  # what must not be removed before

    def load(self) -> Value:
        """The result; those used recently are still in memory."""
        if self.file is None:
            return cast(Value, self.value)
        return cast(Value, _recent.recall(self.file))

    @property
    def name(self) -> str:
        """What stands for the result in the inputs of later ones; empty without a file."""
        return "" if self.file is None else entry_name(self.file)

    def remove(self) -> None:
        """Remove its file; it can not be loaded any more then."""
        if self.file is not None:
            with suppress(OSError):
                self.file.unlink()


def entry_name(file: Path) -> str:
    """The name of a result, as it is also written into its file: what is mistaken for it is no better than damaged."""
    return file.parent.name + file.name


def read_entry(file: Path) -> tuple[Any, int]:
    """The result that a file holds, and the file's size, bytes."""
    try:
        data = read_limited(file, _MAX_ENTRY)
        name, value = unpack(data)
    except (InputError, OSError, TypeError, ValueError) as error:
        raise InputError(f"{file}: this entry of the cache vanished or was damaged; run again") from error
    if name != entry_name(file):
        raise InputError(f"{file}: this entry of the cache was replaced by another; run again")
    return value, len(data)


class _RecentlyUsed:
    """Values of files, of which the least recently used are dropped when there are too many."""

    def __init__(self, room: int) -> None:
        self._room = room
        self._held: OrderedDict[Path, tuple[Any, int]] = OrderedDict()
        self._lock = Lock()

    def recall(self, file: Path) -> Any:
        with self._lock, suppress(KeyError):
            self._held.move_to_end(file)
            return self._held[file][0]
        value, size = read_entry(file)
        with self._lock:
            if file not in self._held:
                self._held[file] = value, size
                self._room -= size
            while self._room < 0 and self._held:
                self._room += self._held.popitem(last=False)[1][1]
        return value


_recent = _RecentlyUsed(_CAPACITY)
