"""Hidden folders for what is not finished yet, each locked by its process, so that those of dead processes can go."""

import os
import shutil
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

# On Windows nothing proves a process dead, and its leftovers stay.
if sys.platform != "win32":
    import fcntl

_LOCK = "lock"


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
        self.path = Path(tempfile.mkdtemp(prefix=prefix, dir=parent))
        self._lock = os.open(self.path / _LOCK, os.O_RDWR | os.O_CREAT, 0o600)
        _lock(self._lock)
        try:
            # Only a folder of this ending is looked at by others, and it has its lock by then.
            self.path = self.path.rename(f"{self.path}.part")
        except OSError:
            self.close()
            raise

    def close(self) -> None:
        """Remove the folder with everything in it."""
        os.close(self._lock)
        shutil.rmtree(self.path, ignore_errors=True)


@contextmanager
def temporary_folder() -> Iterator[Path]:
    """A folder among the system's temporary files that goes with the block, or with the next run after a crash."""
    staging = StagingFolder(Path(tempfile.gettempdir()), prefix="rdstitch-")
    try:
        yield staging.path
    finally:
        staging.close()


def _lock(descriptor: int) -> bool:
    """Lock an open file for this process; False where another has locked it, or there are no locks."""
    with suppress(OSError):
        if sys.platform != "win32":
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            return True
    return False


def _remove_dead(parent: Path, prefix: str) -> None:
    """Remove the folders of processes that hold their locks no more; they were killed."""
    for folder in parent.glob(f"{prefix}*.part"):
        with suppress(OSError):
            descriptor = os.open(folder / _LOCK, os.O_RDWR | getattr(os, "O_NOFOLLOW", 0))
            dead = _lock(descriptor)
            os.close(descriptor)
            if dead:
                shutil.rmtree(folder, ignore_errors=True)
