"""Every figure of examples/paper at tiny counts: its numbers make sense."""

from pathlib import Path

import numpy as np
import pytest

from examples.paper import figure2
from examples.paper.__main__ import main
from examples.paper.report import Report, Table, save
from examples.paper.settings import Effort, Settings

TINY = Settings(Effort.TINY, Path("no real pictures"))


def test_a_table_reads_as_markdown() -> None:
    table = Table("Errors", ("solver", "px"), (("a", 0.12345), ("longer", None)))
    assert str(table).splitlines() == [
        "Errors:",
        "",
        "| solver | px    |",
        "| ------ | ----- |",
        "| a      | 0.123 |",
        "| longer | -     |",
    ]
    assert table.row("a")["px"] == 0.12345


def test_a_report_is_saved_with_its_plot_or_the_reason_why_not(tmp_path: Path) -> None:
    picture = np.arange(12, dtype=np.uint8).reshape(3, 4)
    report = Report((), lambda figure: figure.subplots(), {"picture.png": picture}, ("nothing was measured",))
    said = save(report, "name", tmp_path)
    assert (tmp_path / "name.md").read_text() == "Note: nothing was measured.\n"
    assert (tmp_path / "picture.png").stat().st_size > 0
    assert (tmp_path / "name.png").exists() or "matplotlib is not installed" in said[-1]


def test_unknown_figures_are_refused(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit, match="2"):
        main(["figure99"])
    assert "figure99" in capsys.readouterr().err


def test_figure2_solvers_are_stable() -> None:
    table = figure2.run(TINY).tables[0]
    for name in ("2 points", "3 points, height free", "4 points", "5 points"):
        row = table.row(name)
        assert row["λ median"] < -12.0, name
        assert row["λ 99 %"] < -9.0, name
        assert row["λ off by > 0.01, %"] == 0.0, name
    assert table.row("3 points")["λ off by > 0.01, %"] < 5.0
