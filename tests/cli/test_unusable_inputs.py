"""Inputs that are damaged, missing, or vanish: one line that names the file, the right status, nothing written."""

import json
import os
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from rdstitch.inputs import source as sources
from rdstitch.io import Metadata, read_metadata
from rdstitch.pipeline import accept
from rdstitch.verification.verdict import judge
from tests.cli.faulty import UNREADABLE, UNUSABLE
from tests.cli.running import CACHED, Run, check_refused, finished, shown, start, state_of


@pytest.mark.parametrize(("kind", "status"), [*((kind, 3) for kind in UNREADABLE), *((kind, 4) for kind in UNUSABLE)])
def test_inputs_that_are_refused(rdstitch: Run, place: Path, kind: str, status: int) -> None:
    bad = {**UNREADABLE, **UNUSABLE}[kind](place / "b.png", place)
    before = state_of(place)
    done = rdstitch("pano", "-o", place / "out.png", *CACHED, place / "a.png", bad)
    check_refused(done, status, bad if status == 3 else bad.name)
    assert state_of(place) == before


@pytest.mark.parametrize("kind", ["missing", "name that is not UTF-8", "JPEG cut at 50%", "one pixel", "black"])
def test_a_mosaic_leaves_them_out_by_name(rdstitch: Run, place: Path, kind: str) -> None:
    bad = {**UNREADABLE, **UNUSABLE}[kind](place / "b.png", place)
    done = rdstitch("mosaic", place / "a.png", place / "b.png", bad, "-o", place / "out.jpg", *CACHED)
    assert done.status == 0, done.err
    assert shown(bad) in done.line
    assert (place / "out.jpg").stat().st_size > 1000


@pytest.mark.parametrize(
    "name",
    [
        "two\nlines.png",
        os.fsdecode(b"caf\xe9.png"),
        "-o.png",
        "[1]*.png",
        *(pytest.param(name, marks=pytest.mark.slow) for name in ("a b.png", "it's.png", 'say "x".png', "π.png")),
    ],
)
def test_odd_names_work(place: Path, name: str) -> None:
    image, output = place / name, place / f"out {name}"
    (place / "b.png").rename(image)
    done = finished(start("pano", place / "a.png", image, "-o", output, *CACHED))
    assert (done.status, done.err) == (0, "")
    assert output.exists()
    record = json.loads(Path(f"{output}.json").read_text(encoding="utf-8"))
    assert len(record["images"]) == 2


def test_one_image_or_the_same_twice(rdstitch: Run, place: Path) -> None:
    (place / "link.png").symlink_to("a.png")
    for images in (["a.png"], ["a.png", "a.png"], ["a.png", "link.png"]):
        done = rdstitch("pano", *(place / name for name in images), "-o", place / "out.png", *CACHED)
        assert done.status == 2
        assert "two different images" in done.line


@pytest.mark.parametrize("command", ["mosaic", "calibrate", "trajectory"])
def test_a_failure_names_what_could_not_be_read(rdstitch: Run, place: Path, stranger: Path, command: str) -> None:
    (place / "empty.png").write_bytes(b"")
    (place / "half.png").write_bytes((place / "b.png").read_bytes()[:3000])
    arguments = (place / "a.png", stranger, place / "empty.png", place / "half.png", "-o", place / "out.json")
    if command == "mosaic":
        arguments = (*arguments[:-1], place / "out.png")
    done = rdstitch(command, *arguments, *CACHED)
    assert done.status == 4
    assert "no two images overlap" in done.line
    assert "empty.png: is empty" in done.line
    assert "half.png: " in done.line


def test_no_overlap(rdstitch: Run, place: Path, stranger: Path) -> None:
    before = state_of(place)
    done = rdstitch("pano", place / "a.png", stranger, "-o", place / "out.png", *CACHED)
    check_refused(done, 4, stranger.name)
    assert state_of(place) == before


@pytest.mark.parametrize("name", ["empty", "nothing", "missing.txt", "*.nothing"])
def test_inputs_that_name_nothing(rdstitch: Run, place: Path, name: str) -> None:
    (place / "empty").mkdir()
    (place / "nothing").mkdir()
    (place / "nothing" / "notes.txt").write_text("no images", encoding="utf-8")
    named = f"@{place / name}" if name.endswith(".txt") else str(place / name)
    check_refused(rdstitch("mosaic", named, "-o", place / "out.png", *CACHED), 3, place / name)


@pytest.mark.parametrize(
    "content",
    [
        "",
        "text",
        "[]",
        "null",
        "{}",
        '{"format": "rdstitch camera", "version": 99}',
        '{"format": "rdstitch camera", "version": 1, "image_size": [400, 300], "center_px": [1, 2], "lambda": NaN}',
        '{"format": "rdstitch camera", "version": 1, "image_size": [400, 300], "center_px": [1, 2], "lambda": 5}',
        '{"format": "rdstitch camera", "version": 1, "image_size": [1e400, 3], "center_px": [1, 2], "lambda": 0}',
        '{"format": "rdstitch camera", "version": 1, "image_size": "wide", "center_px": [1, 2], "lambda": 0}',
        "\udcff\udcfe",
        "[" * 100000,
    ],
)
def test_camera_files_that_are_none(rdstitch: Run, place: Path, content: str) -> None:
    file = place / "camera.json"
    file.write_bytes(content.encode("utf-8", "surrogateescape"))
    done = rdstitch("pano", place / "a.png", place / "b.png", "-o", place / "out.png", "--camera", file, *CACHED)
    check_refused(done, 3, file)


def test_an_image_that_may_not_be_read(rdstitch: Run, place: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    allowed = os.access
    monkeypatch.setattr(os, "access", lambda path, mode: Path(path).name != "b.png" and allowed(path, mode))
    done = rdstitch("pano", place / "a.png", place / "b.png", "-o", place / "out.png", *CACHED)
    check_refused(done, 3, place / "b.png")


def test_an_image_vanishes_after_its_header_was_read(
    rdstitch: Run, place: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def vanish(path: Path) -> Metadata:
        found = read_metadata(path)
        if path.name == "b.png":
            path.unlink()
        return found

    monkeypatch.setattr(sources, "read_metadata", vanish)
    done = rdstitch("pano", place / "a.png", place / "b.png", "-o", place / "out.png", *CACHED)
    check_refused(done, 3, place / "b.png")
    assert sorted(state_of(place)) == ["a.png"]


@pytest.mark.parametrize("change", ["vanishes", "shrinks"])
def test_an_image_changes_after_its_registration(
    rdstitch: Run, place: Path, monkeypatch: pytest.MonkeyPatch, change: str
) -> None:
    def spoil(*arguments: Any, **options: Any) -> Any:
        verdict = judge(*arguments, **options)
        if change == "vanishes":
            (place / "b.png").unlink()
        else:
            assert cv2.imwrite(str(place / "b.png"), np.zeros((30, 40), np.uint8))
        return verdict

    monkeypatch.setattr(accept, "judge", spoil)
    done = rdstitch("pano", place / "a.png", place / "b.png", "-o", place / "out.png", *CACHED)
    check_refused(done, 3, place / "b.png")
    assert not (place / "out.png").exists()
