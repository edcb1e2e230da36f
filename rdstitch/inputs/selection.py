"""Which of the pictures that were named are used: the user's --exclude and --include-only."""

from collections.abc import Sequence
from fnmatch import fnmatchcase

from rdstitch.errors import ArgumentError
from rdstitch.inputs.frame import Frame


def selected(frames: Sequence[Frame], exclude: Sequence[str], include_only: Sequence[str]) -> list[Frame]:
    """The pictures that ``include_only`` names, all if it names none, without those that ``exclude`` names.

    Parameters
    ----------
    frames : sequence of Frame
    exclude, include_only : sequence of str
        File names or whole paths, or patterns of them (``*``, ``?``, ``[...]``).

    Raises
    ------
    ArgumentError
        When one of them fits no picture: it is misspelt.
    """
    for option, patterns in (("exclude", exclude), ("include-only", include_only)):
        for pattern in patterns:
            if not any(_fits(frame, pattern) for frame in frames):
                raise ArgumentError(f"--{option} {pattern}: none of the {len(frames)} pictures is called so")
    return [frame for frame in frames if is_selected(frame, exclude, include_only)]


def is_selected(frame: Frame, exclude: Sequence[str], include_only: Sequence[str]) -> bool:
    """Whether a picture is used; see :func:`selected`."""
    included = not include_only or any(_fits(frame, pattern) for pattern in include_only)
    return included and not any(_fits(frame, pattern) for pattern in exclude)


def _fits(frame: Frame, pattern: str) -> bool:
    names = frame.path.name, str(frame.path)
    return pattern in names or any(fnmatchcase(name, pattern) for name in names)
