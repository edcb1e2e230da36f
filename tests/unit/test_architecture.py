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
