"""The command group, and the edge where errors become one line and an exit status."""

import os
import sys
import traceback
from importlib.metadata import version

import click

from rdstitch.errors import RdstitchError
from rdstitch_cli.commands.calibrate import calibrate
from rdstitch_cli.commands.mosaic import mosaic
from rdstitch_cli.commands.pano import pano
from rdstitch_cli.commands.trajectory import trajectory
from rdstitch_cli.commands.undistort import undistort

EXIT_STATUSES = """\b
Exit status:
  0    done; pictures left out are named on standard error
  1    unexpected failure
  2    wrong usage
  3    a file cannot be read
  4    no overlap, or no reliable result
  5    partial result under --strict
  6    output cannot be written, or exists (see --overwrite)
  7    refused: too large for memory, format or common sense
  130  interrupted
"""

_UNEXPECTED, _INTERRUPTED, _BROKEN_PIPE = 1, 130, 141


@click.group(context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100}, epilog=EXIT_STATUSES)
@click.version_option(version("rdstitch"), prog_name="rdstitch")
@click.option("--debug", is_flag=True, help="Show the traceback of an error.")
@click.pass_context
def cli(context: click.Context, debug: bool) -> None:
    """Stitch pictures of a flat scene, and find the lens distortion from the pictures themselves."""
    context.obj = debug


for command in (pano, mosaic, calibrate, trajectory, undistort):
    command.epilog = f"{command.epilog or ''}\n\n{EXIT_STATUSES}"
    cli.add_command(command)


def main() -> None:
    """Run the command line and leave with its exit status."""
    sys.exit(run(sys.argv[1:]))


def run(arguments: list[str]) -> int:
    """Run one command; whatever goes wrong becomes one line on standard error and a status."""
    debug = "--debug" in arguments
    try:
        status = cli.main(arguments, prog_name="rdstitch", standalone_mode=False)
        sys.stdout.flush()
    except click.exceptions.Abort:
        return _complain("interrupted", _INTERRUPTED, debug)
    except KeyboardInterrupt:
        return _complain("interrupted", _INTERRUPTED, debug)
    except click.ClickException as error:
        error.show()
        return error.exit_code
    except RdstitchError as error:
        return _complain(str(error), error.exit_status, debug)
    except BrokenPipeError:
        # The reader of standard output is gone; nothing may be written to it at exit either.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return _BROKEN_PIPE
    except MemoryError:
        return _complain("out of memory; try smaller pictures or a smaller --scale", 7, debug)
    except Exception as error:  # noqa: BLE001 - the last line of defence: no traceback for users
        text = " ".join(str(error).split()) or type(error).__name__
        hint = "" if debug else "; run again as 'rdstitch --debug ...' and report the traceback"
        return _complain(f"unexpected failure ({type(error).__name__}): {text}{hint}", _UNEXPECTED, debug)
    return status if isinstance(status, int) else 0


def _complain(text: str, status: int, debug: bool) -> int:
    if debug and sys.exc_info()[0] is not None:
        traceback.print_exc()
    line = "rdstitch: " + text.replace("\n", " ")
    print(line.encode("utf-8", "backslashreplace").decode("utf-8"), file=sys.stderr)
    return status
