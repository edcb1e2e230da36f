"""A page to look at a Deep Zoom image: zoom and pan, outlines and names of the images, seams, what is known of them.

OpenSeadragon's released file, our script, and the data, all in one HTML file beside the tiles.
"""

import base64
import io
import json
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape
from importlib.resources import files
from pathlib import Path
from string import Template
from typing import Any
from urllib.parse import quote

import numpy as np
from PIL import Image

from rdstitch.arrays import FloatArray
from rdstitch.compositing.seam_finder import SeamMap
from rdstitch.io.deepzoom import OVERLAP, TILE
from rdstitch.system.output_checks import tiles_folder

_COLOUR = (0, 229, 255, 255)
_CORNERS = 64  # of an outline, at most


def seam_image(
    seams: SeamMap, origin: tuple[int, int], size: tuple[int, int]
) -> tuple[bytes, tuple[float, float, float, float]]:
    """Seams as PNG, and the box (x, y, width, height) that it fills, pixels of the mosaic from its corner."""
    factor = seams.factor
    left, top = origin[0] // factor, origin[1] // factor
    right, bottom = -(-(origin[0] + size[0]) // factor), -(-(origin[1] + size[1]) // factor)
    labels = seams.labels[top:bottom, left:right]
    samples = np.zeros((*labels.shape, 4), dtype=np.uint8)
    # Where an image ends at nothing there is no seam.
    samples[:, :-1][(labels[:, :-1] != labels[:, 1:]) & (np.minimum(labels[:, :-1], labels[:, 1:]) >= 0)] = _COLOUR
    samples[:-1][(labels[:-1] != labels[1:]) & (np.minimum(labels[:-1], labels[1:]) >= 0)] = _COLOUR
    x, y = float(left * factor - origin[0]), float(top * factor - origin[1])
    stream = io.BytesIO()
    Image.fromarray(samples).save(stream, "PNG", optimize=True)
    return stream.getvalue(), (x, y, float(labels.shape[1] * factor), float(labels.shape[0] * factor))


@dataclass(frozen=True, eq=False)
class ViewedImage:
    """What the page says of an image."""

    name: str
    # (K, 2): at each of its places; pixels of the mosaic, centre of the top-left one at (0, 0)
    outlines: Sequence[FloatArray]
    facts: tuple[tuple[str, str], ...]  # what is shown when the image is clicked


def viewer_path(output: str | Path) -> Path | None:
    """The page that belongs to an output; None where that is no pyramid of tiles."""
    path = Path(output)
    return path.with_suffix(".html") if path.suffix.lower() == ".dzi" else None


def viewer_page(
    output: str | Path,
    size: tuple[int, int],
    images: Sequence[ViewedImage],
    seams: SeamMap | None = None,
    origin: tuple[int, int] = (0, 0),
    gsd: float | None = None,
) -> str:
    """The page of a ``.dzi`` file, as HTML."""
    output = Path(output)
    data: dict[str, Any] = {
        "size": size,
        "metres": gsd,
        # As the .dzi file says; a page from the disk may not read it.
        "tiles": {
            "Image": {
                "xmlns": "http://schemas.microsoft.com/deepzoom/2008",
                "Url": quote(tiles_folder(output).name, errors="surrogateescape") + "/",
                "Format": "jpg",
                "Overlap": str(OVERLAP),
                "TileSize": str(TILE),
                "Size": {"Width": str(size[0]), "Height": str(size[1])},
            }
        },
        "images": [_described(image) for image in images],
    }
    if seams is not None:
        shown, box = seam_image(seams, origin, size)
        data["seams"] = "data:image/png;base64," + base64.b64encode(shown).decode("ascii")
        data["seamsBox"] = box
    title = escape(output.name)
    # Inside a script, "</script" would end it, and "<!--<script" hide its end.
    text = json.dumps(data, ensure_ascii=True).replace("<", "\\u003c")
    boxes = "".join(
        f'<label><input type="checkbox" id="show-{name}"> {name}</label>'
        for name in ("outlines", "names", "seams")
        if name != "seams" or seams is not None
    )
    return Template(_file("viewer.html")).substitute(
        title=title,
        boxes=boxes,
        data=text,
        css=_file("viewer.css"),
        license=_file("openseadragon.LICENSE.txt"),
        openseadragon=_file("openseadragon.min.js"),
        script=_file("viewer.js"),
    )


def _described(image: ViewedImage) -> dict[str, Any]:
    """For the script, which counts pixels from the corner of the first one."""
    outlines = [outline[:: max(1, -(-len(outline) // _CORNERS))] + 0.5 for outline in image.outlines]
    return {
        "name": image.name.encode("utf-8", "backslashreplace").decode("utf-8"),
        "outlines": [np.round(outline, 1).tolist() for outline in outlines],
        "centers": [np.round(outline.mean(axis=0), 1).tolist() for outline in outlines],
        "facts": [list(fact) for fact in image.facts],
    }


def _file(name: str) -> str:
    return files("rdstitch.viewer").joinpath(name).read_text(encoding="utf-8")
