"""Opening files that someone else made, here or at a URL of any kind that fsspec knows (``s3://``, ``https://``, …).

A pipe, a socket or a device among them must not block, or feed without end. A URL travels as a path, like the name of
any input. :class:`pathlib.Path` writes ``s3://bucket/name`` with one slash, which is undone before anything is opened.
"""

import errno
import os
import re
import stat
import unicodedata
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from functools import lru_cache, wraps
from importlib import import_module
from io import BufferedReader, BytesIO
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

from rdstitch.errors import InputError

MAX_TEXT = 256 * 2**20  # bytes of a text; a sidecar of ten thousand images has about 30 MB

_BLOCK = 2**18  # bytes of a file that are fetched at a time where only its header is wanted
_READ_AT_ONCE = 2**22  # bytes
# Two letters or more: one is a drive.
_SCHEME = re.compile(r"[A-Za-z][A-Za-z0-9+.-]+:/")
_HTTP_STATES = ("ETag", "Content-MD5", "Digest", "Last-Modified")  # headers that change with the content
_LOCAL = ("file", "local")  # schemes of what is on this machine
_SEVERAL = "::"  # between the parts of a chain, as in simplecache::s3://bucket/name
_Content = TypeVar("_Content")
ContentState = tuple[int, int] | str
_held: ContextVar[tuple[str, bytes] | None] = ContextVar("held", default=None)


def canonical_name(name: str | Path) -> str:
    """A file's name as one text, whatever the locale makes of its bytes and however its accents are composed."""
    try:
        data = os.fsencode(name)
    except UnicodeEncodeError:
        return canonical_text(str(name))
    return unicodedata.normalize("NFC", data.decode("utf-8", "surrogateescape"))


def canonical_text(name: str) -> str:
    """The same for a name that a text file holds, which may have been written where its bytes meant nothing."""
    with suppress(UnicodeEncodeError):  # halves of characters, in a damaged file
        name = name.encode("utf-8", "surrogateescape").decode("utf-8", "surrogateescape")
    return unicodedata.normalize("NFC", name)


def is_url(path: str | Path) -> bool:
    """Check whether a name is a URL; also once it was made a path."""
    return _SCHEME.match(str(path).rpartition(_SEVERAL)[2]) is not None


def without_query(path: Path) -> Path:
    """The path of a URL without what follows a question mark, such as a signature; any other as it is."""
    return Path(str(path).partition("?")[0]) if is_url(path) else path


def url_of(path: str | Path) -> str:
    """The URL that a path was made of."""
    chain = []
    for part in str(path).split(_SEVERAL):
        scheme, slash, rest = part.partition(":/")
        absolute = "/" if scheme in _LOCAL else ""
        chain.append(f"{scheme}://{absolute}{rest.lstrip('/')}" if slash else part)
    return _SEVERAL.join(chain)


def local_file(path: str | Path) -> Path:
    """The file of this machine that a URL like ``file:///place/name`` names; any other name as it is."""
    url = url_of(path).rpartition(_SEVERAL)[2]
    scheme, _, rest = url.partition("://")
    return Path(rest) if scheme in _LOCAL and rest else Path(path)


def open_remote(path: str | Path) -> BufferedReader:
    """Open a file for reading bytes at any place; a header is had without the rest, where the server allows that."""
    held = _held.get()
    if held is not None and held[0] == str(path):
        return BufferedReader(BytesIO(held[1]))
    with _as_os_error():
        system, name = _filesystem(path)
        stream: BufferedReader = system.open(name, "rb", block_size=_BLOCK)
        if stream.seekable():
            return stream
        with stream:
            return BufferedReader(BytesIO(stream.read()))


@contextmanager
def held_in_memory(path: Path) -> Iterator[None]:
    """Fetch a file whole, once for all that open it inside the block; files of this machine stay where they are."""
    if not is_url(path):
        yield
        return
    with open_remote(path) as stream, _as_os_error():
        token = _held.set((str(path), stream.read()))
    try:
        yield
    finally:
        _held.reset(token)


class RemoteStatus(NamedTuple):
    """What a server says of a URL."""

    is_folder: bool
    size: int | None  # bytes
    state: str | None  # what changes with its content


def remote_status(path: str | Path) -> RemoteStatus:
    """Ask a server of a URL; what it does not say is None."""
    with _as_os_error():
        system, name = _filesystem(path)
        info = system.info(name)
        state = system.ukey(name)
        if "http" in getattr(system, "fs", system).protocol:  # whose key is that of the address
            known = [f"{key}: {info[key]}" for key in _HTTP_STATES if info.get(key)]
            state = "\n".join([*known, f"{info.get('size')} bytes"]) if known else None
        return RemoteStatus(info["type"] == "directory", info.get("size"), state or None)


def remote_names(url: str) -> list[str]:
    """URLs of the files in a folder, or of those that match a pattern; empty where the URL is neither."""
    with _as_os_error():
        system, name = _filesystem(url)
        if any(letter in url for letter in "*["):
            entries = system.glob(name)
        else:
            entries = system.ls(name, detail=False) if system.isdir(name) else []
        before = url.rpartition(_SEVERAL)[0]
        chain = f"{before}{_SEVERAL}" if before else ""
        return [chain + system.unstrip_protocol(entry).rpartition(_SEVERAL)[2] for entry in entries]


def _filesystem(path: str | Path) -> tuple[Any, str]:
    """The file system of a URL, and the name in it."""
    try:
        system, name = import_module("fsspec.core").url_to_fs(url_of(path))
    except ImportError as error:  # of fsspec, or of what it needs for this kind of URL
        raise OSError(f"URLs need fsspec: pip install 'fsspec[http]' ({error})") from None
    return system, name


@contextmanager
def _as_os_error() -> Iterator[None]:
    """Whatever a file system raises; each has its own kinds of errors."""
    try:
        yield
    except OSError:
        raise
    except Exception as error:
        reason = " ".join(str(error).split()) or type(error).__name__
        raise OSError(f"cannot be fetched: {reason}") from error


def file_state(path: str | Path) -> tuple[int, int] | None:
    """Size, bytes, and time of the last change, ns: what changes with a file's content; None where there is none."""
    try:
        status = Path(path).stat()
    except OSError:
        return None
    return status.st_size, status.st_mtime_ns


def content_state(path: str | Path) -> ContentState | None:
    """What changes with the content of a file or URL, and is the same on every machine; None where there is none.

    Of a server that says nothing else it is the size.
    """
    if not is_url(path):
        return file_state(path)
    with suppress(OSError):
        status = remote_status(path)
        return status.state or f"{status.size} bytes"
    return None


def cached_by_file_state(read: Callable[[str | Path], _Content]) -> Callable[[str | Path], _Content]:
    """A reader that reads a file again only if it has changed, or after another one: for one value after the other."""

    @lru_cache(maxsize=1)
    def of_state(path: str | Path, state: ContentState | None) -> _Content:
        return read(path)

    @wraps(read)
    def cached(path: str | Path) -> _Content:
        return of_state(path, content_state(path))

    return cached


def open_regular(path: str | Path) -> BufferedReader:
    """Open a regular file for reading bytes, at once whatever lies there; or one that a URL names."""
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
    """The content of a file of at most so many bytes; of a regular one, unless pipes are allowed."""
    content = read_beginning(path, most + 1, regular=regular)
    if len(content) > most:
        raise OSError(errno.EFBIG, "too large to be such a file", str(path))
    return content


def read_beginning(path: str | Path, most: int, *, regular: bool = True) -> bytes:
    """The first ``most`` bytes of a file or URL, or all where it has fewer; unless ``regular``, also of a pipe."""
    blocks = []
    with open_regular(path) if regular or is_url(path) else Path(path).open("rb") as stream:
        # What a stream is asked for is allocated, however small the file.
        while most > 0 and (block := stream.read(min(most, _READ_AT_ONCE))):
            most -= len(block)
            blocks.append(block)
    return b"".join(blocks)


def read_text(path: str | Path, *, regular: bool = True) -> str:
    """The text of a file of a reasonable size; pipes and devices, which may never end, only if not ``regular``."""
    try:
        # Names of files that are not UTF-8 are written as they are, and come back as they were.
        return read_limited(path, MAX_TEXT, regular=regular).decode("utf-8-sig", "surrogateescape")
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: cannot be read: {getattr(error, 'strerror', None) or error}") from error
