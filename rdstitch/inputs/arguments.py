"""Arguments of the user, and what each stands for: an image, a folder, a pattern, a list, a URL, a video or a bag."""

import glob
import hashlib
import os
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

from rdstitch.errors import InputError
from rdstitch.inputs.frame import Frame, Named
from rdstitch.inputs.image_folders import READABLE_SUFFIXES, images_in, is_raw_or_heif, natural_key, place_of
from rdstitch.inputs.keyframes import wanted_frames
from rdstitch.inputs.rosbag import extract_images, is_bag
from rdstitch.io.opening import HEIF_SUFFIXES
from rdstitch.io.video import VIDEO_SUFFIXES, extract_frames, grey_frames
from rdstitch.results.messages import Message, shortened
from rdstitch.system.file_access import is_url, read_text, remote_names, without_query

_MAX_PATTERN = 4096  # characters: longer names no file has, and compiling a pattern takes the square of its length


@dataclass(frozen=True)
class ListedImage:
    """An image that the arguments stand for."""

    frame: Frame
    explicit: bool = True  # named itself, not by its folder or a pattern


@dataclass(frozen=True)
class Clip:
    """A video or bag among the arguments, whose frames are not extracted yet."""

    path: Path

    def extract(self, folder: Path, every: int | None, topic: str | None) -> tuple[list[Frame], list[Message]]:
        """Write the frames that are wanted to a folder; with messages on those that were passed over."""
        # Of its own: another one may have the same name, in another folder.
        place = place_of(self.path)
        folder = folder / hashlib.sha256(os.fsencode(place)).hexdigest()[:8] / place.parent.name
        folder.mkdir(parents=True, exist_ok=True)
        if is_bag(self.path):
            images, wanted = extract_images(self.path, folder, every, topic)
            return images, wanted.messages(self.path)
        wanted = wanted_frames(every, partial(grey_frames, self.path))
        written, damage = extract_frames(self.path, folder, wanted.__contains__)
        damages = [Message(damage, (str(self.path),), code="damaged")] if damage else []
        return [Frame(*frame) for frame in written], [*damages, *wanted.messages(self.path)]

    def unused_among(self, images: int) -> Message:
        """The message that it is not used beside images."""
        remedy = "give it alone, or --every N to use every N-th of its frames too"
        if images < 2:
            raise InputError(f"{self.path}: is a video beside one image; {remedy}")
        return Message(f"is a video among images, and was not used; {remedy}", (str(self.path),))


@dataclass(frozen=True)
class Expanded:
    """Images and clips that arguments stand for, before videos are looked into."""

    items: Sequence[ListedImage | Clip]
    containers: Sequence[Path] = ()  # the ``@list`` files, videos and bags that they come from
    notes: Sequence[Message] = ()

    @classmethod
    def several(cls, frames: Iterable[Path], notes: Sequence[Message] = ()) -> "Expanded":
        """Images that were not named one by one."""
        return cls([ListedImage(Frame(path), explicit=False) for path in frames], (), notes)


def expanded(arguments: Iterable[Named], lists: tuple[Path, ...] = ()) -> Expanded:
    """All that arguments stand for; ``lists`` are those that they come from."""
    parts = [_named_by(argument, lists) for argument in arguments]
    return Expanded(
        [item for part in parts for item in part.items],
        [container for part in parts for container in part.containers],
        [note for part in parts for note in part.notes],
    )


def _named_by(argument: Named, lists: tuple[Path, ...]) -> Expanded:
    if isinstance(argument, Frame):
        return Expanded([ListedImage(argument)])
    path, text = Path(argument), os.fspath(argument)
    if not text:  # which a path takes for the current folder
        raise InputError("one of the names of images is empty; was a variable of the shell not set?")
    if is_url(path):
        return _at_url(text)
    if not _exists(path):
        if text.startswith("@"):
            file = Path(text[1:])
            if file in lists:
                raise InputError(f"{file}: the list of images names itself")
            # Another program may write the list while we read it: @<(find ...) in a shell.
            inner = expanded(names_in(read_text(text[1:], regular=False)), (*lists, file))
            return replace(inner, containers=[file, *inner.containers])
        return Expanded.several(_matching(text)) if glob.has_magic(text) else Expanded([ListedImage(Frame(path))])
    if is_bag(path):
        return Expanded([Clip(path)], [*path.iterdir()] if path.is_dir() else [path])
    if path.is_dir():
        return Expanded.several(*_in_folder(path))
    if path.suffix.lower() in VIDEO_SUFFIXES:
        return Expanded([Clip(path)], [path])
    return Expanded([ListedImage(Frame(path))])


def _at_url(url: str) -> Expanded:
    """The image, or the images of the folder or pattern, that a URL names."""
    path, address = Path(url), without_query(Path(url))
    if not glob.has_magic(address.name) and address.suffix.lower() in READABLE_SUFFIXES:
        return Expanded([ListedImage(Frame(path))])
    if address.suffix.lower() in VIDEO_SUFFIXES:
        raise InputError(f"{path}: only images are read from other machines; download the video first")
    try:
        names = sorted(map(Path, remote_names(url)), key=natural_key)
    except OSError as error:
        raise InputError(f"{path}: {error}") from error
    names = [name for name in names if name.suffix.lower() in READABLE_SUFFIXES | HEIF_SUFFIXES]
    if not names:
        raise InputError(f"{path}: there are no images at this address")
    return Expanded.several(names)


def _exists(path: Path) -> bool:
    """Whether there is a file; the error of one that cannot be looked for comes when it is read."""
    try:
        return path.exists()
    except OSError:
        return False


def names_in(text: str) -> list[str]:
    """The names in a list: separated by NUL, if there is one, else one a line."""
    names = text.split("\0") if "\0" in text else re.split(r"\r?\n", text)
    return [name for name in names if name]


def _in_folder(folder: Path) -> tuple[list[Path], list[Message]]:
    """The images of a folder, of which there must be one at least; and a note on what else is in it."""
    images = images_in(folder)
    others = sorted({path for path in folder.iterdir() if not path.name.startswith(".")} - set(images), key=natural_key)
    if not images:
        raise InputError(f"{folder}: there are no images in this folder{_elsewhere(others)}")
    versions = [path for path in others if is_raw_or_heif(path)]
    reasons = {
        "are raw or HEIC versions of images that are taken": versions,
        "not taken for images": [path for path in others if path not in versions],
    }
    return images, [
        Message(f"{folder}: {reason}: {shortened([path.name for path in paths])}", severity="detail")
        for reason, paths in reasons.items()
        if paths
    ]


def _has_images(folder: Path) -> bool:
    try:
        return bool(images_in(folder))
    except InputError:
        return False


def _elsewhere(others: Sequence[Path]) -> str:
    """The end of a message: where the images may be, if a folder has none."""
    within = [str(path) for path in others if path.is_dir() and _has_images(path)]
    videos = [str(path) for path in others if path.suffix.lower() in VIDEO_SUFFIXES]
    if within:
        return f", but in the folders within it; name those: {shortened(within)}"
    return f", but a video; name it: {shortened(videos)}" if videos else ""


def _matching(pattern: str) -> list[Path]:
    if len(pattern) > _MAX_PATTERN:
        raise InputError(f"{pattern[:40]}…: a pattern of {len(pattern)} characters is too long")
    matching = map(Path, glob.glob(pattern))  # noqa: PTH207 - a pattern may be absolute
    files = [path for path in matching if path.is_file()]
    if not files:
        raise InputError(f"{pattern}: no file matches this pattern")
    return sorted(files, key=natural_key)
