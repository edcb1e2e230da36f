"""``--report``: one self-contained page, well-formed, made from the result alone."""

import base64
import io
import re
from collections.abc import Iterator
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

from rdstitch.compositing import CompositeOptions
from rdstitch.compositing.seam_quality import SeamQuality
from rdstitch.io import preview
from rdstitch.io.metadata import Metadata
from rdstitch.io.opening import MAX_IMAGE_GB
from rdstitch.io.write import write_image
from rdstitch.options.stitch_options import StitchOptions
from rdstitch.pipeline import recipes
from rdstitch.pipeline.recipes import calibrate, pano
from rdstitch.pipeline.registration import accept
from rdstitch.report import mosaic as report
from rdstitch.report import report_page, write_report
from rdstitch.report.mosaic import seam_dots
from rdstitch.report.pairs import matched
from rdstitch.results.messages import Message, left_out
from rdstitch.results.registration import Registration
from rdstitch.results.stitch_result import StitchResult
from rdstitch.verification.findings import Kind
from rdstitch.verification.verdict import RefusedError
from tests.cli.running import CACHED, OPTIONS, Run, copied
from tests.registrations import finding

_VOID = {"meta", "img"}
_SECTIONS = ["Summary", "Warnings and left-out images", "Mosaic", "Match graph", "Votes on λ", "Lens curve"]
_SECTIONS[3:3] = ["Local alignment"]
_SECTIONS += ["Matches", "Residuals", "Run"]
_OF_IMAGES = ("Mosaic", "Local alignment")


class _Page(HTMLParser):
    """Checks that every element is closed, and keeps what the tests ask for."""

    def __init__(self, text: str) -> None:
        super().__init__(convert_charrefs=True)
        self.open: list[str] = []
        self.headings: list[str] = []
        self.sources: list[str] = []
        self.words: list[str] = []
        self.counts: dict[str, int] = {}
        self.feed(text)
        self.close()
        assert self.open == []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.counts[tag] = self.counts.get(tag, 0) + 1
        self.sources += [value or "" for name, value in attrs if name in ("src", "href")]
        assert not any(value and "nan" in value for name, value in attrs if name in ("d", "x", "y", "x1", "points"))
        if tag not in _VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.counts[tag] = self.counts.get(tag, 0) + 1

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag, self.getpos()

    def handle_data(self, data: str) -> None:
        if self.open and self.open[-1] == "h2":
            self.headings.append(data)
        self.words.append(data)

    @property
    def text(self) -> str:
        return " ".join(self.words)


def _checked(text: str) -> _Page:
    page = _Page(text)
    # Nothing outside of the file: only data, and names of namespaces.
    assert all(source.startswith("data:image/jpeg;base64,") for source in page.sources)
    assert not re.search(r"<script|<link|<iframe|@import|url\((?!#)", text)
    assert set(re.findall(r"https?://[^\"'<\s]+", text)) <= {"http://www.w3.org/2000/svg"}
    return page


@pytest.fixture(scope="module")
def reported(frames: list[Path], stranger: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A report of a mosaic that left out an image; never written to."""
    from rdstitch_cli.main import run

    report = tmp_path_factory.mktemp("report") / "report.html"
    images = [*map(str, frames), str(stranger)]
    assert run(["mosaic", *images, "-o", str(report.with_name("out.png")), "--report", str(report), *CACHED]) == 0
    return report


@pytest.fixture(scope="module")
def pair(frames: list[Path]) -> StitchResult:
    return pano(frames[:2], options=OPTIONS)


def test_a_mosaic_has_every_section(reported: Path, stranger: Path, frames: list[Path]) -> None:
    page = _checked(reported.read_text(encoding="utf-8"))
    assert page.headings == _SECTIONS
    assert "3 of 4" in page.text
    assert str(stranger) in page.text
    assert re.search(r"-0\.(19|20)\d+ ± 0\.0", page.text)
    for stage in ("detecting features", "matching", "registering pairs", "compositing"):
        assert re.search(rf"{stage} +\d+\.\d\d s", page.text)
    # The image left out; mosaic; two pairs of images.
    assert (page.counts["img"], page.counts["image"]) == (1, 5)
    assert "command" in page.text
    assert all(frame.name in page.text for frame in frames)


def test_the_largest_displacement_is_told(frames: list[Path]) -> None:
    options = replace(OPTIONS, local_alignment=6)
    result = pano(frames[:2], options=options)
    told = report_page(result).split("<h2>Local alignment</h2>")[1].split("</section>")[0]
    farthest = max(field.largest for field in result.local_alignment.fields)
    assert f"by up to {farthest:.1f} pixels" in told
    assert "matches that decided, held out of the fit" in told
    off = report_page(pano(frames[:2], options=replace(options, local_alignment="off")))
    assert "the alignment puts them: switched off" in off


def test_the_numbers_are_those_of_the_result(pair: StitchResult) -> None:
    page = _checked(report_page(pair))
    (fit,) = pair.registration.alignment.links
    assert f"{fit.inliers} of {pair.registration.pairs[0].relation.inliers.sum()} inliers" in page.text
    assert f"{pair.distortion:.6f} ± {pair.registration.alignment.distortion_std:.6f}" in page.text
    assert "{} x {} pixels".format(*pair.canvas.size) in page.text
    # One pair is best and worst.
    assert "The pair: " in page.text
    assert pair.composite is not None
    # Outlines and the pair over them; nothing is drawn twice.
    graph = report_page(pair).split("<h2>Match graph</h2>")[1].split("</section>")[0]
    assert (graph.count("<path"), graph.count("<line"), graph.count("<circle")) == (2, 1, 2)


def test_what_is_many_is_not_all_shown(pair: StitchResult, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("rdstitch.report.page._MAX_THUMBNAILS", 1)
    monkeypatch.setattr("rdstitch.report.pairs._MAX_LINKS", 1)
    registration, names = pair.registration, [str(source.path) for source in pair.registration.sources]
    (fit,) = registration.alignment.links
    many = replace(registration, alignment=replace(registration.alignment, links=(fit, fit)))
    page = report_page(many.with_messages([left_out(name, "is alike") for name in names]))
    assert "2 pairs, of which 1 of all errors are drawn, over" in page
    graph, listed = (page.split(f"<h2>{title}")[1].split("</section>")[0] for title in ("Match graph", "Warnings"))
    assert (graph.count("<line"), listed.count("<img")) == (1, 1)
    assert f"without a picture: left out {names[1]}: is alike" in listed


def test_what_its_seams_refuse_is_shown(
    rdstitch: Run, frames: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(registration: Registration, *_: object) -> None:
        raise RefusedError(registration.with_messages([Message("no more alike than anywhere", severity="failure")]))

    monkeypatch.setattr(recipes, "choose_layout", refuse)
    report = tmp_path / "report.html"
    rdstitch("mosaic", *frames[:2], "-o", tmp_path / "out.png", "--report", report, *CACHED, status=4)
    assert "no more alike than anywhere" in _checked(report.read_text(encoding="utf-8")).text


@pytest.mark.parametrize(("command", "output"), [("mosaic", "out.png"), ("calibrate", "lens.json")])
def test_what_is_refused_is_shown(
    rdstitch: Run, frames: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, command: str, output: str
) -> None:
    said = [Message("the images <disagree>", severity="failure"), Message("look at that seam")]
    monkeypatch.setattr(accept, "judge", lambda *arguments, **options: (finding(Kind.ERRORS),))
    monkeypatch.setattr(accept, "messages_of", lambda *arguments: said)
    report = tmp_path / "report.html"
    arguments = (command, *frames[:2], "-o", tmp_path / output, "--report", report, *CACHED)
    rdstitch(*arguments, status=4)
    assert not (tmp_path / output).exists()
    refused = _checked(report.read_text(encoding="utf-8"))
    assert refused.headings == [heading for heading in _SECTIONS if heading not in _OF_IMAGES]
    assert "Not to be relied on: the images <disagree>" in refused.text
    assert "look at that seam" in refused.text
    rdstitch(*arguments, "--force", "--overwrite")
    forced = _checked(report.read_text(encoding="utf-8"))
    assert ("Mosaic" in forced.headings) == (command != "calibrate")
    assert "the images <disagree>" in forced.text


def test_names_are_escaped_and_vanished_images_do_not_matter(frames: list[Path], tmp_path: Path) -> None:
    names = ["<b>&\"bold'.png", "caf\udce9<.png"]
    images = copied(frames, tmp_path, *names)
    registration = calibrate(images, StitchOptions(workers=1, distortion=-0.2))
    for image in images:
        image.unlink()
    write_report(tmp_path / "report.html", registration)
    page = _checked((tmp_path / "report.html").read_text(encoding="utf-8"))
    assert names[0] in page.text
    assert "caf\\udce9<.png" in page.text
    assert "b" not in page.counts
    assert "(given)" in page.text
    assert "no pair voted" in page.text
    assert page.sources == []


def test_overviews_are_read(rdstitch: Run, frames: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    result = pano(frames[:2], tmp_path / "large.tif", replace(OPTIONS, composite=CompositeOptions(scale=3.0)))
    monkeypatch.setattr(report, "_MOSAIC_SIDE", 300)
    whole = _decoded(report._thumbnail(result, result.output))
    monkeypatch.setattr(preview, "_OVERVIEW_FROM", 1000)
    monkeypatch.setattr(preview, "read_image", None)
    overview = _decoded(report._thumbnail(result, result.output))
    assert max(whole.shape[:2]) == max(overview.shape[:2]) == 300
    # Sides of an overview are rounded up.
    height = min(len(whole), len(overview))
    assert abs(len(whole) - len(overview)) <= 1
    assert np.abs(overview[:height].astype(float) - whole[:height]).mean() < 12.0


def test_the_overview_of_channels_on_pages_of_their_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(preview, "_OVERVIEW_FROM", 0)
    file, size = tmp_path / "channels.ome.tif", (1600, 400)
    write_image(file, np.zeros((400, 1600, 2), np.uint8), metadata=Metadata(size, channels=2, planes=True))
    assert preview.read_preview(file, size, 700)[0].shape == (200, 800, 2)


def _decoded(address: str | None) -> NDArray[np.uint8]:
    return np.asarray(Image.open(io.BytesIO(base64.b64decode(address.split(",")[1]))))


def test_the_best_pair_has_many_matches(frames: list[Path]) -> None:
    result = pano(frames, options=OPTIONS)
    links = result.registration.alignment.links
    few = replace(links[0], inliers=22, rms=0.001)
    alignment = replace(result.registration.alignment, links=(few, *links[1:]))
    shown = matched(replace(result.registration, alignment=alignment))
    names = [frames[k].name for k in (few.image1, few.image2)]
    assert f"Best pair: {' and '.join(names)}" not in shown
    assert "Best pair: " in shown


def test_of_too_large_an_image_it_is_said(pair: StitchResult, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(MAX_IMAGE_GB, "0.0001")
    for suffix, shown in ((".jpg", True), (".png", False)):
        file = tmp_path / f"large{suffix}"
        Image.new("RGB", pair.canvas.size, (10, 200, 30)).save(file)
        page = report_page(replace(pair, composite=None, output=file))
        assert ("too large to be shown here" in page) is not shown
        assert "Match graph" in page


def test_tiles_in_a_folder_are_not_called_too_large_and_pairs_are_looked_through_once(
    pair: StitchResult, tmp_path: Path
) -> None:
    looked_through = []

    class Pairs(tuple[Any, ...]):
        __slots__ = ()

        def __iter__(self) -> Iterator[Any]:
            looked_through.append(self)
            return super().__iter__()

    registration = pair.registration
    alignment = replace(registration.alignment, links=registration.alignment.links * 40)
    registration = replace(registration, alignment=alignment, pairs=Pairs(registration.pairs))
    page = report_page(replace(pair, composite=None, output=tmp_path / "a.zarr", registration=registration))
    assert "a folder of tiles, which is not shown here" in page
    assert len(looked_through) < 20


def test_the_dots_of_a_thousand_seams_are_as_many_as_can_be_told_apart_and_hide_no_break() -> None:
    places = np.stack(np.meshgrid(np.arange(0, 20_000, 8.0), np.arange(0, 10_000, 100.0)), axis=-1).reshape(-1, 2)
    broken = np.arange(len(places)) == 123_456
    dots = seam_dots(SeamQuality(places, broken=broken, spacing=8.0), 0.06, 12.0)
    assert len(dots) <= 5000
    ((x, y, _),) = [dot for dot in dots if dot[2]]
    np.testing.assert_allclose((x, y), (places[broken][0] + 0.5) * 0.06)
    assert seam_dots(SeamQuality(), 1.0, 3.0) == []
