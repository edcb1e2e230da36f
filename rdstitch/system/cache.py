"""Results on disk: of earlier runs, to continue from, and of this one, so that thousands need not fit into memory.

Every result is a file named by everything that it depends on: the content of the images, the options that matter to
it, the sources of this package, and the versions of the packages that it computes with. So nothing is ever out of date,
whether or not a version number was raised; what is damaged is computed again.
"""

import hashlib
import os
import tempfile
import time
from collections import OrderedDict
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from threading import Lock
from typing import Any, Generic, Self, TypeVar, cast

from rdstitch.errors import InputError, OutputError
from rdstitch.system.file_access import is_url, open_regular, read_limited, remote_status
from rdstitch.system.packing import digest, pack, unpack
from rdstitch.system.temporary_folder import TemporaryFolder

Value = TypeVar("Value")

_FORMAT = 2
_ABANDONED_SECONDS = 3600.0  # since a process last wrote into an unfinished entry; it was killed
_MAX_ENTRY = 2**31  # bytes
_CAPACITY = 16 * 2**20  # bytes of files whose content is kept in memory
_PACKAGE = Path(__file__).parents[1]
_OPENCV = tuple(f"opencv-{kind}" for kind in ("contrib-python-headless", "contrib-python", "python-headless", "python"))
_READERS = ("imagecodecs", "pillow", "pillow-heif", "rawpy", "simplejpeg", "tifffile")
_PACKAGES = ("numpy", "scipy", *_OPENCV, *_READERS)


@dataclass(frozen=True)
class InMemory(Generic[Value]):
    """A result that is not, or could not be, kept on disk."""

    value: Value

    @property
    def key(self) -> Value:
        """What stands for the result in the inputs of later ones."""
        return self.value

    def load(self) -> Value:
        """The result."""
        return self.value

    def remove(self) -> None:
        """There is no file to remove."""


@dataclass(frozen=True)
class OnDisk(Generic[Value]):
    """An entry of a cache; its result is read when it is needed."""

    file: Path
    folder: TemporaryFolder | None = field(default=None, compare=False, repr=False)  # what must not be removed before

    @property
    def key(self) -> str:
        """What stands for the result in the inputs of later ones."""
        return _entry_name(self.file)

    def load(self) -> Value:
        """The result; those used recently are still in memory."""
        return cast(Value, _recent.recall(self.file))

    def remove(self) -> None:
        """Remove its file; it can not be loaded any more then."""
        with suppress(OSError):
            self.file.unlink()
        _recent.forget(self.file)


Stored = InMemory[Value] | OnDisk[Value]


@dataclass(frozen=True)
class Cache:
    """Results on disk; several processes may share one."""

    folder: Path | None = None  # without one nothing is kept, and everything is computed
    temporary: TemporaryFolder | None = None  # where the folder serves this run alone, what removes it

    @classmethod
    def at(cls, folder: Path | None) -> Self:
        """A cache in a folder, if there is one, by its whole name, which holds in processes elsewhere too.

        The folder is made before long work begins.
        """
        if folder is None:
            return cls()
        place = Path(folder).absolute()
        try:
            place.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise OutputError(f"{place}: cannot make the folder of the cache: {error.strerror}") from error
        if not os.access(place, os.W_OK | os.X_OK):
            raise OutputError(f"{place}: no permission to write into the folder of the cache")
        return cls(place)

    @classmethod
    def for_this_run(cls, parent: Path | None = None) -> Self:
        """A cache that goes with this run: it takes what need not be in memory all the time.

        It is made in the folder for temporary files, or in another one. Where nothing can be written, everything stays
        in memory.
        """
        try:
            owner = TemporaryFolder(None if parent is None else Path(parent).absolute())
        except OSError:
            return cls()
        return cls(owner.path, owner)

    def recall(self, stage: str, inputs: tuple[Any, ...], compute: Callable[[], Value]) -> Value:
        """Give what a stage gives for its inputs: from an earlier run, else computed now and kept."""
        return self.recall_many(stage, [inputs], lambda _: [compute()])[0]

    def stored(self, stage: str, inputs: tuple[Any, ...], compute: Callable[[], Value]) -> Stored[Value]:
        """Give what a stage gives for its inputs, which stays on disk until it is loaded; see :meth:`recall`."""
        if self.folder is None:
            return InMemory(compute())
        file = self._file(stage, inputs)
        if _kept(file):
            return OnDisk(file, self.temporary)
        value = compute()
        return OnDisk(file, self.temporary) if self._keep(file, value) else InMemory(value)

    def recall_many(
        self, stage: str, inputs: Sequence[tuple[Any, ...]], compute: Callable[[list[int]], list[Value]]
    ) -> list[Value]:
        """Give what a stage gives for several inputs; ``compute`` gets the places of those without a result."""
        if self.folder is None:
            return compute(list(range(len(inputs))))
        files = [self._file(stage, of_one) for of_one in inputs]
        results: list[list[Value]] = [_kept(file) for file in files]
        missing = [index for index, kept in enumerate(results) if not kept]
        for index, value in zip(missing, compute(missing) if missing else [], strict=True):
            results[index] = [value]
            self._keep(files[index], value)
        return [kept[0] for kept in results]

    def _file(self, stage: str, inputs: tuple[Any, ...]) -> Path:
        """Give where the result of a stage is kept: its name is the digest of everything that it depends on."""
        assert self.folder is not None
        # A run has one software from beginning to end.
        name = digest((_FORMAT, software() if self.temporary is None else {}, stage, inputs))
        return self.folder / stage / name[:2] / name[2:]

    def _keep(self, file: Path, value: Any) -> bool:
        """Write a result, and say whether that was possible: a full or read-only cache is no reason to stop.

        What is of this run alone nobody reads before it is written.
        """
        with suppress(OSError):
            data = pack((_entry_name(file), value))
            if len(data) > _MAX_ENTRY:  # which nobody would read
                return False
            if self.temporary is None:
                _write_at_once(file, data)
            else:
                file.parent.mkdir(parents=True, exist_ok=True)
                file.write_bytes(data)
            return True
        return False

    def file(self, path: str | Path | None) -> str:
        """Give what stands for the content of a file in the inputs of a stage; empty without a file or a cache.

        A file that cannot be read, or of which the server does not say when it changes, is unlike any other, and itself
        the next time: nothing is kept of it.
        """
        if self.folder is None or path is None:
            return ""
        if self.temporary is not None:
            return str(path)
        try:
            if is_url(path):
                return remote_status(path).state or os.urandom(16).hex()
            with open_regular(path) as stream:
                return hashlib.file_digest(stream, "sha256").hexdigest()
        except OSError:
            return os.urandom(16).hex()

    def digest(self, value: Any) -> str:
        """Give what stands for a large value in the inputs of several results; empty without a cache."""
        return "" if self.folder is None else digest(value)


NO_CACHE = Cache()  # keeps nothing


@cache
def software() -> dict[str, str]:
    """Everything but its inputs that a result may depend on: our sources, and versions of what they compute with."""
    from importlib.metadata import PackageNotFoundError, version

    content = hashlib.sha256()
    for source in sorted(_PACKAGE.rglob("*.py")):
        content.update(f"{source.relative_to(_PACKAGE)} {hashlib.sha256(source.read_bytes()).hexdigest()}\n".encode())
    versions = {"rdstitch": content.hexdigest()}
    for package in _PACKAGES:
        with suppress(PackageNotFoundError):
            versions[package] = version(package)
    return versions


class _RecentlyUsed:
    """Values of files, of which the least recently used are dropped when there are too many."""

    def __init__(self, capacity: int) -> None:
        self._free_bytes = capacity
        self._held: OrderedDict[Path, tuple[Any, int]] = OrderedDict()
        self._lock = Lock()

    def recall(self, file: Path) -> Any:
        with self._lock, suppress(KeyError):
            self._held.move_to_end(file)
            return self._held[file][0]
        value, size = _read(file)
        with self._lock:
            if file not in self._held:
                self._held[file] = value, size
                self._free_bytes -= size
            while self._free_bytes < 0 and self._held:
                self._free_bytes += self._held.popitem(last=False)[1][1]
        return value

    def forget(self, file: Path) -> None:
        with self._lock, suppress(KeyError):
            self._free_bytes += self._held.pop(file)[1]


_recent = _RecentlyUsed(_CAPACITY)


def _entry_name(file: Path) -> str:
    """The name of a result, as it is also written into its file: what is mistaken for it is no better than damaged."""
    return file.parent.name + file.name


def _read(file: Path) -> tuple[Any, int]:
    """The result that a file holds, and the file's size, bytes."""
    try:
        data = read_limited(file, _MAX_ENTRY)
        name, value = unpack(data)
    except (InputError, OSError, TypeError, ValueError) as error:
        raise InputError(f"{file}: this entry of the cache vanished or was damaged; run again") from error
    if name != _entry_name(file):
        raise InputError(f"{file}: this entry of the cache was replaced by another; run again")
    return value, len(data)


def _kept(file: Path) -> list[Any]:
    """The result that a file holds; none where it is missing, damaged, or that of another name."""
    with suppress(InputError):
        return [_read(file)[0]]
    return []


def _write_at_once(file: Path, data: bytes) -> None:
    """Write a file, whole or not at all; unlike an output it need not survive a loss of power, since damage is noticed.

    Whoever may read and write in the folder of the cache may read and write the file.
    """
    mode = file.parents[2].stat().st_mode & 0o7777
    for folder in (file.parents[1], file.parent):
        with suppress(FileExistsError):
            folder.mkdir()
            folder.chmod(mode)
    for leftover in file.parent.glob(".*.part"):
        with suppress(OSError):
            if time.time() - leftover.stat().st_mtime > _ABANDONED_SECONDS:
                leftover.unlink()
    handle, name = tempfile.mkstemp(prefix=".", suffix=".part", dir=file.parent)
    temporary = Path(name)
    try:
        with os.fdopen(handle, "wb") as stream:
            stream.write(data)
        temporary.chmod(mode & 0o666)
        temporary.replace(file)
    except BaseException:
        with suppress(OSError):
            temporary.unlink()
        raise
