"""What a figure gives: tables that read as text and as Markdown, a plot, images, and what had to be left out."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

Draw = Callable[[Any], None]
"""Draws on a matplotlib Figure."""

Pixels = NDArray[np.uint8]


@dataclass(frozen=True)
class Table:
    """Measured numbers."""

    title: str
    header: tuple[str, ...]  # names of the columns, with their units
    rows: tuple[tuple[object, ...], ...]  # text and numbers; a number is printed with three digits, None as a dash

    def column(self, name: str) -> list[Any]:
        """Values of one column."""
        index = self.header.index(name)
        return [row[index] for row in self.rows]

    def row(self, first: str) -> dict[str, Any]:
        """The row whose first entry is ``first``, by column name."""
        found = next(row for row in self.rows if row[0] == first)
        return dict(zip(self.header, found, strict=True))

    def __str__(self) -> str:
        """As a Markdown table with aligned columns."""
        cells = [self.header, *(tuple(_text(value) for value in row) for row in self.rows)]
        widths = [max(len(row[column]) for row in cells) for column in range(len(self.header))]
        lines = ["| " + " | ".join(c.ljust(w) for c, w in zip(row, widths, strict=True)) + " |" for row in cells]
        rule = "| " + " | ".join("-" * width for width in widths) + " |"
        return "\n".join([f"{self.title}:", "", lines[0], rule, *lines[1:]])


@dataclass(frozen=True)
class Report:
    """Result of one figure.

    ``images``: images to be saved, by file name; shape (h, w) or (h, w, 3).
    """

    tables: tuple[Table, ...]
    draw: Draw | None = None  # draws the plot on an empty matplotlib Figure
    images: Mapping[str, Pixels] = field(default_factory=dict)
    notes: tuple[str, ...] = ()  # what was left out, and why: one line each

    def __str__(self) -> str:
        """All tables, then the notes."""
        return "\n\n".join([*(str(table) for table in self.tables), *(f"Note: {note}." for note in self.notes)])


def _text(value: object) -> str:
    if value is None:
        return "-"
    if isinstance(value, float | np.floating):
        return f"{float(value):.3g}"
    return str(value)


def save(report: Report, name: str, folder: Path) -> list[str]:
    """Write a figure's text, plot and images; return one line about each file, or why there is none."""
    from PIL import Image

    folder.mkdir(parents=True, exist_ok=True)
    text = folder / f"{name}.md"
    text.write_text(f"{report}\n", encoding="utf-8")
    said = [f"wrote {text}"]
    for file, image in report.images.items():
        Image.fromarray(image).save(folder / file)
        said.append(f"wrote {folder / file}")
    if report.draw is not None:
        said.append(_save_plot(report.draw, folder / f"{name}.png"))
    return said


def _save_plot(draw: Draw, path: Path) -> str:
    from examples.paper.common.plots import new_figure

    figure = new_figure()
    if figure is None:
        return f"skipped {path}: matplotlib is not installed (pip install 'rdstitch[examples]')"
    draw(figure)
    figure.savefig(path, dpi=120)
    return f"wrote {path}"
