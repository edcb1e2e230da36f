"""Small pieces of SVG and HTML, as text."""

from collections.abc import Iterable, Sequence
from html import escape
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rdstitch.arrays import FloatArray

_VOID = ("img",)
BLUE, GREEN, RED, GREY, YELLOW = "#2463a8", "#2a9d4a", "#c8352b", "#8a8f98", "#ffd92f"


def element(name: str, content: str = "", **attributes: Any) -> str:
    """One element; ``stroke_width`` becomes ``stroke-width``, ``class_`` becomes ``class``."""
    given = "".join(f' {key.rstrip("_").replace("_", "-")}="{_text(value)}"' for key, value in attributes.items())
    return f"<{name}{given}>" if name in _VOID else f"<{name}{given}>{content}</{name}>"


def drawing(width: float, height: float, parts: Iterable[str], title: str) -> str:
    """A drawing that is as wide as there is room."""
    return element(
        "svg",
        element("title", escape(title)) + "".join(parts),
        xmlns="http://www.w3.org/2000/svg",
        viewBox=f"0 0 {width:.1f} {height:.1f}",
        role="img",
        style=f"max-width:{width:.0f}px",
    )


def line(start: Iterable[float], end: Iterable[float], content: str = "", **attributes: Any) -> str:
    """A straight line between two points."""
    (x1, y1), (x2, y2) = map(float, start), map(float, end)
    return element("line", content, x1=x1, y1=y1, x2=x2, y2=y2, **attributes)


def label(x: float, y: float, text: str, **attributes: Any) -> str:
    """A text at a place."""
    return element("text", escape(text), x=x, y=y, **{"font_size": 12, **attributes})


def path(points: FloatArray, closed: bool = False, **attributes: Any) -> str:
    """A line through points (N, 2); points that are not finite interrupt it."""
    pieces, lifted = [], True
    for x, y in points:
        if not (np.isfinite(x) and np.isfinite(y)):
            lifted = True
            continue
        pieces.append(f"{'M' if lifted else 'L'}{x:.1f},{y:.1f}")
        lifted = False
    return element("path", d=" ".join(pieces) + ("Z" if closed else ""), **{"fill": "none", **attributes})


def table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A table of texts, which are escaped."""
    top = "".join(element("th", escape(text)) for text in head)
    body = "".join(element("tr", "".join(element("td", escape(cell)) for cell in row)) for row in rows)
    return element("table", (element("tr", top) if head else "") + body)


def counted(count: int, one: str) -> str:
    """A number with its noun: "1 pair", "2 pairs"."""
    return f"{count} {one if count == 1 else one + 's'}"


def section(title: str, explanation: str, *content: str) -> str:
    """A part of the page with its heading."""
    return element("section", element("h2", escape(title)) + element("p", escape(explanation)) + "".join(content))


def fit_into(points: NDArray[np.float64], side: float, margin: float) -> tuple[FloatArray, float, tuple[float, float]]:
    """Shift, scale and size that bring points (N, 2) into a drawing whose longer side is given.

    A point ``p`` goes to ``(p + shift) * scale``.
    """
    low, high = np.nanmin(points, axis=0), np.nanmax(points, axis=0)
    extent = np.maximum(high - low, 1e-9)
    scale = float((side - 2 * margin) / extent.max())
    width, height = extent * scale + 2 * margin
    return margin / scale - low, scale, (float(width), float(height))


def _text(value: Any) -> str:
    if isinstance(value, float):
        return f"{value:.2f}"
    return escape(str(value))
