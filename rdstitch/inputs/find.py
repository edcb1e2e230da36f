"""What the user names as input: folders, files, patterns, lists, videos; in the end a list of frames."""

import glob
import hashlib
import json
import os
import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, fields, replace
from functools import cache, partial
from itertools import count
from pathlib import Path

from rdstitch.errors import InputError
from rdstitch.inputs.frame import Frame, Named, files_of
from rdstitch.inputs.keyframes import wanted_frames
from rdstitch.inputs.rosbag import extract_images, is_bag
from rdstitch.io.opening import HEIF_SUFFIXES, RAW_SUFFIXES
from rdstitch.io.video import VIDEO_SUFFIXES, extract_frames, grey_frames
from rdstitch.results.messages import Message, names_of, shortened
from rdstitch.system.file_access import (
    MAX_FILE,
    canonical_name,
    canonical_text,
    is_url,
    read_limited,
    read_text,
    remote_names,
)
from rdstitch.system.temporary_folder import TemporaryFolder

_MAX_PATTERN = 4096  # characters: longer names no file has, and compiling a pattern takes the square of its length
READABLE_SUFFIXES = frozenset(
    [".jpg", ".jpeg", ".png", ".tif", ".tiff", ".webp", ".avif", ".bmp", ".tga", ".jp2", ".ppm", ".pgm", ".pnm", ".gif"]
)
"""What counts as an image in a folder; a file that is named is tried whatever it is called."""


@dataclass(frozen=True)
class FoundImages:
    """What the user's arguments stand for."""

    frames: list[Frame]  # in natural order within a folder or pattern
    # images in folders and patterns that rdstitch wrote, by the sidecars beside them, and that are no input
    outputs: list[Path]
    containers: tuple[Path, ...] = ()  # the ``@list`` files, videos and bags that frames come from
    notes: tuple[Message, ...] = ()  # on videos of which not every frame was taken

    @property
    def files(self) -> list[Path]:
        """What no output may be written over."""
        return [*files_of(self.frames), *self.containers]

    @property
    def messages(self) -> list[Message]:
        """What the user should know of what was not taken."""
        if not self.outputs:
            return [*self.notes]
        paths = [str(path) for path in self.outputs]
        names = shortened(names_of(paths))
        return [
            *self.notes,
            Message(
                f"not taken as input, since sidecars say that rdstitch wrote them: {names}",
                tuple(paths),
                code="own-output",
            ),
        ]


@contextmanager
def found_images(
    arguments: Iterable[Named], *, output: str | Path | None = None, every: int | None = None, topic: str | None = None
) -> Iterator[FoundImages]:
    """The images of :func:`find_images`, of videos too, whose frames exist only inside the block."""
    with ExitStack() as stack:

        @cache
        def frames_folder() -> Path:
            return stack.enter_context(TemporaryFolder())

        exclude = [] if output is None else [output]
        yield find_images(arguments, exclude=exclude, frames_folder=frames_folder, every=every, topic=topic)


def _no_frames() -> Path:
    raise InputError("videos and ROS bags are not accepted here; use 'rdstitch mosaic' or extract their frames")


def find_images(
    arguments: Iterable[Named],
    *,
    exclude: Iterable[str | Path] = (),
    frames_folder: Callable[[], Path] = _no_frames,
    every: int | None = None,
    topic: str | None = None,
) -> FoundImages:
    """The frames that the arguments stand for.

    Each is an image file, a folder, a pattern (``*``, ``?``, ``[...]``), ``@FILE`` with one argument a line or
    separated by NUL, a video file, a ROS bag, or a frame, which stays as it is. Files to ``exclude``, such as the
    output, are left out where rdstitch wrote them; any other image stays: its user must hear that it would be written
    over. Frames of videos are written to ``frames_folder``, losslessly; without it a video is refused. Every n-th frame
    of videos and bags is used, or else those that show new ground, see :mod:`rdstitch.inputs.keyframes`. ``topic`` is
    that of the images in bags; without one, the only one.
    """
    unwanted = {_entry(Path(path)) for path in exclude}
    named = _expanded(arguments)
    notes, stills = list(named.notes), [item for item in named.items if isinstance(item, _Image)]
    frames: list[Frame] = []
    outputs: list[Path] = []
    for item in named.items:
        if isinstance(item, _Image):
            images = [item]
        elif every is None and stills:
            notes.append(item.unused_among(len(stills)))
            continue
        else:
            extracted, said = item.extract(frames_folder(), every, topic)
            images, notes = [_Image(frame) for frame in extracted], [*notes, *said]
        for image in images:
            path = image.frame.path
            is_output = image.frame.image is None and not is_url(path) and is_rdstitch_output(path)
            if is_output and _entry(path) in unwanted:
                continue
            if is_output and not image.named:
                outputs.append(path)
            else:
                frames.append(image.frame)
    if outputs and not frames:
        raise InputError(f"{outputs[0].parent}: there are no images but those that rdstitch wrote")
    return FoundImages(_labelled(frames), outputs, tuple(named.containers), tuple(notes))


def _labelled(frames: Sequence[Frame]) -> list[Frame]:
    """The same; those of one file name are called by as many of their folders too as tell them from each other."""
    places: dict[str, set[tuple[str, ...]]] = {}
    for frame in frames:
        places.setdefault(frame.path.name, set()).add(_entry(frame.path).parts)
    depth = {
        name: next(n for n in count(1) if len({parts[-n:] for parts in alike}) == len(alike))
        for name, alike in places.items()
        if len(alike) > 1
    }
    return [
        replace(frame, label=canonical_name("/".join(_entry(frame.path).parts[-depth[frame.path.name] :])))
        if frame.path.name in depth and not frame.label and frame.image is None
        else frame
        for frame in frames
    ]


def _entry(path: Path) -> Path:
    """Where a name stands, links to folders followed but the last link not."""
    # Path.resolve would stumble over links in a circle.
    return Path(os.path.realpath(path.parent)) / path.name


def natural_key(path: Path) -> list[tuple[int, str | int]]:
    """Sorting key by which ``frame10`` comes after ``frame9``."""
    return [(0, int(part)) if part.isdecimal() else (1, part) for part in re.split(r"(\d+)", str(path)) if part]


@dataclass(frozen=True)
class _Image:
    """An image among the arguments."""

    frame: Frame
    named: bool = True  # one by one, not by its folder or a pattern


@dataclass(frozen=True)
class _Clip:
    """A video or bag among the arguments, whose frames are not extracted yet."""

    path: Path

    def extract(self, folder: Path, every: int | None, topic: str | None) -> tuple[list[Frame], list[Message]]:
        """Write the frames that are wanted to a folder; and what was passed over."""
        # Of its own: another one may have the same name, in another folder.
        place = _entry(self.path)
        folder = folder / hashlib.sha256(os.fsencode(place)).hexdigest()[:8] / place.parent.name
        folder.mkdir(parents=True, exist_ok=True)
        if is_bag(self.path):
            images, wanted = extract_images(self.path, folder, every, topic)
            return images, wanted.messages(self.path)
        wanted = wanted_frames(every, partial(grey_frames, self.path))
        written = extract_frames(self.path, folder, wanted.__contains__)
        return [Frame(*frame) for frame in written], wanted.messages(self.path)

    def unused_among(self, images: int) -> Message:
        """Why it is not used beside images."""
        remedy = "give it alone, or --every N to use every N-th of its frames too"
        if images < 2:
            raise InputError(f"{self.path}: is a video beside one image; {remedy}")
        return Message(f"is a video among images, and was not used; {remedy}", (str(self.path),))


@dataclass(frozen=True)
class _Named:
    """What arguments stand for, as :class:`FoundImages` has it, before videos are looked into."""

    items: Sequence[_Image | _Clip]
    containers: Sequence[Path] = ()
    notes: Sequence[Message] = ()

    @classmethod
    def several(cls, frames: Iterable[Path], notes: Sequence[Message] = ()) -> "_Named":
        """Images that were not named one by one."""
        return cls([_Image(Frame(path), named=False) for path in frames], (), notes)


def _expanded(arguments: Iterable[Named], lists: tuple[Path, ...] = ()) -> _Named:
    """All that arguments stand for; ``lists`` are those that they come from."""
    parts = [_named_by(argument, lists) for argument in arguments]
    return _Named(*([each for part in parts for each in getattr(part, f.name)] for f in fields(_Named)))


def _named_by(argument: Named, lists: tuple[Path, ...]) -> _Named:
    if isinstance(argument, Frame):
        return _Named([_Image(argument)])
    path, text = Path(argument), str(argument)
    if is_url(path):
        return _at_url(text)
    if not _exists(path):
        if text.startswith("@"):
            file = Path(text[1:])
            if file in lists:
                raise InputError(f"{file}: the list of images names itself")
            # Another program may write the list while we read it: @<(find ...) in a shell.
            inner = _expanded(names_in(read_text(file, regular=False)), (*lists, file))
            return replace(inner, containers=[file, *inner.containers])
        return _Named.several(_matching(text)) if glob.has_magic(text) else _Named([_Image(Frame(path))])
    if is_bag(path):
        return _Named([_Clip(path)], [*path.iterdir()] if path.is_dir() else [path])
    if path.is_dir():
        return _Named.several(*_in_folder(path))
    if path.suffix.lower() in VIDEO_SUFFIXES:
        return _Named([_Clip(path)], [path])
    return _Named([_Image(Frame(path))])


def _at_url(url: str) -> _Named:
    """The image, or the images of the folder or pattern, that a URL names."""
    path = Path(url)
    pattern = glob.has_magic(path.name)
    if not pattern and path.suffix.lower() in READABLE_SUFFIXES:
        return _Named([_Image(Frame(path))])
    if path.suffix.lower() in VIDEO_SUFFIXES:
        raise InputError(f"{path}: only images are read from other machines; download the video first")
    try:
        found = sorted(map(Path, remote_names(url)), key=natural_key)
    except OSError as error:
        raise InputError(f"{path}: {error}") from error
    found = [name for name in found if name.suffix.lower() in READABLE_SUFFIXES | HEIF_SUFFIXES]
    if not found:
        raise InputError(f"{path}: there are no images at this address")
    return _Named.several(found)


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


def images_in(folder: Path) -> list[Path]:
    """The images of a folder in natural order, and those that nobody here can read: who reads them will say so."""
    try:
        entries = [path for path in folder.iterdir() if not path.name.startswith(".")]
    except OSError as error:
        raise InputError(f"{folder}: cannot read the folder: {error.strerror}") from error
    images = [path for path in entries if path.suffix.lower() in READABLE_SUFFIXES]
    # Many cameras write a raw file beside each image, and phones that export JPEG leave the HEIC there.
    stems = {path.stem for path in images}
    images += [
        path for path in entries if path.suffix.lower() in HEIF_SUFFIXES | RAW_SUFFIXES and path.stem not in stems
    ]
    return sorted(images, key=natural_key)


def _in_folder(folder: Path) -> tuple[list[Path], list[Message]]:
    """The images of a folder, of which there must be one at least; and a note on what else is in it."""
    images = images_in(folder)
    others = sorted({path for path in folder.iterdir() if not path.name.startswith(".")} - set(images), key=natural_key)
    if not images:
        raise InputError(f"{folder}: there are no images in this folder{_elsewhere(others)}")
    text = f"{folder}: not taken for images: {shortened([path.name for path in others])}"
    return images, [Message(text, severity="detail")] if others else []


def _has_images(folder: Path) -> bool:
    try:
        return bool(images_in(folder))
    except InputError:
        return False


def _elsewhere(others: Sequence[Path]) -> str:
    """Where the images may be, if a folder has none."""
    within = [str(path) for path in others if path.is_dir() and _has_images(path)]
    videos = [str(path) for path in others if path.suffix.lower() in VIDEO_SUFFIXES]
    if within:
        return f", but in the folders within it; name those: {shortened(within)}"
    return f", but a video; name it: {shortened(videos)}" if videos else ""


def _matching(pattern: str) -> list[Path]:
    if len(pattern) > _MAX_PATTERN:
        raise InputError(f"{pattern[:40]}…: a pattern of {len(pattern)} characters is too long")
    matching = map(Path, glob.glob(pattern))  # noqa: PTH207 - a pattern may be absolute
    found = [path for path in matching if path.is_file()]
    if not found:
        raise InputError(f"{pattern}: no file matches this pattern")
    return sorted(found, key=natural_key)


def is_rdstitch_output(path: Path) -> bool:
    """Whether rdstitch wrote this image: the sidecar beside it says so, and means this one."""
    try:
        record = json.loads(read_limited(path.with_name(path.name + ".json"), MAX_FILE))
        own = record["format"] == "rdstitch sidecar"
        return own and canonical_text(str(record["output"]["file"])) == canonical_name(path.name)
    except (OSError, ValueError, TypeError, LookupError, RecursionError):
        return False
