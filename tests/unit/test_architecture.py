"""docs/architecture.md and the layers know every room."""

import re
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
ROOMS = sorted(
    path.stem
    for path in (ROOT / "rdstitch").iterdir()
    if (path.suffix == ".py" or (path / "__init__.py").exists()) and path.stem[0] != "_"
)
PAGE = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")


@pytest.mark.parametrize("room", ROOMS)
def test_every_room_is_on_the_page_and_in_one_layer(room: str) -> None:
    rows = [line.split("|")[1] for line in PAGE.splitlines() if line.startswith("| `")]
    assert any(f"`{room}`" in row or f"`{room}/`" in row for row in rows)
    settings = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    layers = settings["tool"]["importlinter"]["contracts"][0]["layers"]
    assert sum(f"rdstitch.{room}" in re.split(r" [|:] ", layer) for layer in layers) == 1


def test_what_the_page_names_is_there() -> None:
    for name in re.findall(r"`((?:rdstitch|cli|tests|docs)/[\w/.]+)`", PAGE):
        assert (ROOT / name).exists(), name
    for kind, module in re.findall(r"^\| `(\w+)` \(`([\w.]+)`\)", PAGE, re.MULTILINE):
        path = ROOT / "rdstitch" / module.replace(".", "/")
        source = path.with_suffix(".py") if path.with_suffix(".py").exists() else path / "__init__.py"
        assert re.search(rf"\b{kind}\b", source.read_text(encoding="utf-8")), (kind, module)


UNIT = ROOT / "tests" / "unit"
ABOUT_THE_TREE = {"architecture", "sizes", "troubleshooting"}
THROUGH_COMMANDS = {"doctor", "report", "sidecar", "viewer"}
"""Rooms whose tests run the command that they serve."""


@pytest.mark.parametrize("test", sorted(UNIT.rglob("test_*.py")), ids=lambda path: str(path.relative_to(UNIT)))
def test_unit_tests_lie_where_the_code_lies(test: Path) -> None:
    """A test of a room is in the folder of its name, and is named after a module of it, or uses it."""
    parts = test.relative_to(UNIT).parts
    if len(parts) == 1:
        assert test.stem.removeprefix("test_") in ABOUT_THE_TREE | set(ROOMS)
        return
    room = ".".join(parts[:-1])
    home = f"rdstitch.{room}" if parts[0] != "examples" else room
    module = ROOT.joinpath("rdstitch", *parts[:-1], test.name.removeprefix("test_"))
    text = test.read_text(encoding="utf-8")
    assert module.exists() or home in text or f"from rdstitch import {room}" in text, f"tests nothing of {home}"


def test_every_room_has_a_folder_of_tests() -> None:
    rooms = {room for room in ROOMS if (ROOT / "rdstitch" / room).is_dir()}
    folders = {path.name for path in UNIT.iterdir() if path.is_dir() and any(path.glob("**/test_*.py"))}
    assert folders - {"examples"} == rooms - THROUGH_COMMANDS
