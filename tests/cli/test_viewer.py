"""The page beside a Deep Zoom image, and what the project's wheel weighs with it."""

import io
import json
import re
import shutil
import subprocess
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rdstitch.compositing.seam_finder import SeamMap
from rdstitch.io import read_image
from rdstitch.viewer.page import seam_image
from tests.cli.running import CACHED, Run

_ROOT = Path(__file__).parents[2]
_BROWSERS = ("chromium", "chromium-browser", "google-chrome")


@pytest.fixture
def page(rdstitch: Run, frames: list[Path], tmp_path: Path) -> Path:
    """The page of a small mosaic."""
    assert rdstitch("mosaic", *frames, "-o", tmp_path / "x.dzi", *CACHED).status == 0
    return tmp_path / "x.html"


def _data(page: Path) -> dict[str, Any]:
    found = re.search(r'<script type="application/json" id="data">(.*?)</script>', page.read_text(encoding="utf-8"))
    assert found is not None
    data: dict[str, Any] = json.loads(found[1])
    return data


def test_the_page_knows_the_images_and_needs_no_network(
    rdstitch: Run, page: Path, frames: list[Path], tmp_path: Path
) -> None:
    data, text = _data(page), page.read_text(encoding="utf-8")
    record = json.loads((tmp_path / "x.dzi.json").read_text(encoding="utf-8"))
    assert data["size"] == record["output"]["size"]
    assert [image["name"] for image in data["images"]] == [frame.name for frame in frames]
    corners = np.concatenate([outline for image in data["images"] for outline in image["outlines"]])
    assert corners.min() >= -1
    assert (corners.max(axis=0) <= np.array(data["size"]) + 1).all()
    assert dict(data["images"][1]["facts"])["size"] == "400 x 300 pixels"
    assert frames[0].name in dict(data["images"][1]["facts"])["pairs"]
    assert data["seams"].startswith("data:image/png;base64,")
    assert (tmp_path / data["tiles"]["Image"]["Url"] / "0" / "0_0.jpg").is_file()
    assert not re.search(r'(?:src|href)="https?:', text)
    assert "Redistribution and use in source and binary forms" in text

    again = rdstitch("apply", tmp_path / "x.dzi.json", "--images", frames[0].parent, "-o", tmp_path / "y.dzi")
    assert again.status == 0
    assert len(_data(tmp_path / "y.html")["images"]) == 3


def test_a_page_that_exists_is_not_replaced_unasked(rdstitch: Run, frames: list[Path], tmp_path: Path) -> None:
    (tmp_path / "x.html").write_text("mine", encoding="utf-8")
    done = rdstitch("mosaic", *frames, "-o", tmp_path / "x.dzi", *CACHED)
    assert done.status == 6
    assert "x.html" in done.line
    assert not (tmp_path / "x.dzi").exists()


def test_in_a_browser(page: Path, tmp_path: Path) -> None:
    browser = next((found for name in _BROWSERS if (found := shutil.which(name))), None)
    if browser is None:
        pytest.skip("there is no Chromium")
    # A click on the middle of the second image, once the tiles are there.
    click = """<script>viewer.addHandler("open", () => {
      const [x, y] = images[1].center;
      const position = viewer.viewport.pixelFromPoint(new OpenSeadragon.Point(x / width, y / width));
      viewer.raiseEvent("canvas-click", { quick: true, position });
      document.title = `${svg.querySelectorAll("path").length} outlines`;
    });</script>"""
    clicked = tmp_path / "clicked.html"
    clicked.write_text(page.read_text(encoding="utf-8").replace("</body>", click + "</body>"), encoding="utf-8")
    done = subprocess.run(
        [browser, "--headless", "--no-sandbox", "--disable-gpu", "--virtual-time-budget=5000", "--dump-dom", clicked],
        capture_output=True,
        text=True,
        check=False,
        timeout=120,
    )
    assert "<title>3 outlines</title>" in done.stdout, done.stderr
    assert re.search(r'<div id="facts"><h2>frame_0001\.png</h2>.*400 x 300 pixels', done.stdout)
    assert re.search(r'<g transform="translate\([^)]*\) scale\(0\.\d+', done.stdout)


def test_seams_are_where_labels_change() -> None:
    labels = np.full((4, 6), -1, dtype=np.int32)
    labels[:3, :3], labels[:3, 3:5] = 0, 1
    data, box = seam_image(SeamMap(labels, 2), (2, 0), (10, 8))
    shown = read_shown(data)
    assert box == (0.0, 0.0, 10.0, 8.0)
    assert shown.shape == (4, 5)
    assert np.argwhere(shown).tolist() == [[0, 1], [1, 1], [2, 1]]  # not where an image ends at nothing


def read_shown(data: bytes) -> np.ndarray[tuple[int, ...], np.dtype[np.bool_]]:
    """Which pixels are opaque."""
    from PIL import Image

    return np.asarray(np.asarray(Image.open(io.BytesIO(data)))[..., 3] > 0)


def _packed_sizes() -> dict[str, int]:
    """Bytes of every file of the wheel, each compressed on its own as a wheel does it."""
    sizes = {}
    for folder in ("rdstitch", "cli/rdstitch_cli"):
        for file in (_ROOT / folder).rglob("*"):
            if file.is_file() and "__pycache__" not in file.parts:
                packed = io.BytesIO()
                with zipfile.ZipFile(packed, "w", zipfile.ZIP_DEFLATED) as archive:
                    archive.write(file, str(file.relative_to(_ROOT)))
                sizes[file.name if file.suffix == ".js" else str(file)] = len(packed.getvalue())
    return sizes


def test_the_wheel_is_small() -> None:
    assert 0 < sum(_packed_sizes().values()) <= 1_000_000


def test_the_page_is_no_report(rdstitch: Run, frames: list[Path], tmp_path: Path) -> None:
    done = rdstitch("mosaic", *frames, "-o", tmp_path / "x.dzi", "--report", tmp_path / "x.html", *CACHED)
    assert done.status == 6
    assert "two outputs" in done.line


def test_other_formats_have_no_page(rdstitch: Run, frames: list[Path], tmp_path: Path) -> None:
    assert rdstitch("pano", *frames[:2], "-o", tmp_path / "x.png", *CACHED).status == 0
    assert not (tmp_path / "x.html").exists()
    assert read_image(tmp_path / "x.png").pixels.size
