"""Selection of the images that are used: the user's ``--exclude`` and ``--include-only``."""

from collections.abc import Sequence
from fnmatch import fnmatchcase
from pathlib import Path

from rdstitch.errors import ArgumentError
from rdstitch.inputs.frame import Frame
from rdstitch.system.file_access import canonical_name


def selected(frames: Sequence[Frame], exclude: Sequence[str], include_only: Sequence[str]) -> list[Frame]:
    """The images that ``include_only`` names, all if it names none, without those that ``exclude`` names."""
    for option, patterns in (("exclude", exclude), ("include-only", include_only)):
        for pattern in patterns:
            if not any(_fits(frame, pattern) for frame in frames):
                called = frames[0].path if frames else Path("frame_0001.png")
                raise ArgumentError(
                    f"--{option} {pattern}: none of the {len(frames)} images has this name; they are called like "
                    f"{called.name}, and patterns like {called.stem}* fit too"
                )
    return [frame for frame in frames if is_selected(frame, exclude, include_only)]


def is_selected(frame: Frame, exclude: Sequence[str], include_only: Sequence[str]) -> bool:
    """Whether an image is used; see :func:`selected`."""
    included = not include_only or any(_fits(frame, pattern) for pattern in include_only)
    return included and not any(_fits(frame, pattern) for pattern in exclude)


def _fits(frame: Frame, pattern: str) -> bool:
    names = canonical_name(frame.path.name), frame.name, canonical_name(frame.path)
    pattern = canonical_name(pattern)
    return pattern in names or any(fnmatchcase(name, pattern) for name in names)
