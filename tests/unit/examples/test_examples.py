"""Examples are described in one place and say how they are run; every figure of the paper is made."""

import runpy
import sys
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest

from examples.paper.common.report import Effort, Settings

_ROOT = Path(__file__).parents[3]
_FOLDER = _ROOT / "examples"
_SCRIPTS = sorted(
    ".".join(path.relative_to(_ROOT).with_suffix("").parts).removesuffix(".__main__")
    for path in _FOLDER.rglob("*.py")
    if '__name__ == "__main__"' in path.read_text(encoding="utf-8") and path.parent.name != "common"
)


@pytest.mark.parametrize("name", _SCRIPTS)
def test_examples_are_listed(name: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr(sys, "argv", [name, "--help"])
    for module in (name, f"{name}.__main__"):  # another test may have imported it
        monkeypatch.delitem(sys.modules, module, raising=False)
    with pytest.raises(SystemExit) as done:
        runpy.run_module(name, run_name="__main__", alter_sys=False)
    assert not done.value.code
    assert "usage:" in capsys.readouterr().out.lower()
    listed = name.replace(name.rpartition(".")[2], "NAME") if ".benchmarks." in name else name
    assert f"`python -m {listed} " in (_FOLDER / "README.md").read_text(encoding="utf-8")


def test_every_folder_and_shell_script_is_in_the_list() -> None:
    text = (_FOLDER / "README.md").read_text(encoding="utf-8")
    assert len(_SCRIPTS) > 3
    folders = {path.name for path in _FOLDER.iterdir() if path.is_dir() and not path.name.startswith("__")}
    assert [name for name in sorted(folders) if f"[{name}/]" not in text and f"examples.{name} " not in text] == []
    assert [path.name for path in sorted(_FOLDER.rglob("*.sh")) if f"`batch/{path.name} " not in text] == []


TINY = Settings(Effort.TINY, Path("no real images"))
SLOW = ("figure10", "homography_estimation", "panoramas", "end_to_end")
FIGURES = [f"figure{n}" for n in (2, 3, 4, 5, 7, 8, 9)] + ["runtime"]


@pytest.mark.parametrize("name", [*FIGURES, *(pytest.param(name, marks=pytest.mark.slow) for name in SLOW)])
def test_every_figure_is_made(name: str) -> None:
    report = import_module(f"examples.paper.{name}").run(TINY)
    assert report.tables
    for table in report.tables:
        numbers = [value for row in table.rows for value in row if isinstance(value, float)]
        assert table.rows
        assert np.isfinite(numbers).all()
