"""The images of a folder: which files count, in what order, and which of them rdstitch wrote."""

import json
import os
import re
from pathlib import Path

from rdstitch.errors import InputError
from rdstitch.io.opening import HEIF_SUFFIXES, RAW_SUFFIXES
from rdstitch.system.file_access import MAX_TEXT, canonical_name, canonical_text, read_limited

READABLE_SUFFIXES = frozenset(
    [".jpg", ".jpeg", ".png", ".tif", ".tiff", ".webp", ".avif", ".bmp", ".tga", ".jp2", ".ppm", ".pgm", ".pnm", ".gif"]
)
"""What counts as an image in a folder; a file that is named is tried whatever it is called."""


def images_in(folder: Path) -> list[Path]:
    """The images of a folder in natural order, and those that nobody here can read: who reads them will say so."""
    try:
        entries = [path for path in folder.iterdir() if not path.name.startswith(".")]
    except OSError as error:
        raise InputError(f"{folder}: cannot read the folder: {error.strerror}") from error
    images = [path for path in entries if path.suffix.lower() in READABLE_SUFFIXES]
    # Many cameras write a raw file beside each image, and phones that export JPEG leave the HEIC there.
    stems = {path.stem.casefold() for path in images}
    images += [path for path in entries if is_raw_or_heif(path) and path.stem.casefold() not in stems]
    return sorted(images, key=natural_key)


def is_raw_or_heif(path: Path) -> bool:
    return path.suffix.lower() in HEIF_SUFFIXES | RAW_SUFFIXES


def natural_key(path: Path) -> tuple[list[tuple[int, str | int]], str]:
    """Sorting key by which ``frame10`` comes after ``frame9``; ``frame9`` and ``frame09`` do not share one."""
    text = str(path)
    return [(0, int(part)) if part.isdecimal() else (1, part) for part in re.split(r"(\d+)", text) if part], text


def place_of(path: Path) -> Path:
    """Path at which a name stands, with links to folders followed but the last link not."""
    # Path.resolve would stumble over links in a circle.
    return Path(os.path.realpath(path.parent)) / path.name


def is_rdstitch_output(path: Path) -> bool:
    """Whether rdstitch wrote this image: the sidecar beside it says so, and means this one."""
    try:
        record = json.loads(read_limited(path.with_name(path.name + ".json"), MAX_TEXT))
        is_sidecar = record["format"] == "rdstitch sidecar"
        return is_sidecar and canonical_text(str(record["output"]["file"])) == canonical_name(path.name)
    except (OSError, ValueError, TypeError, LookupError, RecursionError):
        return False
