"""Writing so that a file is there whole or not at all, and checking early that it can be written."""

import json
import os
import tempfile
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from rdstitch.errors import OutputError
from rdstitch.io.deepzoom import check_tiles_folder

PICTURE_SUFFIXES = (".jpg", ".jpeg", ".png", ".tif", ".tiff", ".webp", ".dzi")


def check_output(
    path: str | Path,
    overwrite: bool = False,
    inputs: Iterable[str | Path] = (),
    suffixes: Iterable[str] = PICTURE_SUFFIXES,
) -> Path:
    """Find out before long work whether a file can be written; nothing is created.

    Parameters
    ----------
    path
        File to be written later.
    overwrite
        Whether an existing file may be replaced.
    inputs
        Files that must never be written over, whatever ``overwrite`` says.
    suffixes
        Known file name endings, lower case; empty for any.

    Raises
    ------
    OutputError
        With what to do about it.
    """
    file, known = Path(path), tuple(suffixes)
    if known and file.suffix.lower() not in known:
        what = f"unknown file type '{file.suffix}'" if file.suffix else "no file type in the name"
        raise OutputError(f"{file}: {what}; use one of {' '.join(known)}")
    folder = file.parent
    try:
        if file.is_dir():
            raise OutputError(f"{file}: is a folder; name a file in it")
        if not folder.is_dir():
            raise OutputError(f"{file}: the folder {folder} does not exist; create it first")
        if file.suffix.lower() == ".dzi":
            check_tiles_folder(file, overwrite)
        if file.exists():
            if any(_same_file(file, Path(other)) for other in inputs):
                raise OutputError(f"{file}: is one of the input pictures; choose another name")
            if not overwrite:
                raise OutputError(f"{file}: exists already; choose another name or use --overwrite")
    except (OSError, ValueError) as error:
        raise _output_error(file, error) from error
    if not os.access(folder, os.W_OK | os.X_OK):
        raise OutputError(f"{file}: no permission to write into the folder {folder}")
    return file


def check_distinct(paths: Iterable[str | Path]) -> None:
    """Find out before long work whether two outputs would be written into one file.

    Raises
    ------
    OutputError
        When two of the names lead to the same place.
    """
    seen: set[tuple[str, str]] = set()
    for file in map(Path, paths):
        place = os.path.realpath(file.parent), file.name
        if place in seen:
            raise OutputError(f"{file}: is the name of two outputs; choose another one for each")
        seen.add(place)


def _same_file(first: Path, second: Path) -> bool:
    """Whether two names lead to the same file; a missing file is the same as none."""
    try:
        return first.samefile(second)
    except (OSError, ValueError):
        return False


def _output_error(file: Path, error: BaseException) -> OutputError:
    """One line for a failed write."""
    return OutputError(f"{file}: cannot be written: {getattr(error, 'strerror', None) or error}")


@contextmanager
def atomic_output(path: str | Path) -> Iterator[Path]:
    """A temporary file beside ``path`` that takes its place when the block ends without an error.

    Yields the temporary name. It lies in the same folder, so that the last step is one rename: a reader sees the old
    file or the new one, also after a crash.

    Raises
    ------
    OutputError
        For any failure of the file system, a full disk among them; the temporary file is removed.
    """
    file = Path(path)
    temporary = None
    try:
        handle, name = tempfile.mkstemp(prefix=f".{file.name[:100]}.", suffix=f".part{file.suffix}", dir=file.parent)
        os.close(handle)
        temporary = Path(name)
        yield temporary
        _keep_mode(temporary, file)
        _sync(temporary)
        temporary.replace(file)
        temporary = None
    except OSError as error:
        raise _output_error(file, error) from error
    finally:
        if temporary is not None:
            with suppress(OSError):
                temporary.unlink()


def _keep_mode(temporary: Path, file: Path) -> None:
    """Give the file the mode of the one it replaces, else what the umask allows (mkstemp says 0600)."""
    if file.exists():
        temporary.chmod(file.stat().st_mode & 0o777)
        return
    mask = os.umask(0)
    os.umask(mask)
    temporary.chmod(0o666 & ~mask)


def _sync(file: Path) -> None:
    """Wait until the disk has the file: a full disk must be noticed before the old file is replaced."""
    with file.open("rb") as stream:
        os.fsync(stream.fileno())


def write_bytes_atomic(path: str | Path, data: bytes) -> None:
    """Write a file, whole or not at all.

    Raises
    ------
    OutputError
        When the file system refuses.
    """
    with atomic_output(path) as temporary:
        temporary.write_bytes(data)


def write_text_atomic(path: str | Path, text: str) -> None:
    """Write a UTF-8 text file, whole or not at all; see :func:`write_bytes_atomic`."""
    write_bytes_atomic(path, text.encode("utf-8", "surrogateescape"))


def write_json_atomic(path: str | Path, data: Any) -> None:
    """Write JSON, whole or not at all; see :func:`json_bytes` and :func:`write_bytes_atomic`."""
    write_bytes_atomic(path, json_bytes(data))


def json_bytes(data: Any) -> bytes:
    """JSON in UTF-8 (two spaces, final newline, no NaN).

    The bytes of a file name that are no UTF-8 become JSON's own escapes: the file stays valid, and the name can be
    got back from it.
    """
    text = json.dumps(data, indent=2, ensure_ascii=False, allow_nan=False) + "\n"
    return text.encode("utf-8", "backslashreplace")
