"""Figures in the documentation that commands print: ``python -m tests.documented_figures`` compares, ``--write`` mends.

In README every console block of which the first command works on ``examples/data`` is run; in docs/measurements.md the
table of all kinds of features on one pair. Seconds are not compared.
"""

import contextlib
import io
import json
import os
import re
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

from rdstitch_cli.main import run

ROOT = Path(__file__).parents[1]
README, MEASUREMENTS = ROOT / "README.md", ROOT / "docs/measurements.md"
_SECONDS = re.compile(r", \d+\.\d s$", re.MULTILINE)
_BLOCK = re.compile(r"(?ms)^```console\n(\$ rdstitch \w+ examples/data.*?)^```$")
_ROW = re.compile(r"(?m)^\| (\w+) \| \d+ \| \d+ \| (-?[\d.]+) \|$")


def main(arguments: list[str]) -> int:
    """Compare, or write."""
    stale = 0
    for file, current in ((README, readme()), (MEASUREMENTS, features())):
        text = file.read_text(encoding="utf-8")
        if without_seconds(text) != without_seconds(current):
            stale += 1
            print(f"{file}: figures have changed")
            if "--write" in arguments:
                file.write_text(current, encoding="utf-8")
    return 0 if "--write" in arguments else stale


def readme() -> str:
    """README with what its commands print now."""
    return _BLOCK.sub(lambda block: f"```console\n{_rerun(block[1])}```", README.read_text(encoding="utf-8"))


def features(kinds: tuple[str, ...] = ()) -> str:
    """The page on features with what every kind, or these kinds, finds in the bundled pair now."""

    def row(found: re.Match[str]) -> str:
        return found[0] if kinds and found[1] not in kinds else feature_row(found[1])

    return _ROW.sub(row, MEASUREMENTS.read_text(encoding="utf-8"))


def feature_row(kind: str) -> str:
    """The line of the table of features that one kind gives."""
    with _in_empty_folder():
        _output(f"pano examples/data/garfield_red/*.jpg -o pano.jpg --features {kind} --scale 0.1".split())
        record = json.loads(Path("pano.jpg.json").read_text(encoding="utf-8"))
    (pair,) = record["pairs"]
    return f"| {kind} | {pair['matches']} | {pair['inliers']} | {record['lambda']:.4f} |"


def without_seconds(text: str) -> str:
    """A text without durations at the ends of its lines."""
    return _SECONDS.sub("", text)


def _rerun(block: str) -> str:
    with _in_empty_folder():
        commands = [line[2:] for line in block.splitlines() if line.startswith("$ ")]
        return "".join(f"$ {command}\n{_output(command.split()[1:])}" for command in commands)


@contextlib.contextmanager
def _in_empty_folder() -> Iterator[None]:
    before = Path.cwd()
    with tempfile.TemporaryDirectory() as folder:
        (Path(folder) / "examples").symlink_to(ROOT / "examples")
        os.chdir(folder)
        try:
            yield
        finally:
            os.chdir(before)


def _output(arguments: list[str]) -> str:
    """Standard output and error of a command, as on a terminal."""
    printed = io.StringIO()
    with contextlib.redirect_stdout(printed), contextlib.redirect_stderr(printed):
        status = run(arguments)
    assert status == 0, printed.getvalue()
    return printed.getvalue()


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
