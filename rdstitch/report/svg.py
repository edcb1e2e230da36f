"""Small pieces of SVG and HTML as text, and small images as data addresses."""

import base64
from collections.abc import Iterable
from html import escape
from typing import Any

import numpy as np

from rdstitch.arrays import AnyArray, FloatArray
from rdstitch.errors import InputError
from rdstitch.inputs.source import Source
from rdstitch.io.preview import encode_preview
from rdstitch.io.reduction import fitting_reduction

_VOID = ("img",)


class Markup(str):
    """Text that is HTML or SVG already; every other text is escaped where it becomes a part of some."""

    __slots__ = ()


Content = str | Iterable["Content"]

BLUE, GREEN, RED, GREY, YELLOW = "#2463a8", "#2a9d4a", "#c8352b", "#8a8f98", "#ffd92f"


def joined(*content: Content) -> Markup:
    """Markup and texts, or lists of them, one after the other; texts are escaped."""
    parts = (item if isinstance(item, str) else joined(*item) for item in content)
    return Markup("".join(part if isinstance(part, Markup) else escape(part) for part in parts))


def element(name: str, *content: Content, **attributes: Any) -> Markup:
    """One element; ``stroke_width`` becomes ``stroke-width``, ``class_`` becomes ``class``."""
    texts = {
        key: f"{value:.2f}" if isinstance(value, float) else escape(str(value)) for key, value in attributes.items()
    }
    given = "".join(f' {key.rstrip("_").replace("_", "-")}="{text}"' for key, text in texts.items())
    return Markup(f"<{name}{given}>" if name in _VOID else f"<{name}{given}>{joined(*content)}</{name}>")


def drawing(width: float, height: float, parts: Content, title: str) -> Markup:
    """A drawing that is as wide as there is room."""
    return element(
        "svg",
        element("title", title),
        parts,
        xmlns="http://www.w3.org/2000/svg",
        viewBox=f"0 0 {width:.1f} {height:.1f}",
        role="img",
        style=f"max-width:{width:.0f}px",
    )


def line(start: Iterable[float], end: Iterable[float], *content: Content, **attributes: Any) -> Markup:
    """A straight line between two points."""
    (x1, y1), (x2, y2) = map(float, start), map(float, end)
    return element("line", *content, x1=x1, y1=y1, x2=x2, y2=y2, **attributes)


def label(x: float, y: float, text: str, **attributes: Any) -> Markup:
    """A text at a place."""
    return element("text", text, x=x, y=y, **{"font_size": 12, **attributes})


def polyline(points: FloatArray, closed: bool = False, **attributes: Any) -> Markup:
    """A line through points (N, 2); points that are not finite interrupt it."""
    pieces, lifted = [], True
    for x, y in points:
        if not (np.isfinite(x) and np.isfinite(y)):
            lifted = True
            continue
        pieces.append(f"{'M' if lifted else 'L'}{x:.1f},{y:.1f}")
        lifted = False
    return element("path", d=" ".join(pieces) + ("Z" if closed else ""), **{"fill": "none", **attributes})


def table(rows: Iterable[Iterable[str]], header: Iterable[str] = ()) -> Markup:
    """A table of texts."""
    head = [element("th", cell) for cell in header]
    lines = (element("tr", (element("td", cell) for cell in row)) for row in rows)
    return element("table", element("tr", head) if head else "", lines)


def counted(count: int, one: str) -> str:
    """A number with its noun: "1 pair", "2 pairs"."""
    return f"{count} {one if count == 1 else one + 's'}"


def section(title: str, explanation: str, *content: Content) -> Markup:
    """A part of the page with its heading."""
    explained = element("p", explanation) if explanation else ""
    return element("section", element("h2", title), explained, *content)


def of_source(source: Source, side: int) -> str | None:
    """A thumbnail of an input image; None where it is gone, as frames of videos are."""
    try:
        reduction = fitting_reduction(max(source.camera.image_size) / (2 * side))
        return data_address(source.read(reduction).pixels, side)
    except InputError:
        return None


def data_address(pixels: AnyArray, side: int) -> str:
    """An image of any sample type as JPEG inside a ``data:`` address, its longer side at most ``side`` pixels."""
    return "data:image/jpeg;base64," + base64.b64encode(encode_preview(pixels, side)).decode("ascii")
