"""The files of one result, which :mod:`rdstitch.system.output_checks` allowed: written aside, then put in place.

An image, its tiles, its world file, its pages and its sidecar belong together. Each is written into a hidden folder
beside its place; when all are complete, each replaces what was there, in the order in which they were staged. The
sidecar is staged last and names size and digest of its image: where a run is cut off within these milliseconds, a
reader sees that the older sidecar is of another image.
"""

import json
import os
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext, suppress
from pathlib import Path
from types import TracebackType
from typing import Any, NamedTuple, Self

from rdstitch.errors import OutputError, RdstitchError
from rdstitch.results.messages import Message
from rdstitch.system.output_checks import naming
from rdstitch.system.temporary_folder import TemporaryFolder


def file_name(name: str) -> str:
    """The name of a file that is written for an image, which may be called by its folders too."""
    return name.replace("/", "_")


def write_bytes_atomic(path: str | Path, data: bytes, overwrite: bool = True) -> None:
    """Write a file, whole or not at all."""
    with Outputs(overwrite) as outputs:
        outputs.write(path, data)


def text_bytes(text: str) -> bytes:
    """Encode text as UTF-8; names of files that are none come out as they are."""
    return text.encode("utf-8", "surrogateescape")


def json_bytes(data: Any) -> bytes:
    """JSON in UTF-8 (two spaces, final newline, no NaN).

    The bytes of a file name that are no UTF-8 become JSON's own escapes: the file stays valid, and the name can be
    got back from it.
    """
    text = json.dumps(data, indent=2, ensure_ascii=False, allow_nan=False) + "\n"
    return text.encode("utf-8", "backslashreplace")


class _Item(NamedTuple):
    """One output: its name as given, its place, and where it is staged."""

    name: Path
    place: Path
    staged: Path
    check: Callable[[Path], None] | None  # of a folder: refuses to replace one that is something else


class Outputs:
    """Outputs that are put in their places when the block ends without an error; after an error none is.

    A symbolic link as an output stays; what it leads to is replaced.
    """

    def __init__(self, overwrite: bool) -> None:
        self.overwrite = overwrite
        self._folders: dict[Path, TemporaryFolder] = {}
        self._made: list[Path] = []  # folders for outputs, the inner ones first
        self._items: list[_Item] = []
        self._number = 0  # of the last name that was given

    @classmethod
    def or_own(cls, outputs: "Outputs | None", overwrite: bool = True) -> AbstractContextManager["Outputs"]:
        """Outputs that are given, which their owner ends, or else those of the block."""
        return cls(overwrite) if outputs is None else nullcontext(outputs)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        try:
            for act in (self._check, self._place) if kind is None else ():
                for item in self._items:
                    with naming(item.name):
                        act(item)
        finally:
            for folder in self._folders.values():
                folder.close()
            for made in self._made:
                with suppress(OSError):  # something is in it
                    made.rmdir()

    def make_folder(self, folder: Path) -> None:
        """Make a folder for outputs, which goes again at the end if nothing is in it."""
        self._made[:0] = [place for place in (folder, *folder.parents) if not place.exists()]
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise OutputError(f"{folder}: cannot make the folder: {error.strerror}") from error

    @contextmanager
    def writing(self, path: str | Path) -> Iterator[Path]:
        """Stage a file; a failure of the file system is one of ``path``. Yields where to write it."""
        name = Path(path)
        with naming(name), self.together():
            staged = self._stage(name, self._new_name(name.suffix))
            yield staged
            _flush(staged)

    @contextmanager
    def writing_folder(self, path: str | Path, check: Callable[[Path], None]) -> Iterator[Path]:
        """Stage a folder; ``check`` refuses to replace one that is there. Yields the empty folder to write into."""
        name = Path(path)
        with naming(name), self.together():
            staged = self._stage(name, self._new_name(name.suffix), check)
            staged.mkdir()
            yield staged

    @contextmanager
    def writing_pair(self, folder: Path, file: Path, check: Callable[[Path], None]) -> Iterator[tuple[Path, Path]]:
        """Stage a folder and the file that is found beside it: by the same name, but for their endings."""
        with naming(file), self.together():
            number = self._new_name("")
            inner = self._stage(folder, number + folder.name.removeprefix(_place_of(file).stem), check)
            inner.mkdir()
            staged = self._stage(file, number + file.suffix)
            yield inner, staged
            _flush(staged)

    def write(self, path: str | Path, data: bytes) -> None:
        """Stage a file with this content."""
        with self.writing(path) as staged:
            staged.write_bytes(data)

    def attempt(self, path: str | Path, stage: Callable[[], object]) -> list[Message]:
        """Stage what belongs beside an image, whose failure must not cost the image: a warning, where it fails."""
        try:
            with self.together():
                stage()
        except Exception as error:  # noqa: BLE001 the work of hours is not thrown away for a page, whatever is wrong
            text = str(error) if isinstance(error, RdstitchError) else f"{type(error).__name__}: {error}"
            older = "; the file of this name is older" if Path(path).exists() and Path(path) not in self._made else ""
            return [Message(f"{path}: not written, all else is: {text.removeprefix(f'{path}: ')}{older}")]
        return []

    @contextmanager
    def together(self) -> Iterator[None]:
        """Stage several outputs, all of them or, after an error, none."""
        count = len(self._items)
        try:
            yield
        except BaseException:
            del self._items[count:]
            raise

    def where(self, path: str | Path) -> Path:
        """Where a file lies now: staged, until it is in its place."""
        return next((item.staged for item in self._items if item.name == Path(path)), Path(path))

    def _new_name(self, ending: str) -> str:
        self._number += 1
        return f"new{self._number}{ending}"

    def _stage(self, name: Path, staged_name: str, check: Callable[[Path], None] | None = None) -> Path:
        place = _place_of(name)
        if any(item.place == place for item in self._items):
            raise OutputError(f"{name}: is the name of two outputs; choose another one for each")
        if place.parent not in self._folders:
            self._folders[place.parent] = TemporaryFolder(place.parent, ".rdstitch-")
        staged = self._folders[place.parent].path / staged_name
        self._items.append(_Item(name, place, staged, check))
        return staged

    def _check(self, item: _Item) -> None:
        """Before anything is replaced: what is there may be, and keeps its permissions."""
        if not item.place.exists():
            return
        if not self.overwrite:
            raise OutputError(f"{item.name}: exists already; it has appeared during the run, and is kept")
        if item.check is None:
            item.staged.chmod(item.place.stat().st_mode & 0o777)
        else:
            item.check(item.place)

    def _place(self, item: _Item) -> None:
        if self.overwrite and item.check is not None:
            replace_folder(item.staged, item.place)
        elif self.overwrite:
            item.staged.replace(item.place)
        else:
            # These replace nothing; where a file system has no links, the check a moment ago must do.
            try:
                (os.link if item.check is None else os.rename)(item.staged, item.place)
            except OSError:
                self._check(item)
                item.staged.replace(item.place)


def _place_of(name: Path) -> Path:
    """Where an output goes: what a link leads to is replaced, the link stays."""
    place = Path(os.path.realpath(name.parent)) / name.name
    return Path(os.path.realpath(place)) if place.is_symlink() else place


def _flush(file: Path) -> None:
    """Have a file on disk: that one is full must be noticed before anything is replaced."""
    with file.open("rb+") as stream:
        os.fsync(stream.fileno())


def replace_folder(new: Path, place: Path) -> None:
    """Put a folder in the place of another one, which goes aside, and back if this fails or is interrupted.

    No system call replaces a folder that is not empty.
    """
    old = new.with_name(f"old{new.name}")
    try:
        if place.exists():
            place.rename(old)
        new.rename(place)
    except BaseException:
        if old.exists() and not place.exists():
            old.rename(place)
        raise
