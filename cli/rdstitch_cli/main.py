"""The command group, and the edge where errors become one line and an exit status."""

import errno
import gc
import logging
import os
import shlex
import signal
import sys
import traceback
import warnings
from contextlib import suppress
from importlib import import_module
from itertools import takewhile
from pathlib import Path
from typing import Never

import click
from click.shell_completion import shell_complete

from rdstitch.errors import OutputError, RdstitchError
from rdstitch.system.process_memory import take_over_memory
from rdstitch_cli.help_pages import EXIT_STATUSES, help_command
from rdstitch_cli.terminal import one_line, write_whatever_the_encoding

_EXAMPLES = """\b
Examples:
  rdstitch pano left.jpg right.jpg -o pano.jpg
  rdstitch mosaic flight/ -o field.tif --config survey.toml
  rdstitch calibrate wall/ -o camera.yml
  rdstitch help left-out        what a message that ends with [left-out] means
"""

_UNEXPECTED, _USAGE, _INTERRUPTED, _BROKEN_PIPE = 1, 2, 130, 141
_TERMINATION_SIGNALS = tuple(getattr(signal, name) for name in ("SIGTERM", "SIGHUP") if hasattr(signal, name))
_OPENCV_NO_MEMORY = -4  # cv2.Error.StsNoMem
_OUT_OF_MEMORY = "out of memory; try smaller images or a smaller --scale"
_DECODERS = ("PIL", "imagecodecs", "tifffile")
_NO_SPACE = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)


_COMMANDS = {
    "pano": "One image of a few that overlap.",
    "mosaic": "One rectified image of a whole folder or video.",
    "tiles": "One image of tiles taken on a microscope's stage.",
    "apply": "Compose again by a saved sidecar, without estimating.",
    "calibrate": "The lens, from images of a plane.",
    "trajectory": "The path of the camera over the plane, for robots.",
    "undistort": "Images with straight lines straight, by a known lens.",
    "doctor": "What to expect of a run, and what to change before it.",
    "help": "Help on a command, or on the code of a message.",
}


class Commands(click.Group):
    """The commands, each imported when it is used; whoever gives files or options without one is told to name one."""

    def list_commands(self, ctx: click.Context | None = None) -> list[str]:
        """Their names, those that matter first."""
        return [*_COMMANDS]

    def get_command(self, ctx: click.Context | None, cmd_name: str) -> click.Command | None:
        """A command by its name."""
        if cmd_name in _COMMANDS and cmd_name not in self.commands:
            # Nothing of what is imported will be let go of: no search for cycles need look at it.
            gc.disable()
            of_module = {} if cmd_name == "help" else vars(import_module(f"rdstitch_cli.commands.{cmd_name}"))
            gc.freeze()
            gc.enable()
            self.add_command(of_module.get(cmd_name, help_command))
        return self.commands.get(cmd_name)

    def load_all(self) -> dict[str, click.Command]:
        """All commands by their names."""
        return {name: command for name in _COMMANDS if (command := self.get_command(None, name))}

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write their names and what each is for, without importing them."""
        with formatter.section("Commands"):
            formatter.write_dl([*_COMMANDS.items()])

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        given = list(args)
        try:
            return super().parse_args(ctx, args)
        except click.NoSuchOption as error:
            params = [option for command in self.load_all().values() for option in command.params]
            flags = {name: getattr(option, "is_flag", True) for option in params for name in option.opts}
            if error.option_name in flags:
                values = [k for k, word in enumerate(given, start=1) if not flags.get(word, True)]
                at = next((k for k, word in enumerate(given) if word in _COMMANDS and k not in values), None)
                command = ["pano"] if at is None else [given.pop(at)]
                ctx.fail(f"{error.option_name} belongs to a command: rdstitch {shlex.join(command + given)}")
            raise

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        if self.get_command(ctx, args[0]) is None and (Path(args[0]).suffix or Path(args[0]).exists()):
            ctx.fail(f"{args[0]!r} is not a command; name one first: rdstitch pano {shlex.join(args)}")
        return super().resolve_command(ctx, args)


@click.group(
    cls=Commands,
    context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100},
    epilog=f"{_EXAMPLES}\n\n{EXIT_STATUSES}",
)
@click.version_option(None, "-V", "--version", package_name="rdstitch", prog_name="rdstitch")
# Looked for by :func:`run`, since it holds for the parsing of commands too.
@click.option("--debug", is_flag=True, expose_value=False, help="Show the traceback of an error.")
def cli() -> None:
    """Stitch images of a flat scene, and find the lens distortion from the images themselves."""


def main() -> None:
    """Run the command line and leave with its exit status."""
    _open_standard_streams()
    write_whatever_the_encoding()
    # Images and pairs are worked on side by side; threads within each matrix product or filter would only be in the
    # way. NumPy and OpenCV read this when they are loaded, which is later.
    for name in ("OPENBLAS_NUM_THREADS", "OPENCV_FOR_THREADS_NUM"):
        os.environ.setdefault(name, "1")
    take_over_memory()
    # Decoders warn and log of odd files; this process is ours, and what matters ends as an error.
    for name in _DECODERS:
        warnings.filterwarnings("ignore", module=rf"{name}\b")
        logging.getLogger(name).addHandler(logging.NullHandler())
    for number in _TERMINATION_SIGNALS:
        if signal.getsignal(number) is not signal.SIG_IGN:  # as nohup starts programs
            signal.signal(number, _end)
    status = run(sys.argv[1:])
    # The interpreter would look three times for cycles among all that lives, before it is gone anyway.
    gc.freeze()
    sys.exit(status)


def _open_standard_streams() -> None:
    """Lead what whoever started this has closed to nowhere: the next file opened must not become its successor."""
    for number, name in enumerate(("stdin", "stdout", "stderr")):
        if getattr(sys, name) is None:
            nowhere = os.open(os.devnull, os.O_RDWR)
            if nowhere != number:
                os.dup2(nowhere, number)
                os.close(nowhere)
            setattr(sys, name, open(number, "w" if number else "r", encoding="utf-8"))  # noqa: PTH123, SIM115


def run(arguments: list[str]) -> int:
    """Run one command; whatever goes wrong becomes one line on standard error and a status."""
    debug = "--debug" in takewhile(lambda argument: argument.startswith("-"), arguments)
    try:
        return _invoke(arguments)
    except (KeyboardInterrupt, click.exceptions.Abort, _TerminatedError) as asked:
        status = 128 + asked.number if isinstance(asked, _TerminatedError) else _INTERRUPTED
        return _print_error("; ".join(["interrupted", *getattr(asked, "__notes__", ())]), status, debug)
    except click.ClickException as error:
        context = getattr(error, "ctx", None)
        hint = "" if context is None else f"; see '{context.command_path} --help'"
        return _print_error(error.format_message().rstrip(".") + hint, error.exit_code, debug)
    except RdstitchError as error:
        hint = f"; see 'rdstitch help {error.code}'" if error.code else ""
        return _print_error(f"{error}{hint}", error.exit_status, debug)
    except MemoryError:
        return _print_error(_OUT_OF_MEMORY, 7, debug)
    except Exception as error:  # noqa: BLE001 - the last line of defence: no traceback for users
        if isinstance(error, OSError) and error.errno in _NO_SPACE:
            return _print_error(f"{error.filename or 'standard output'}: cannot be written: {error.strerror}", 6, debug)
        if getattr(error, "code", None) == _OPENCV_NO_MEMORY and type(error).__module__ == "cv2":
            return _print_error(_OUT_OF_MEMORY, 7, debug)
        if isinstance(error, FileNotFoundError) and _cwd_is_deleted():
            return _print_error("the current folder does not exist any more; change to another one", 3, debug)
        text = str(error) or type(error).__name__
        hint = "" if debug else "; run again as 'rdstitch --debug ...' and report the traceback"
        return _print_error(f"unexpected failure ({type(error).__name__}): {text}{hint}", _UNEXPECTED, debug)


def _invoke(arguments: list[str]) -> int:
    """Run the command and write its results; :meth:`click.Command.main` has its own ideas of interrupts and pipes."""
    if completion := os.environ.get("_RDSTITCH_COMPLETE"):
        return shell_complete(cli, {}, "rdstitch", "_RDSTITCH_COMPLETE", completion)
    if not arguments:  # click before 8.2 takes this for success
        click.echo(cli.get_help(click.Context(cli, info_name="rdstitch", **cli.context_settings)), err=True)
        return _USAGE
    try:
        with cli.make_context("rdstitch", list(arguments)) as context:
            cli.invoke(context)
    except click.exceptions.Exit as done:
        if done.exit_code:
            return done.exit_code
    except BrokenPipeError:
        return _on_broken_pipe()
    try:
        sys.stdout.flush()
    except BrokenPipeError:
        return _on_broken_pipe()
    except OSError as error:
        _on_broken_pipe()
        raise OutputError(f"standard output: cannot be written: {error.strerror}") from error
    return 0


def _on_broken_pipe() -> int:
    """The reader of standard output is gone; nothing may be written to it at exit either."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    return _BROKEN_PIPE


def _cwd_is_deleted() -> bool:
    try:
        Path.cwd()
    except FileNotFoundError:
        return True
    return False


class _TerminatedError(BaseException):
    """The system asked this process to end; what is half-written is cleared away on the way out."""

    def __init__(self, number: int) -> None:
        super().__init__(number)
        self.number = number


def _end(number: int, frame: object) -> Never:
    raise _TerminatedError(number)


def _print_error(text: str, status: int, debug: bool) -> int:
    # The status tells it to those who cannot be told otherwise.
    with suppress(OSError):
        if debug and sys.exc_info()[0] is not None:
            traceback.print_exc()
        print(one_line(f"rdstitch: {text}"), file=sys.stderr, flush=True)
    return status
