"""Help: every command and option is described, by examples too, and quickly."""

import re
import subprocess
import sys

import click
import pytest
from rdstitch_cli.help_pages import EXIT_STATUSES
from rdstitch_cli.main import cli

from tests.cli.running import Run

COMMANDS = sorted(set(cli.load_all()) - {"help"})


def _options(command: click.Command) -> list[click.Option]:
    return [parameter for parameter in command.params if isinstance(parameter, click.Option)]


@pytest.mark.parametrize("name", COMMANDS)
def test_help_has_examples_exit_statuses_and_every_option(rdstitch: Run, name: str) -> None:
    brief = rdstitch(name, "--help")
    shown = rdstitch(name, "--help-all")
    assert sum(line.startswith("  -") for line in brief.out.splitlines()) <= 25
    assert "RANGE" not in shown.out
    assert f"rdstitch {name} " in shown.out
    assert "Exit status:" in shown.out
    for option in _options(cli.load_all()[name]):
        assert option.help, option.name
        assert any(
            f"{text} " in shown.out or f"{text}," in shown.out or f"{text}\n" in shown.out for text in option.opts
        )


@pytest.mark.parametrize("name", COMMANDS)
def test_examples_use_only_options_that_exist(name: str) -> None:
    epilog = cli.load_all()[name].epilog or ""
    examples = [line for line in epilog.splitlines() if "rdstitch " in line and "find " not in line]
    assert examples
    for line in examples:
        command = cli.load_all()[line.split("rdstitch ")[1].split()[0]]
        known = {text for option in _options(command) for text in option.opts}
        used = set(re.findall(r"(?<=\s)--?[a-z][a-z-]*", line))
        assert used <= known, line


def test_every_status_of_the_error_tree_is_documented() -> None:
    from rdstitch import errors

    kinds = [
        kind for kind in vars(errors).values() if isinstance(kind, type) and issubclass(kind, errors.RdstitchError)
    ]
    assert len(kinds) > 5
    for kind in kinds:
        assert re.search(rf"^\s+{kind.exit_status}\s+\S", EXIT_STATUSES, re.MULTILINE), kind


def test_the_bare_command_shows_all_of_its_help(rdstitch: Run) -> None:
    assert rdstitch(status=2).err == rdstitch("-h").out
    assert "..." not in rdstitch("-h").out.partition("Examples:")[0].partition("[ARGS]...")[2]


@pytest.mark.parametrize("arguments", [["--help"], ["--version"], *([name, "--help"] for name in COMMANDS)])
def test_help_loads_neither_opencv_nor_scipy(arguments: list[str]) -> None:
    check = (
        "import sys; from rdstitch_cli.main import run; status = run(sys.argv[1:]); "
        "heavy = {'cv2', 'scipy', 'numpy', 'PIL', 'tifffile'} & set(sys.modules); "
        "sys.exit(status or (f'loads {heavy}' if heavy else 0))"
    )
    done = subprocess.run([sys.executable, "-c", check, *arguments], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout
