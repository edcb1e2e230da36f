"""The files of one result: written aside, then published together, so that all are new, or all are as they were.

An image, its tiles, its world file, its pages and its sidecar belong together. Each is written into a hidden folder
beside its place; when all are complete, they take their places one after the other, in the order in which they were
staged. When one of them cannot, those before it go back. A process that is killed within these milliseconds leaves some
old and some new: the sidecar, which is staged last, names size and digest of its image, so that a reader sees it.
"""

import errno
import os
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Self

from rdstitch.errors import OutputError, RdstitchError
from rdstitch.io.deepzoom import holds_only_tiles
from rdstitch.io.staging import StagingFolder
from rdstitch.messages import Message

if sys.platform != "win32":
    import fcntl

_LOCK_SECONDS = 10.0
_NO_LINKS = (errno.EPERM, errno.EOPNOTSUPP, errno.ENOSYS, errno.EMLINK, errno.EXDEV, errno.EACCES)


@dataclass
class _Item:
    """One output: its name as given, its place, where it is staged, and where what it replaced has gone."""

    name: Path
    place: Path
    staged: Path
    is_folder: bool
    backup: Path | None = None


class Outputs:
    """Outputs that are published when the block ends without an error; after an error none is.

    A symbolic link as an output stays; what it leads to is replaced.

    Parameters
    ----------
    overwrite : bool
        Replace what exists. Without it, also a file that appears during the run is kept, and nothing is published.

    Raises
    ------
    OutputError
        For any failure of the file system; what was there before is there again.
    """

    def __init__(self, overwrite: bool) -> None:
        self._overwrite = overwrite
        self._folders: dict[Path, StagingFolder] = {}
        self._items: list[_Item] = []

    def __enter__(self) -> Self:
        """Begin; nothing is made before it is needed."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Publish, or throw away."""
        try:
            if kind is None:
                self._publish()
        finally:
            for folder in self._folders.values():
                folder.close()

    @contextmanager
    def writing(self, path: str | Path) -> Iterator[Path]:
        """Stage a file: yields where to write it; a failure of the file system is one of ``path``."""
        name = Path(path)
        with naming(name):
            item = self._staged(name, is_folder=False)
            yield item.staged
            _sync(item.staged)

    @contextmanager
    def writing_folder(self, path: str | Path) -> Iterator[Path]:
        """Stage a folder of Deep Zoom tiles: yields an empty folder."""
        name = Path(path)
        with naming(name):
            item = self._staged(name, is_folder=True)
            item.staged.mkdir()
            yield item.staged

    def write(self, path: str | Path, data: bytes) -> None:
        """Stage a file with this content."""
        with self.writing(path) as staged:
            staged.write_bytes(data)

    def attempt(self, path: str | Path, stage: Callable[[], None]) -> list[Message]:
        """Stage what belongs beside an image, whose failure must not cost the image: a warning, where it fails."""
        count = len(self._items)
        try:
            stage()
        except Exception as error:  # noqa: BLE001 the work of hours is not thrown away for a page, whatever is wrong
            del self._items[count:]
            text = str(error) if isinstance(error, RdstitchError) else f"{type(error).__name__}: {error}"
            older = "; the file of this name is older" if Path(path).exists() else ""
            return [Message(f"{path}: not written, all else is: {text.removeprefix(f'{path}: ')}{older}")]
        return []

    def staged(self, path: str | Path) -> Path | None:
        """Where an output lies until it is published; None where none of this name is staged."""
        return next((item.staged for item in self._items if item.name == Path(path)), None)

    def _staged(self, name: Path, *, is_folder: bool) -> _Item:
        place = Path(os.path.realpath(name.parent)) / name.name
        if place.is_symlink():
            place = Path(os.path.realpath(place))
        if place.parent not in self._folders:
            self._folders[place.parent] = StagingFolder(place.parent)
        # Tiles are staged just before their description, and are found beside it by its name.
        number = sum(not item.is_folder for item in self._items)
        staged = self._folders[place.parent].path / f"new{number}{'_files' if is_folder else name.suffix}"
        self._items.append(_Item(name, place, staged, is_folder))
        return self._items[-1]

    def _publish(self) -> None:
        """Put everything in its place; go back when that fails."""
        published: list[_Item] = []
        with _locked_folders(list(self._folders)):
            try:
                for item in self._items:
                    published.append(item)
                    with naming(item.name):
                        self._place(item)
                for folder in self._folders if os.name == "posix" else ():
                    with naming(self._items[-1].name):
                        _sync(folder)
            except BaseException:
                self._go_back(published)
                raise

    def _place(self, item: _Item) -> None:
        if item.place.exists() or item.place.is_symlink():
            if not self._overwrite:
                raise OutputError(f"{item.name}: exists already; it has appeared during the run, and is kept")
            self._set_aside(item)
        if item.is_folder:
            item.staged.rename(item.place)
        elif self._overwrite:
            item.staged.replace(item.place)
        else:
            _rename_without_replacing(item)

    def _set_aside(self, item: _Item) -> None:
        """Keep what is replaced until everything is published."""
        backup = item.staged.with_name(f"old{item.staged.name}")
        if item.is_folder:
            item.place.rename(backup)
            item.backup = backup
            if not holds_only_tiles(backup):
                raise OutputError(f"{item.name}: holds other files than Deep Zoom tiles; choose another name")
            return
        item.staged.chmod(item.place.stat().st_mode & 0o777)
        try:
            # Linked rather than renamed: there is a file of this name at every moment.
            os.link(item.place, backup)
        except OSError as error:
            if error.errno not in _NO_LINKS:
                raise
            item.place.rename(backup)
        item.backup = backup

    def _go_back(self, published: list[_Item]) -> None:
        kept: list[_Item] = []
        for item in reversed(published):
            try:
                _restore(item)
            except OSError:
                if item.backup is not None:
                    kept.append(item)
        for item in kept:
            if folder := self._folders.pop(item.place.parent, None):
                folder.abandon()
        if kept:
            raise OutputError(
                "; ".join(f"{item.name}: cannot be put back, the old one is {item.backup}" for item in kept)
            )


def _restore(item: _Item) -> None:
    """Undo :meth:`Outputs._place`, however far it came."""
    ours = not item.staged.exists() or (not item.is_folder and _is_same(item.staged, item.place))
    if ours and item.is_folder:
        item.place.rename(item.staged)
    if item.backup is not None:
        item.backup.replace(item.place) if not item.is_folder else item.backup.rename(item.place)
    elif ours and not item.is_folder:
        item.place.unlink()


def _rename_without_replacing(item: _Item) -> None:
    """Publish a file in a place that nothing may have taken meanwhile."""
    try:
        os.link(item.staged, item.place)
    except FileExistsError:
        raise OutputError(f"{item.name}: exists already; it has appeared during the run, and is kept") from None
    except OSError as error:
        if error.errno not in _NO_LINKS:
            raise
        # No links here: whoever makes the empty file owns the name.
        os.close(os.open(item.place, os.O_CREAT | os.O_EXCL | os.O_WRONLY))
        try:
            item.staged.replace(item.place)
        except BaseException:
            item.place.unlink()
            raise


@contextmanager
def _locked_folders(folders: list[Path]) -> Iterator[None]:
    """Let one process at a time publish in these folders, where the system has locks."""
    descriptors: list[int] = []
    try:
        for folder in sorted(folders) if sys.platform != "win32" else []:
            with suppress(OSError):
                descriptors.append(os.open(folder, os.O_RDONLY))
                _wait_for_lock(descriptors[-1])
        yield
    finally:
        for descriptor in descriptors:
            os.close(descriptor)


def _wait_for_lock(descriptor: int) -> None:
    """Wait while another process publishes; not for ever, since others may use such locks for something else."""
    end = time.monotonic() + _LOCK_SECONDS
    while sys.platform != "win32" and time.monotonic() < end:
        with suppress(BlockingIOError):
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            return
        time.sleep(0.01)


@contextmanager
def naming(name: Path) -> Iterator[None]:
    """A failure of the file system is one of writing this output."""
    try:
        yield
    except OSError as error:
        raise OutputError(f"{name}: cannot be written: {error.strerror or error}") from error


def _is_same(first: Path, second: Path) -> bool:
    try:
        return first.samefile(second)
    except OSError:
        return False


def _sync(path: Path) -> None:
    """Wait until the disk has a file or folder: a full disk must be noticed before anything is replaced."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
