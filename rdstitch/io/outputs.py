"""The files of one result: written aside, then put in their places.

An image, its tiles, its world file, its pages and its sidecar belong together. Each is written into a hidden folder
beside its place; when all are complete, each replaces what was there, in the order in which they were staged. The
sidecar is staged last and names size and digest of its image: where a run is cut off within these milliseconds, a
reader sees that the older sidecar is of another image.
"""

import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Self

from rdstitch.errors import OutputError, RdstitchError
from rdstitch.io.deepzoom import holds_only_tiles
from rdstitch.io.staging import StagingFolder
from rdstitch.messages import Message


@dataclass(frozen=True)
class _Item:
    """One output: its name as given, its place, and where it is staged."""

    name: Path
    place: Path
    staged: Path
    is_folder: bool


class Outputs:
    """Outputs that are put in their places when the block ends without an error; after an error none is.

    A symbolic link as an output stays; what it leads to is replaced.

    Parameters
    ----------
    overwrite : bool
        Replace what exists. Without it, also a file that appears during the run is kept.

    Raises
    ------
    OutputError
        For any failure of the file system; every file is whole, the old one or the new one.
    """

    def __init__(self, overwrite: bool) -> None:
        self._overwrite = overwrite
        self._folders: dict[Path, StagingFolder] = {}
        self._items: list[_Item] = []

    def __enter__(self) -> Self:
        """Begin; nothing is made before it is needed."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Put everything in its place, or throw it away."""
        try:
            for act in (self._check, self._place) if kind is None else ():
                for item in self._items:
                    with naming(item.name):
                        act(item)
        finally:
            for folder in self._folders.values():
                folder.close()

    @contextmanager
    def writing(self, path: str | Path) -> Iterator[Path]:
        """Stage a file: yields where to write it; a failure of the file system is one of ``path``."""
        name = Path(path)
        with naming(name):
            staged = self._stage(name, is_folder=False)
            yield staged
            # A full disk must be noticed before anything is replaced.
            descriptor = os.open(staged, os.O_RDWR)
            try:
                os.fsync(descriptor)
            finally:
                os.close(descriptor)

    @contextmanager
    def writing_folder(self, path: str | Path) -> Iterator[Path]:
        """Stage a folder of Deep Zoom tiles: yields an empty folder."""
        name = Path(path)
        with naming(name):
            staged = self._stage(name, is_folder=True)
            staged.mkdir()
            yield staged

    def write(self, path: str | Path, data: bytes) -> None:
        """Stage a file with this content."""
        with self.writing(path) as staged:
            staged.write_bytes(data)

    def attempt(self, path: str | Path, stage: Callable[[], object]) -> list[Message]:
        """Stage what belongs beside an image, whose failure must not cost the image: a warning, where it fails."""
        count = len(self._items)
        try:
            stage()
        except Exception as error:  # noqa: BLE001 the work of hours is not thrown away for a page, whatever is wrong
            del self._items[count:]
            text = str(error) if isinstance(error, RdstitchError) else f"{type(error).__name__}: {error}"
            older = "; the file of this name is older" if Path(path).exists() else ""
            return [Message(f"{path}: not written, all else is: {text.removeprefix(f'{path}: ')}{older}")]
        return []

    def staged(self, path: str | Path) -> Path | None:
        """Where an output lies until it is in its place; None where none of this name is staged."""
        return next((item.staged for item in self._items if item.name == Path(path)), None)

    def _stage(self, name: Path, *, is_folder: bool) -> Path:
        place = Path(os.path.realpath(name.parent)) / name.name
        if place.is_symlink():
            place = Path(os.path.realpath(place))
        if place.parent not in self._folders:
            self._folders[place.parent] = StagingFolder(place.parent)
        # Tiles are staged just before their description, and are found beside it by its name.
        number = sum(not item.is_folder for item in self._items)
        staged = self._folders[place.parent].path / f"new{number}{'_files' if is_folder else name.suffix}"
        self._items.append(_Item(name, place, staged, is_folder))
        return staged

    def _check(self, item: _Item) -> None:
        """Before anything is replaced: what is there may be, and keeps its permissions."""
        if not item.place.exists():
            return
        if not self._overwrite:
            raise _appeared(item.name)
        if not item.is_folder:
            item.staged.chmod(item.place.stat().st_mode & 0o777)
        elif not holds_only_tiles(item.place):
            raise OutputError(f"{item.name}: holds other files than Deep Zoom tiles; choose another name")

    def _place(self, item: _Item) -> None:
        if item.is_folder:
            self._place_folder(item)
            return
        if not self._overwrite:
            # A link replaces nothing; where a file system has none, the check a moment ago must do.
            with suppress(OSError):
                os.link(item.staged, item.place)
                return
            self._check(item)
        item.staged.replace(item.place)

    def _place_folder(self, item: _Item) -> None:
        """No system call replaces a folder that is not empty: the old one goes aside, and back if this fails."""
        old = item.staged.with_name(f"old{item.staged.name}")
        if self._overwrite and item.place.exists():
            item.place.rename(old)
        try:
            item.staged.rename(item.place)
        except OSError:
            if old.exists():
                old.rename(item.place)
            elif item.place.exists():
                raise _appeared(item.name) from None
            raise


def _appeared(name: Path) -> OutputError:
    return OutputError(f"{name}: exists already; it has appeared during the run, and is kept")


@contextmanager
def naming(name: Path) -> Iterator[None]:
    """A failure of the file system is one of writing this output."""
    try:
        yield
    except OSError as error:
        raise OutputError(f"{name}: cannot be written: {error.strerror or error}") from error
