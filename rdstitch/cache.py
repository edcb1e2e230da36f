"""Results of earlier runs, so that an interrupted run continues and a changed option repeats only what depends on it.

Every result is a file named by everything that it depends on: the content of the images, the options that matter to
it, the sources of this package, and the versions of the packages that it computes with. So nothing is ever out of date,
whether or not a version number was raised; what is damaged is computed again.
"""

import hashlib
import os
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from importlib.resources.abc import Traversable
from pathlib import Path
from typing import Any, Self, TypeVar

from rdstitch.errors import InputError, OutputError
from rdstitch.file_access import is_url, open_regular, remote_status
from rdstitch.io.packing import digest, pack
from rdstitch.stored import Stored, TemporaryFolder, entry_name, read_entry

Value = TypeVar("Value")

_FORMAT = 2
_ABANDONED_SECONDS = 3600.0  # since a process last wrote into an unfinished entry; it was killed
_OPENCV = tuple(f"opencv-{kind}" for kind in ("contrib-python-headless", "contrib-python", "python-headless", "python"))
_PACKAGES = ("numpy", "scipy", *_OPENCV, "pillow", "simplejpeg", "tifffile")


@dataclass(frozen=True)
class Cache:
    """Results on disk; several processes may share one."""

    folder: Path | None = None  # without one nothing is kept, and everything is computed
    temporary: TemporaryFolder | None = None  # where the folder serves this run alone, what removes it

    @classmethod
    def at(cls, folder: Path | None) -> Self:
        """A cache in a folder, if there is one, by its whole name, which holds in processes elsewhere too."""
        return cls(None if folder is None else Path(folder).absolute())

    @classmethod
    def for_this_run(cls, parent: Path | None = None) -> Self:
        """A cache that goes with this run: it takes what need not be in memory all the time.

        It is made in the folder for temporary files, or in another one. Where nothing can be written, everything stays
        in memory.
        """
        try:
            owner = TemporaryFolder(parent=None if parent is None else Path(parent).absolute())
        except OSError:
            return cls()
        return cls(owner.path, owner)

    def __post_init__(self) -> None:
        """Make the folder before long work begins."""
        if self.folder is None:
            return
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise OutputError(f"{self.folder}: cannot make the folder of the cache: {error.strerror}") from error
        if not os.access(self.folder, os.W_OK | os.X_OK):
            raise OutputError(f"{self.folder}: no permission to write into the folder of the cache")

    def recall(self, stage: str, inputs: tuple[Any, ...], compute: Callable[[], Value]) -> Value:
        """What a stage gives for its inputs: from an earlier run, else computed now and kept."""
        return self.recall_many(stage, [inputs], lambda _: [compute()])[0]

    def stored(self, stage: str, inputs: tuple[Any, ...], compute: Callable[[], Value]) -> Stored[Value]:
        """As :meth:`recall`, but the result stays on disk until it is loaded."""
        if self.folder is None:
            return Stored(value=compute())
        file = self._file(stage, inputs)
        if _read(file):
            return Stored(file, folder=self.temporary)
        value = compute()
        return Stored(file, folder=self.temporary) if self._keep(file, value) else Stored(value=value)

    def recall_many(
        self, stage: str, inputs: Sequence[tuple[Any, ...]], compute: Callable[[list[int]], list[Value]]
    ) -> list[Value]:
        """As :meth:`recall`, of several; ``compute`` is called with the places of the inputs without a result."""
        if self.folder is None:
            return compute(list(range(len(inputs))))
        files = [self._file(stage, own) for own in inputs]
        found: list[list[Value]] = [_read(file) for file in files]
        missing = [index for index, kept in enumerate(found) if not kept]
        for index, value in zip(missing, compute(missing) if missing else [], strict=True):
            found[index] = [value]
            self._keep(files[index], value)
        return [kept[0] for kept in found]

    def _file(self, stage: str, inputs: tuple[Any, ...]) -> Path:
        """Where the result of a stage is kept: its name is the digest of everything that it depends on."""
        assert self.folder is not None
        # A run has one software from beginning to end.
        name = digest((_FORMAT, software() if self.temporary is None else {}, stage, inputs))
        return self.folder / stage / name[:2] / name[2:]

    def _keep(self, file: Path, value: Any) -> bool:
        """Write a result, and whether that was possible: a full or read-only cache is no reason to stop.

        What is of this run alone nobody reads before it is written.
        """
        with suppress(OSError):
            data = pack((entry_name(file), value))
            if self.temporary is None:
                _write_at_once(file, data)
            else:
                file.parent.mkdir(parents=True, exist_ok=True)
                file.write_bytes(data)
            return True
        return False

    def file(self, path: str | Path | None) -> str:
        """What stands for the content of a file in the inputs of a stage; empty without a file or a cache.

        A file that cannot be read is unlike any other, and itself the next time: nothing is kept of it.
        """
        if self.folder is None or path is None:
            return ""
        if self.temporary is not None:
            return str(path)
        try:
            if is_url(path):
                return remote_status(path)[2]
            with open_regular(path) as stream:
                return hashlib.file_digest(stream, "sha256").hexdigest()
        except OSError:
            return os.urandom(16).hex()

    def digest(self, value: Any) -> str:
        """What stands for a large value in the inputs of several results; empty without a cache."""
        return "" if self.folder is None else digest(value)


@cache
def software() -> dict[str, str]:
    """Everything but its inputs that a result may depend on: our sources, and versions of what they compute with."""
    from importlib.metadata import PackageNotFoundError, version

    found = {"rdstitch": sources_digest(files("rdstitch"))}
    for package in _PACKAGES:
        with suppress(PackageNotFoundError):
            found[package] = version(package)
    return found


def sources_digest(folder: Traversable) -> str:
    """What stands for the names and contents of all Python files in a folder and those below it."""
    content = hashlib.sha256()
    for name, source in sorted(_sources(folder, "")):
        content.update(f"{name} {hashlib.sha256(source).hexdigest()}\n".encode())
    return content.hexdigest()


def _sources(folder: Traversable, prefix: str) -> Iterator[tuple[str, bytes]]:
    for entry in folder.iterdir():
        if entry.is_dir():
            yield from _sources(entry, f"{prefix}{entry.name}/")
        elif entry.name.endswith(".py"):
            yield prefix + entry.name, entry.read_bytes()


def _read(file: Path) -> list[Any]:
    """The result that a file holds; none where it is missing, damaged, or that of another name."""
    with suppress(InputError, OSError):
        return [read_entry(file)[0]]
    return []


NO_CACHE = Cache()
"""Keeps nothing."""


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
