"""Opening files that someone else made: a pipe, a socket or a device among them must not block or feed without end."""

import errno
import os
import stat
from io import BufferedReader
from pathlib import Path

from rdstitch.remote_files import is_url, open_remote


def open_regular(path: str | Path) -> BufferedReader:
    """Open a regular file for reading bytes, at once whatever lies there; or one that a URL names.

    Raises
    ------
    OSError
        When it cannot be opened, or is no regular file.
    """
    if is_url(path):
        return open_remote(path)
    # Opening a pipe would wait for a writer.
    descriptor = os.open(path, os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0))
    mode = os.fstat(descriptor).st_mode
    if not stat.S_ISREG(mode):
        os.close(descriptor)
        number, text = (errno.EISDIR, "is a folder") if stat.S_ISDIR(mode) else (errno.EINVAL, "is not a regular file")
        raise OSError(number, text, str(path))
    return open(descriptor, "rb")  # noqa: PTH123 - a descriptor has no path


def read_limited(path: str | Path, most: int, *, regular: bool = True) -> bytes:
    """The content of a file of at most so many bytes; of a regular one, unless pipes are allowed.

    Raises
    ------
    OSError
        When it cannot be opened, is no regular file, or is larger.
    """
    with open_regular(path) if regular else Path(path).open("rb") as stream:
        data = stream.read(most + 1)
    if len(data) > most:
        raise OSError(errno.EFBIG, "too large to be such a file", str(path))
    return data
