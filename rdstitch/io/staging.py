"""Hidden folders for what is not finished yet, each locked by its process, so that those of dead processes can go."""

import os
import shutil
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from rdstitch.io.fingerprint import publish_sidecars

# On Windows nothing proves a process dead, and its leftovers stay.
if sys.platform != "win32":
    import fcntl

_LOCK = "lock"
_MAX_ATTEMPTS = 10
_UNLOCKED_SECONDS = 60.0  # after which a file that nobody has locked is not one that somebody has just made


class StagingFolder:
    """A hidden folder that exists until it is closed, or until a later one in its place finds its process dead.

    Parameters
    ----------
    parent : Path
        Where it is made. Renaming from it into ``parent`` stays within one file system.
    prefix : str
        Of its name.

    Raises
    ------
    OSError
        When it cannot be made.
    """

    def __init__(self, parent: Path, prefix: str = ".rdstitch-") -> None:
        _remove_dead(parent, prefix)
        for _ in range(_MAX_ATTEMPTS):
            self.path = Path(tempfile.mkdtemp(prefix=prefix, suffix=".part", dir=parent))
            self._lock = _locked(self.path / _LOCK, create=True)
            if self._lock is not None:
                return
        raise OSError(f"cannot lock a file in {parent}")

    def close(self) -> None:
        """Remove the folder with everything in it."""
        shutil.rmtree(self.path, ignore_errors=True)
        self.abandon()

    def abandon(self) -> None:
        """Leave the folder where it is, for a person to look into."""
        with suppress(OSError):
            (self.path / _LOCK).unlink()
        if self._lock is not None:
            os.close(self._lock)
            self._lock = None


@contextmanager
def temporary_folder() -> Iterator[Path]:
    """A folder among the system's temporary files that goes with the block, or with the next run after a crash."""
    staging = StagingFolder(Path(tempfile.gettempdir()), prefix="rdstitch-")
    try:
        yield staging.path
    finally:
        staging.close()


def lock(descriptor: int) -> None:
    """Lock an open file for this process, where the system has locks; it goes with the descriptor."""
    if sys.platform != "win32":
        with suppress(OSError):
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)


def remove_dead_files(folder: Path) -> None:
    """Remove the hidden, unfinished files of processes that were killed while they wrote them and held :func:`lock`."""
    for file in folder.glob(".*.part") if sys.platform != "win32" else ():
        with suppress(OSError):
            if time.time() - file.stat().st_mtime > _UNLOCKED_SECONDS:
                descriptor = _locked(file, create=False)
                if descriptor is not None:
                    file.unlink()
                    os.close(descriptor)


def _locked(file: Path, *, create: bool) -> int | None:
    """Descriptor of a file that this process has locked; None where another has, or has removed it meanwhile."""
    try:
        descriptor = os.open(file, os.O_RDWR | (os.O_CREAT if create else 0) | getattr(os, "O_NOFOLLOW", 0), 0o600)
    except FileNotFoundError:
        return None
    try:
        if sys.platform != "win32":
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        if os.fstat(descriptor).st_nlink:
            return descriptor
    except BlockingIOError:
        pass
    except OSError:
        # A file system without locks: the folder can be used, and nobody will ever take it for dead.
        if create:
            return descriptor
    os.close(descriptor)
    return None


def _remove_dead(parent: Path, prefix: str) -> None:
    """Remove the folders of processes that hold their locks no more; they were killed."""
    for folder in parent.glob(f"{prefix}*.part") if sys.platform != "win32" else ():
        with suppress(OSError):
            descriptor = _locked(folder / _LOCK, create=False)
            if descriptor is not None:
                publish_sidecars(folder)
                shutil.rmtree(folder, ignore_errors=True)
                os.close(descriptor)
