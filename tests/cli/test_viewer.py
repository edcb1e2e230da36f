"""The page beside a Deep Zoom image, and what the project's wheel weighs with it."""

import io
import json
import re
import shutil
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from rdstitch.compositing.seam_finder import SeamMap
from rdstitch.report import svg
from rdstitch.viewer.page import ViewedImage, seam_image, viewer_page
from tests.cli.running import CACHED, Run, sidecar_of

_ROOT = Path(__file__).parents[2]
_BROWSERS = ("chromium", "chromium-browser", "google-chrome")


@pytest.fixture
def page(rdstitch: Run, frames: list[Path], tmp_path: Path) -> Path:
    """The page of a small mosaic."""
    rdstitch("mosaic", *frames, "-o", tmp_path / "x.dzi", *CACHED)
    return tmp_path / "x.html"


def _data(page: Path) -> dict[str, Any]:
    found = re.search(r'<script type="application/json" id="data">(.*?)</script>', page.read_text(encoding="utf-8"))
    data: dict[str, Any] = json.loads(found[1])
    return data


def test_the_page_knows_its_images_and_is_alone(rdstitch: Run, page: Path, frames: list[Path], tmp_path: Path) -> None:
    data, text = _data(page), page.read_text(encoding="utf-8")
    assert data["size"] == sidecar_of(tmp_path / "x.dzi")["output"]["size"]
    assert data["metres"] is None
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

    rdstitch("apply", tmp_path / "x.dzi.json", "--images", frames[0].parent, "-o", tmp_path / "y.dzi")
    assert len(_data(tmp_path / "y.html")["images"]) == 3


@pytest.mark.parametrize("name", ["<!--<script>.jpg", "</script>.jpg", "]]>&amp;.jpg"])
def test_a_name_ends_no_script_and_hides_no_end(name: str, tmp_path: Path) -> None:
    outline = np.random.default_rng(0).uniform(0.0, 9.0, (127, 2))
    text = viewer_page("x.dzi", (10, 10), [ViewedImage(name, [outline], (("pairs", name),))])
    (tmp_path / "x.html").write_text(text, encoding="utf-8")
    image = _data(tmp_path / "x.html")["images"][0]
    assert image["name"] == name
    assert len(image["outlines"][0]) <= 64
    assert "<" not in text.partition('id="data">')[2].partition("</script>\n<script>")[0]
    assert "<script>.jpg" not in svg.element("b", name)  # of a report


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
    assert re.search(r'<g transform="matrix\(0\.\d+', done.stdout)


@pytest.mark.parametrize(("unit", "length"), [(1.0, 100.0), (0.02, 5000.0), (31.0, 2.0), (160.0, 0.5)])
def test_the_scale_bar_has_a_round_length_that_fits(unit: float, length: float) -> None:
    node = shutil.which("node")
    if node is None:
        pytest.skip("there is no Node.js")
    script = (_ROOT / "rdstitch" / "viewer" / "viewer.js").read_text(encoding="utf-8")
    assert subprocess.run([node, "--check", "-"], input=script, text=True, check=False).returncode == 0
    found = re.search(r"^const barLength = .*?^};", script, re.MULTILINE | re.DOTALL)
    code = f"{found[0]} console.log(barLength({unit}, 150));"
    done = subprocess.run([node, "-e", code], capture_output=True, text=True, check=True)
    assert float(done.stdout) == pytest.approx(length)


def test_seams_are_where_labels_change() -> None:
    labels = np.full((4, 6), -1, dtype=np.int32)
    labels[:3, :3], labels[:3, 3:5] = 0, 1
    data, box = seam_image(SeamMap(labels, 2), (2, 0), (10, 8))
    shown = np.asarray(Image.open(io.BytesIO(data)))[..., 3] > 0
    assert box == (0.0, 0.0, 10.0, 8.0)
    assert shown.shape == (4, 5)
    assert np.argwhere(shown).tolist() == [[0, 1], [1, 1], [2, 1]]  # not where an image ends at nothing
