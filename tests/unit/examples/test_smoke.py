"""Every figure of the paper is made, at the smallest settings."""

from importlib import import_module
from pathlib import Path

import numpy as np
import pytest

from examples.paper.common.report import Effort, Settings

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
