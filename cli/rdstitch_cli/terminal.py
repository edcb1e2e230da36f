"""What the user sees while a command runs: bars on a terminal, lines of log, in whatever encoding there is."""

import codecs
import sys
import time
from contextlib import suppress
from io import TextIOWrapper
from typing import TYPE_CHECKING, Never, Self

if TYPE_CHECKING:
    from tqdm import tqdm

    from rdstitch.results.messages import Message

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


def one_line(text: str) -> str:
    """Text that a terminal shows as one line, whatever file names and cameras are called."""
    shown = (c if c.isprintable() else " " if c.isspace() else c.encode("unicode_escape").decode() for c in text)
    return "".join(shown).strip()


class Reporter:
    """Receives what the library has to say while it works: it is its ``progress`` callable."""

    def __init__(self, verbosity: int) -> None:
        self._verbosity = verbosity
        self._bars = verbosity >= 0 and sys.stderr.isatty()
        self._bar: tqdm[Never] | None = None
        self._stage = ""
        self._began = self._stage_began = time.perf_counter()

    def __call__(self, stage: str, done: int, total: int) -> None:
        """Show that ``done`` of ``total`` steps of a stage are done."""
        if stage != self._stage:
            self._end_stage()
            self._stage = stage
            self.log(f"{stage} ({total})")
            if self._bars:
                from tqdm import tqdm

                self._bar = tqdm(total=total, desc=stage, leave=False, file=sys.stderr, dynamic_ncols=True)
        if self._bar is not None:
            self._bar.update(done - self._bar.n)

    def warn(self, text: str) -> None:
        """Say what the user should know even though the command succeeds."""
        self._line(f"rdstitch: warning: {text}", 0)

    def note(self, text: str) -> None:
        """Say what belongs to the result but not to standard output."""
        self._line(f"rdstitch: {text}", 0)

    def log(self, text: str) -> None:
        """Log what is going on, under ``-v``."""
        self._line(f"rdstitch: {text}", 1)

    def tell(self, message: "Message") -> None:
        """Say a message as loudly as it is grave."""
        say = {"detail": self.log, "note": self.note}.get(message.severity, self.warn)
        say(str(message))

    def finish(self) -> None:
        """Take the bar away before anything goes to standard output."""
        if self._bar is not None:
            self._bar.close()
            self._bar = None

    def _end_stage(self) -> None:
        """Log what the stage took, of time and of this process's memory."""
        self.finish()
        now = time.perf_counter()
        if self._stage and self._verbosity >= 1:
            from rdstitch.system.process_memory import forget_peak_memory, peak_memory

            self.log(f"{self._stage}: {now - self._stage_began:.1f} s, at most {peak_memory():.0f} MB")
            forget_peak_memory()
        self._stage, self._stage_began = "", now

    def made(self, text: str) -> None:
        """End by saying what was made, and how long it took."""
        self._end_stage()
        self._line(f"{text}, {time.perf_counter() - self._began:.1f} s", 0)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *failure: object) -> None:
        """Take the bar away, whatever happened."""
        self.finish()

    def _line(self, text: str, verbosity: int) -> None:
        """Print a line from a verbosity on; where nobody reads standard error any more, the work goes on without."""
        if self._verbosity < verbosity:
            return
        with suppress(OSError):
            if self._bar is not None:
                self._bar.clear()
            print(one_line(text), file=sys.stderr)
            if self._bar is not None:
                self._bar.refresh()
