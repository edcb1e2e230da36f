"""What can go wrong, as a tree; each leaf has the exit status that the command line gives it.

::

    RdstitchError                1  something unexpected
    ├── ArgumentError            2  an argument has the wrong shape, type or range (also a ValueError)
    │   └── ImpossibleCameraError
    ├── InputError               3  a file cannot be read, or is not what it should be
    ├── RegistrationError        4  no overlap, or no result that can be relied on
    ├── PartialResultError       5  images were left out, and --strict forbids that
    ├── OutputError              6  a file cannot be written, or exists already
    └── LimitError               7  refused: too large for memory, format or common sense

A fit that fails is not an error but a value with a reason; see
:class:`rdstitch.geometry.radial_homography.RadialHomography`.
"""

from typing import ClassVar


class RdstitchError(Exception):
    """Base of all errors that rdstitch raises on purpose; its text is one line for the user."""

    exit_status: ClassVar[int] = 1
    code: ClassVar[str] = ""
    """Heading in docs/troubleshooting.md."""


class ArgumentError(RdstitchError, ValueError):
    """An argument has the wrong shape, type or range."""

    exit_status = 2


class ImpossibleCameraError(ArgumentError):
    """A camera that cannot be; where it was estimated rather than given, that is a RegistrationError."""


class InputError(RdstitchError):
    """A file cannot be read, or is not what it should be."""

    exit_status = 3
    code = "unreadable"


class RegistrationError(RdstitchError):
    """The images do not overlap, or nothing reliable came out of them."""

    exit_status = 4
    code = "no-overlap"


class PartialResultError(RdstitchError):
    """Images were left out although the caller requires all of them."""

    exit_status = 5
    code = "left-out"


class OutputError(RdstitchError):
    """A file cannot be written, or exists and may not be replaced."""

    exit_status = 6
    code = "output"


class LimitError(RdstitchError):
    """Refused: the result would be too large for memory, for the format, or for common sense."""

    exit_status = 7
    code = "too-large"
