"""What a figure is given, and what it gives: tables that read as text and as Markdown, a plot, and images."""

import enum
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

_SUFFIXES = (".jpg", ".jpeg", ".png", ".tif", ".tiff")


class Effort(enum.Enum):
    """TINY for tests, SMALL for a look (the default), FULL for the paper's counts."""

    TINY = enum.auto()
    SMALL = enum.auto()
    FULL = enum.auto()


@dataclass(frozen=True)
class Settings:
    """What every figure is given.

    ``peer_python``: Python that has the package stitching, which brings an OpenCV of its own; the one that runs if not
    given.
    """

    effort: Effort
    images: Path  # folder of the real sequences (``garfield_red``, ``copr``); figures do without those that are absent
    peer_python: str | None = None
    hpatches: Path | None = None  # folder of HPatches' sequences

    def count(self, tiny: int, small: int, full: int) -> int:
        """The one of three counts that the effort allows."""
        return {Effort.TINY: tiny, Effort.SMALL: small, Effort.FULL: full}[self.effort]

    def real_sequence(self, name: str) -> list[Path]:
        """Files of a real sequence in the order of their names; none where it is absent."""
        folder = self.images / name
        if not folder.is_dir():
            return []
        return sorted(path for path in folder.iterdir() if path.suffix.lower() in _SUFFIXES)


Draw = Callable[[Any], None]
"""Draws on a matplotlib Figure."""

Pixels = NDArray[np.uint8]


@dataclass(frozen=True)
class Table:
    """Measured numbers."""

    title: str
    header: tuple[str, ...]  # names of the columns, with their units
    rows: tuple[tuple[object, ...], ...]  # text and numbers; a number is printed with three digits, None as a dash

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
    from examples.paper.common.report import new_figure

    figure = new_figure()
    if figure is None:
        return f"skipped {path}: matplotlib is not installed (pip install matplotlib)"
    draw(figure)
    figure.savefig(path, dpi=120)
    return f"wrote {path}"


_MARKED = 20


def new_figure() -> Any | None:
    """An empty Figure, or None where matplotlib is not installed."""
    try:
        module = import_module("matplotlib.figure")
    except ModuleNotFoundError:
        return None
    return module.Figure(figsize=(9.6, 4.0), layout="constrained")


def histograms(axes: Any, samples: Mapping[str, ArrayLike], label: str) -> None:
    """Outlined histograms of log10 of positive samples; what is 0 or not finite is put at the edges."""
    bins = np.linspace(-17.0, 1.0, 73)
    for name, values in samples.items():
        with np.errstate(divide="ignore"):
            logs = np.clip(np.log10(np.asarray(values, dtype=np.float64)), bins[0], bins[-1])
        axes.hist(logs, bins=bins, weights=np.full(len(logs), 1.0 / len(logs)), histtype="step", label=name)
    axes.set_xlabel(label)
    axes.set_ylabel("share of instances")
    axes.set_yscale("log")
    axes.legend(fontsize=7)


def curves(
    axes: Any, x: ArrayLike, series: Mapping[str, Sequence[float]], xlabel: str, ylabel: str, *, log: bool = False
) -> None:
    """One line a series over common abscissae; places are marked where there are few."""
    marker = "." if np.size(x) <= _MARKED else ""
    for name, values in series.items():
        axes.plot(x, values, marker=marker, label=name)
    if log:
        axes.set_yscale("log")
    axes.set_xlabel(xlabel)
    axes.set_ylabel(ylabel)
    axes.grid(alpha=0.3)
    axes.legend(fontsize=7)
