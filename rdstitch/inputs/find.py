"""What the user names as input: folders, files, patterns, lists, videos; in the end a list of frames."""

import glob
import json
import os
import re
from collections.abc import Iterable, Iterator
from pathlib import Path

from rdstitch.errors import InputError
from rdstitch.inputs.frame import Frame, Named
from rdstitch.io.decoding import FOREIGN_SUFFIXES
from rdstitch.io.video import VIDEO_SUFFIXES, extract_frames
from rdstitch.records import read_text

PICTURE_SUFFIXES = frozenset(
    (".jpg", ".jpeg", ".png", ".tif", ".tiff", ".webp", ".bmp", ".jp2", ".ppm", ".pgm", ".pnm", ".gif")
)
"""What counts as a picture in a folder; a file that is named is tried whatever it is called."""


def find_pictures(
    arguments: Iterable[Named],
    *,
    exclude: Iterable[str | Path] = (),
    frames_folder: Path | None = None,
    every: int = 1,
) -> list[Frame]:
    """The frames that the arguments stand for, in natural order within a folder or pattern.

    Parameters
    ----------
    arguments : iterable of path or Frame
        Each a picture file, a folder, a pattern (``*``, ``?``, ``[...]``), ``@FILE`` with one argument a line or
        separated by NUL, a video file, or a frame, which stays as it is.
    exclude : iterable of path
        Files that are no input, such as the output, where they come from a folder or pattern or are rdstitch's own
        work. Any other picture that is named stays: its user must hear that it would be written over. Pictures in
        folders and patterns beside which rdstitch wrote a sidecar are its own work and left out too.
    frames_folder : Path, optional
        Where frames of videos are written, losslessly; without it a video is refused.
    every : int
        Use every n-th video frame.

    Raises
    ------
    InputError
        When an argument names nothing.
    """
    unwanted = {_entry(Path(path)) for path in exclude}
    return [
        frame
        for frame, named in _expand(arguments, frames_folder, every)
        if _entry(frame.path) not in unwanted or (named and not _is_rdstitch_output(frame.path))
    ]


def _entry(path: Path) -> Path:
    """Where a name stands, links to folders followed but the last link not."""
    # Path.resolve would stumble over links in a circle.
    return Path(os.path.realpath(path.parent)) / path.name


def natural_key(path: Path) -> list[tuple[int, str | int]]:
    """Sorting key by which ``frame10`` comes after ``frame9``."""
    return [(0, int(part)) if part.isdecimal() else (1, part) for part in re.split(r"(\d+)", str(path)) if part]


def _expand(
    arguments: Iterable[Named], frames_folder: Path | None, every: int, lists: tuple[Path, ...] = ()
) -> Iterator[tuple[Frame, bool]]:
    """Every frame, and whether it was named one by one; ``lists`` are those that the arguments come from."""
    for argument in arguments:
        if isinstance(argument, Frame):
            yield argument, True
            continue
        path, text = Path(argument), str(argument)
        if not _exists(path):
            if text.startswith("@"):
                file = Path(text[1:])
                if file in lists:
                    raise InputError(f"{file}: the list of pictures names itself")
                yield from _expand(names_in(read_text(file)), frames_folder, every, (*lists, file))
            elif glob.has_magic(text):
                yield from ((Frame(found), False) for found in _matching(text))
            else:
                yield Frame(path), True
        elif path.is_dir():
            yield from ((Frame(found), False) for found in _in_folder(path))
        elif path.suffix.lower() in VIDEO_SUFFIXES:
            if frames_folder is None:
                raise InputError(f"{path}: a video is no picture here; use 'rdstitch mosaic' or extract its frames")
            yield from ((Frame(*frame), True) for frame in extract_frames(path, frames_folder, every))
        else:
            yield Frame(path), True


def _exists(path: Path) -> bool:
    """Whether there is a file; who reads it will say why one cannot be looked for."""
    try:
        return path.exists()
    except OSError:
        return False


def names_in(text: str) -> list[str]:
    """The names in a list: separated by NUL, if there is one, else one a line."""
    names = text.split("\0") if "\0" in text else re.split(r"\r?\n", text)
    return [name for name in names if name]


def _in_folder(folder: Path) -> list[Path]:
    """The pictures of a folder, and those that nobody here can read: who reads them will say so."""
    try:
        entries = [path for path in folder.iterdir() if not path.name.startswith(".")]
    except OSError as error:
        raise InputError(f"{folder}: cannot read the folder: {error.strerror}") from error
    found = [path for path in entries if path.suffix.lower() in PICTURE_SUFFIXES and not _is_rdstitch_output(path)]
    # Many cameras write a raw file beside each picture.
    stems = {path.stem for path in found}
    found += [path for path in entries if path.suffix.lower() in FOREIGN_SUFFIXES and path.stem not in stems]
    if not found:
        raise InputError(f"{folder}: there are no pictures in this folder")
    return sorted(found, key=natural_key)


def _matching(pattern: str) -> list[Path]:
    matching = map(Path, glob.glob(pattern))  # noqa: PTH207 - a pattern may be absolute
    found = [path for path in matching if path.is_file() and not _is_rdstitch_output(path)]
    if not found:
        raise InputError(f"{pattern}: no file matches this pattern")
    return sorted(found, key=natural_key)


def _is_rdstitch_output(path: Path) -> bool:
    """Whether rdstitch made this picture: the sidecar beside it says so."""
    sidecar = path.with_name(path.name + ".json")
    try:
        with sidecar.open(encoding="utf-8") as stream:
            return bool(json.loads(stream.read()).get("format") == "rdstitch sidecar")
    except (OSError, ValueError, AttributeError, RecursionError):
        return False
