"""Folders that are removed with the process that made them, however that ends."""

import os
import platform
import shutil
import sys
import tempfile
import weakref
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

# On Windows nothing proves a process dead, and its leftovers stay.
if sys.platform != "win32":
    import fcntl

_LOCK = "lock"


class TemporaryFolder:
    """A folder that is removed when it is closed, or nobody refers to it any more, or the process ends.

    That of a process that was killed is removed when the next one is made in its place. Copies in other processes name
    it, but do not own it; back in the process that made it, they are the folder itself.
    """

    def __init__(self, parent: Path | None = None, prefix: str = "rdstitch-") -> None:
        place = Path(parent or tempfile.gettempdir())
        _remove_dead(place, prefix)
        made = Path(tempfile.mkdtemp(prefix=prefix, dir=place))
        try:
            (made / _LOCK).write_text(f"{platform.node()}\n{os.getpid()}\n", encoding="utf-8")
            # Only a folder of this ending is looked at by others, and it says whose it is by then. No file in it is
            # open, or Windows would not rename it.
            self.path = made.rename(f"{made}.part")
        except OSError:
            _remove(made, None)
            raise
        descriptor = _locked(self.path / _LOCK)
        self.close = weakref.finalize(self, _remove, self.path, descriptor)
        _folders[self.path] = self

    def __reduce__(self) -> tuple[Callable[[Path], "TemporaryFolder"], tuple[Path]]:
        return _folder_at, (self.path,)

    def __enter__(self) -> Path:
        return self.path

    def __exit__(self, *failure: object) -> None:
        self.close()


_folders: weakref.WeakValueDictionary[Path, TemporaryFolder] = weakref.WeakValueDictionary()


def _folder_at(path: Path) -> TemporaryFolder:
    if (folder := _folders.get(path)) is None:
        folder = TemporaryFolder.__new__(TemporaryFolder)
        folder.path = path
    return folder


def _remove(folder: Path, descriptor: int | None) -> None:
    if descriptor is not None:
        os.close(descriptor)
    shutil.rmtree(folder, ignore_errors=True)


def _locked(file: Path) -> int | None:
    """A file, open and locked for this process; None where another has locked it, or there are no locks."""
    if sys.platform != "win32":
        with suppress(OSError):
            descriptor = os.open(file, os.O_RDWR | getattr(os, "O_NOFOLLOW", 0))
            try:
                fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except OSError:
                os.close(descriptor)
                raise
            return descriptor
    return None


def _remove_dead(parent: Path, prefix: str) -> None:
    """Remove the folders of processes of this machine that were killed.

    Such a process is there no more and holds no lock. On a mount of another machine locks may hold nothing; and of a
    process in another container with this one's name the number says nothing.
    """
    for folder in parent.glob(f"{prefix}*.part"):
        if (descriptor := _locked(folder / _LOCK)) is None:
            continue
        try:
            host, process = (folder / _LOCK).read_text(encoding="utf-8").splitlines()
            dead = host == platform.node() and not _is_alive(int(process))
        except (OSError, ValueError):
            dead = False
        if dead:
            _remove(folder, descriptor)
        else:
            os.close(descriptor)


def _is_alive(process: int) -> bool:
    """Whether there is a process of this number; not for Windows, where the signal 0 is another one."""
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except (OSError, OverflowError):  # one that may not be asked, or a number that none has
        return True
    return True
