"""Writing so that a file is there whole or not at all, and checking early that it can be written."""

import json
import os
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from rdstitch.errors import OutputError
from rdstitch.file_access import local_file
from rdstitch.io.deepzoom import check_tiles_folder, tiles_folder
from rdstitch.io.outputs import Outputs, naming

IMAGE_SUFFIXES = (".jpg", ".jpeg", ".png", ".tif", ".tiff", ".webp", ".dzi")


def check_output(
    path: str | Path,
    overwrite: bool = False,
    inputs: Iterable[str | Path] = (),
    suffixes: Iterable[str] = IMAGE_SUFFIXES,
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
    try:
        with naming(file):
            _check_place(file, overwrite, inputs)
    except ValueError as error:
        raise OutputError(f"{file}: cannot be written: {error}") from error
    return file


def check_outputs(paths: Sequence[Path], overwrite: bool, inputs: Iterable[str | Path]) -> None:
    """Find out of many files what :func:`check_output` does of one, in a time linear in their number."""
    check_not_read(paths, inputs)
    for path in paths:
        check_output(path, overwrite)


def _check_place(file: Path, overwrite: bool, inputs: Iterable[str | Path]) -> None:
    """The part of :func:`check_output` that needs the file system."""
    folder = file.parent
    if file.is_dir():
        raise OutputError(f"{file}: is a folder; name a file in it")
    if not folder.is_dir():
        raise OutputError(f"{file}: the folder {folder} does not exist; create it first")
    if file.suffix.lower() == ".dzi":
        check_tiles_folder(tiles_folder(Path(os.path.realpath(file))), overwrite)
    if file.is_symlink() and not file.exists():
        raise OutputError(f"{file}: is a link to nothing; remove it, or choose another name")
    if file.exists():
        check_not_read([file], inputs)
        if not overwrite:
            raise OutputError(f"{file}: exists already; choose another name or use --overwrite")
        # A link stays, and what it leads to is replaced.
        folder = Path(os.path.realpath(file)).parent
    if not os.access(folder, os.W_OK | os.X_OK):
        raise OutputError(f"{file}: no permission to write into the folder {folder}")


def check_not_read(files: Iterable[Path], inputs: Iterable[str | Path]) -> None:
    """Refuse to write over what is read, by whatever name.

    Raises
    ------
    OutputError
        When one of the files is one of the inputs.
    """
    read = {_identity(local_file(Path(path))) for path in inputs} - {None}
    for file in files:
        if _identity(file) in read:
            raise OutputError(f"{file}: is read as input; choose another name")


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


def _identity(file: Path) -> tuple[int, int] | None:
    """The same for all names that lead to one file; None for a missing one."""
    try:
        status = file.stat()
    except (OSError, ValueError):
        return None
    return status.st_dev, status.st_ino


def write_bytes_atomic(path: str | Path, data: bytes, overwrite: bool = True) -> None:
    """Write a file, whole or not at all.

    Raises
    ------
    OutputError
        When the file system refuses.
    """
    with Outputs(overwrite) as outputs:
        outputs.write(path, data)


def text_bytes(text: str) -> bytes:
    """Text in UTF-8; names of files that are none come out as they are."""
    return text.encode("utf-8", "surrogateescape")


def json_bytes(data: Any) -> bytes:
    """JSON in UTF-8 (two spaces, final newline, no NaN).

    The bytes of a file name that are no UTF-8 become JSON's own escapes: the file stays valid, and the name can be
    got back from it.
    """
    text = json.dumps(data, indent=2, ensure_ascii=False, allow_nan=False) + "\n"
    return text.encode("utf-8", "backslashreplace")
