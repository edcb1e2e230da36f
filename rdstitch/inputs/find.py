"""The list of frames that the user names as input, by folders, files, patterns, lists and videos."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from functools import cache
from itertools import count
from pathlib import Path

from rdstitch.errors import InputError
from rdstitch.inputs.arguments import ListedImage, expanded
from rdstitch.inputs.frame import Frame, Named, files_of
from rdstitch.inputs.image_folders import is_rdstitch_output, place_of
from rdstitch.results.messages import Message, names_of, shortened
from rdstitch.system.file_access import canonical_name, is_url, without_query
from rdstitch.system.temporary_folder import TemporaryFolder


@dataclass(frozen=True)
class FoundImages:
    """Images that the user's arguments stand for."""

    frames: list[Frame]  # in natural order within a folder or pattern
    # images in folders and patterns that rdstitch wrote, by the sidecars beside them, and that are no input
    outputs: list[Path]
    containers: tuple[Path, ...] = ()  # the ``@list`` files, videos and bags that frames come from
    notes: tuple[Message, ...] = ()  # on videos of which not every frame was taken

    @property
    def files(self) -> list[Path]:
        """Files that no output may be written over."""
        return [*files_of(self.frames), *self.containers]

    @property
    def messages(self) -> list[Message]:
        """Messages on what was not taken."""
        paths = tuple(map(str, self.outputs))
        text = f"not taken as input, since sidecars say that rdstitch wrote them: {shortened(names_of(paths))}"
        return [*self.notes, *([Message(text, paths, code="own-output")] if paths else [])]


@contextmanager
def found_images(
    arguments: Iterable[Named],
    *,
    outputs: Iterable[Path | None] = (),
    every: int | None = None,
    topic: str | None = None,
) -> Iterator[FoundImages]:
    """The images of :func:`find_images`, of videos too, whose frames exist only inside the block."""
    with ExitStack() as stack:

        @cache
        def frames_folder() -> Path:
            return stack.enter_context(TemporaryFolder())

        exclude = [path for path in outputs if path is not None]
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
    excluded = {place_of(Path(path)) for path in exclude}
    named = expanded(arguments)
    notes, stills = list(named.notes), [item for item in named.items if isinstance(item, ListedImage)]
    frames: list[Frame] = []
    outputs: list[Path] = []
    for item in named.items:
        if isinstance(item, ListedImage):
            images = [item]
        elif every is None and stills:
            notes.append(item.unused_among(len(stills)))
            continue
        else:
            extracted, further = item.extract(frames_folder(), every, topic)
            images, notes = [ListedImage(frame) for frame in extracted], [*notes, *further]
        for image in images:
            path = image.frame.path
            is_output = image.frame.image is None and not is_url(path) and is_rdstitch_output(path)
            if is_output and place_of(path) in excluded:
                continue
            if is_output and not image.explicit:
                outputs.append(path)
            else:
                frames.append(image.frame)
    if outputs and not frames:
        raise InputError(f"{outputs[0].parent}: there are no images but those that rdstitch wrote")
    return FoundImages(_labelled(frames), outputs, tuple(named.containers), tuple(notes))


def _labelled(frames: Sequence[Frame]) -> list[Frame]:
    """The frames, those of one file name labelled by as many of their folders too as tell them from each other."""
    places: dict[str, set[tuple[str, ...]]] = {}
    located = [place_of(without_query(frame.path)) for frame in frames]
    for place in located:
        places.setdefault(place.name, set()).add(place.parts)
    depth = {
        name: next(n for n in count(1) if len({parts[-n:] for parts in alike}) == len(alike))
        for name, alike in places.items()
        if len(alike) > 1
    }
    return [
        replace(frame, label=canonical_name("/".join(place.parts[-depth[place.name] :])))
        if place.name in depth and not frame.label and frame.image is None
        else frame
        for frame, place in zip(frames, located, strict=True)
    ]
