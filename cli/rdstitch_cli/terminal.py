"""Text on terminals and in pipes that know fewer characters than UTF-8: nothing fails there, λ is written lambda."""

import codecs
import sys
from contextlib import suppress
from io import TextIOWrapper

_ASCII = {
    "λ": "lambda",
    "φ": "phi",
    "ψ": "psi",
    "θ": "theta",
    "σ": "sigma",
    "±": "+/-",
    "×": "x",
    "…": "...",
    "°": " degrees",
    "²": "^2",
    "–": "-",
    "—": "-",
}


def write_whatever_the_encoding() -> None:
    """Let standard output and error spell out what their encoding lacks, such as λ in Windows' code page 1252."""
    codecs.register_error("rdstitch", spell_out)
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, TextIOWrapper):
            with suppress(ValueError, OSError):
                stream.reconfigure(errors="rdstitch")


def spell_out(error: UnicodeError) -> tuple[str | bytes, int]:
    """What stands for characters that an encoding lacks; an error handler of :mod:`codecs`."""
    if not isinstance(error, UnicodeEncodeError):
        raise error
    first, end = error.object[error.start], error.start + 1
    # The bytes of file names that are no text, which Python keeps as lone surrogates, go out as they came in.
    if "\udc80" <= first <= "\udcff":
        return first.encode("utf-8", "surrogateescape"), end
    return _ASCII.get(first) or first.encode("ascii", "backslashreplace").decode("ascii"), end
