"""Whether outputs can be written, found out before long work: nothing is created here."""

import os
import re
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path

from rdstitch.errors import OutputError
from rdstitch.system.file_access import local_file

WRITABLE_SUFFIXES = (".jpg", ".jpeg", ".png", ".tif", ".tiff", ".webp", ".dzi", ".zarr")
_LEVEL_NAME, _TILE_NAME = re.compile(r"[0-9]{1,2}"), re.compile(r"[0-9]+_[0-9]+\.jpg")


def check_suffix(path: str | Path, suffixes: Iterable[str] = WRITABLE_SUFFIXES) -> Path:
    """Refuse an output whose name does not say what it shall be; without suffixes any name will do."""
    file, known = Path(path), tuple(suffixes)
    if known and file.suffix.lower() not in known:
        what = f"unknown file type '{file.suffix}'" if file.suffix else "no file type in the name"
        raise OutputError(f"{file}: {what}; use one of {' '.join(known)}")
    return file


def check_outputs(paths: Sequence[Path], overwrite: bool, inputs: Iterable[str | Path] = ()) -> None:
    """Find out before long work whether all outputs of a run can be written: each once, and over none of the inputs."""
    seen: set[tuple[str, str]] = set()
    for file in paths:
        place = os.path.realpath(file.parent), file.name
        if place in seen:
            raise OutputError(f"{file}: is the name of two outputs; choose another one for each")
        seen.add(place)
    check_not_read(paths, inputs)
    for file in paths:
        try:
            with naming(file):
                _check_place(file, overwrite)
        except ValueError as error:
            raise OutputError(f"{file}: cannot be written: {error}") from error


def _check_place(file: Path, overwrite: bool) -> None:
    """What the file system says of one output."""
    folder = file.parent
    if is_zarr(file):
        check_folder(file, overwrite)
    elif file.is_dir():
        raise OutputError(f"{file}: is a folder; choose another name")
    if not folder.is_dir():
        raise OutputError(f"{file}: the folder {folder} does not exist; create it first")
    if file.suffix.lower() == ".dzi":
        check_folder(tiles_folder(Path(os.path.realpath(file))), overwrite)
    if file.is_symlink() and not file.exists():
        raise OutputError(f"{file}: is a link to nothing; remove it, or choose another name")
    if file.exists() and not is_zarr(file):
        if not overwrite:
            raise OutputError(f"{file}: exists already; choose another name or use --overwrite")
        # A link stays, and what it leads to is replaced.
        folder = Path(os.path.realpath(file)).parent
    if not os.access(folder, os.W_OK | os.X_OK):
        raise OutputError(f"{file}: no permission to write into the folder {folder}")


def check_not_read(files: Iterable[Path], inputs: Iterable[str | Path]) -> None:
    """Refuse to write over what is read, by whatever name."""
    read = {_identity(local_file(Path(path))) for path in inputs} - {None}
    for file in files:
        if _identity(file) in read:
            raise OutputError(f"{file}: is read as input; choose another name")


def _identity(file: Path) -> tuple[int, int] | None:
    """The same for all names that lead to one file; None for a missing one."""
    with suppress(OSError, ValueError):
        status = file.stat()
        return status.st_dev, status.st_ino
    return None


def tiles_folder(path: Path) -> Path:
    """The folder of the tiles that belong to a ``.dzi`` file."""
    return path.with_name(f"{path.stem}_files")


def check_folder(folder: Path, overwrite: bool) -> None:
    """Refuse to replace a folder that is to be kept, or that holds anything but Deep Zoom tiles, or an OME-Zarr image.

    The latter's name says so.
    """
    if not folder.exists():
        return
    if not overwrite:
        raise OutputError(f"{folder}: exists already; choose another name or use --overwrite")
    chunks = is_zarr(folder)
    holds_only, what = (_holds_only_chunks, "an OME-Zarr image") if chunks else (holds_only_tiles, "Deep Zoom tiles")
    if folder.is_symlink() or not folder.is_dir() or not holds_only(folder):
        raise OutputError(f"{folder}: is a link, or holds other files than {what}; choose another name")


def is_zarr(path: str | Path) -> bool:
    """Whether an image is a folder of chunks."""
    return Path(path).suffix.lower() == ".zarr"


def _holds_only_chunks(folder: Path) -> bool:
    """Check whether a folder holds what :func:`write_ome_zarr` writes at its top: levels by number, and .z files."""
    return all(item.name.startswith(".z") or (item.name.isdecimal() and item.is_dir()) for item in folder.iterdir())


def holds_only_tiles(folder: Path) -> bool:
    """Check whether everything in a folder, however deep, is what :func:`write_deep_zoom` writes there."""
    with os.scandir(folder) as levels:
        for level in levels:
            if not _LEVEL_NAME.fullmatch(level.name) or not level.is_dir(follow_symlinks=False):
                return False
            with os.scandir(level) as tiles:
                if not all(_TILE_NAME.fullmatch(tile.name) and tile.is_file(follow_symlinks=False) for tile in tiles):
                    return False
    return True


@contextmanager
def naming(name: Path) -> Iterator[None]:
    """Turn failures of the file system into those of writing this output."""
    try:
        yield
    except OSError as error:
        raise OutputError(f"{name}: cannot be written: {error.strerror or error}") from error
