"""Guards around the decoders: files that are no pictures end as one InputError.

Warnings and log messages of the decoders go where those of any library go: the process that this runs in decides what
becomes of them, since Python's filters and handlers belong to all of its threads.
"""

import os
import stat
import struct
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import cv2
import tifffile
from PIL import Image

from rdstitch.errors import InputError
from rdstitch.file_access import is_url, remote_status
from rdstitch.io.optional_readers import check_reader, is_raw

# What Pillow, tifffile and OpenCV have been seen to raise on damaged files; warnings, where filters make them errors.
_DAMAGE = (
    Warning,
    OSError,
    SyntaxError,
    ValueError,
    TypeError,
    LookupError,
    ArithmeticError,
    AttributeError,
    RuntimeError,
    AssertionError,
    EOFError,
    struct.error,
    zlib.error,
    tifffile.TiffFileError,  # no ValueError in older versions
    Image.DecompressionBombError,
    cv2.error,
)


def check_readable(path: Path) -> None:
    """Refuse what cannot be a picture file, before a decoder blocks or stumbles on it.

    Raises
    ------
    InputError
        When the path is missing, no regular file, empty, or not readable.
    """
    if is_url(path):
        _check_remote(path)
        return
    try:
        status = path.stat()
    except FileNotFoundError:
        hint = "a link to nothing" if path.is_symlink() else "no such file"
        raise InputError(f"{path}: {hint}; check the name") from None
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: {getattr(error, 'strerror', None) or error}; check the name") from error
    if stat.S_ISDIR(status.st_mode):
        raise InputError(f"{path}: is a folder, not a picture; name the pictures in it")
    if not stat.S_ISREG(status.st_mode):
        raise InputError(f"{path}: is not a regular file; copy it to one first")
    if status.st_size == 0:
        raise InputError(f"{path}: is empty (0 bytes); copy it again from its source")
    check_reader(path)
    if not os.access(path, os.R_OK):
        raise InputError(f"{path}: permission denied; make it readable")


def _check_remote(path: Path) -> None:
    """The same of what a URL names."""
    if is_raw(path):
        raise InputError(f"{path}: raw files are read from this machine's disks only; download it first")
    check_reader(path)
    try:
        is_folder, size, _ = remote_status(path)
    except FileNotFoundError:
        raise InputError(f"{path}: no such file; check the address") from None
    except OSError as error:
        raise InputError(f"{path}: {error}") from error
    if is_folder:
        raise InputError(f"{path}: is a folder, not a picture; name the pictures in it")
    if size == 0:
        raise InputError(f"{path}: is empty (0 bytes); copy it again from its source")


@contextmanager
def decoding(path: Path) -> Iterator[None]:
    """Run a decoder: its failures become an InputError that names the file."""
    try:
        yield
    except MemoryError as error:
        raise InputError(f"{path}: too large to read into memory; make it smaller first") from error
    except PermissionError as error:
        raise InputError(f"{path}: permission denied; make it readable") from error
    except _DAMAGE as error:
        if isinstance(error, cv2.error) and error.code == cv2.Error.StsNoMem:
            raise InputError(f"{path}: too large to read into memory; make it smaller first") from error
        reason = " ".join(str(error).split()) or type(error).__name__
        reason = reason.replace(f"'{path}'", "the file")
        raise InputError(f"{path}: not a picture that can be read, or damaged ({reason[:160]})") from error
