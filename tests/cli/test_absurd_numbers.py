"""Numbers that no one means: a clear line and the documented status, no warning of NumPy, no hang."""

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from PIL import Image

from rdstitch.errors import ImpossibleCameraError
from rdstitch.pipeline import register
from tests.cli.running import CACHED, Run


def test_numbers_where_a_configuration_may_have_units(rdstitch: Run, frames: list[Path], tmp_path: Path) -> None:
    (tmp_path / "a.toml").write_text("[common]\nattitude-std = 1.0\nmax-memory = 800_000_000\n", encoding="utf-8")
    arguments = ("pano", *frames[:2], "-o", tmp_path / "out.png", *CACHED, "--config", tmp_path / "a.toml")
    assert rdstitch(*arguments).status == 0
    for value in ("-1.0", "nan", "true", "[1.0]"):
        (tmp_path / "a.toml").write_text(f"[common]\nattitude-std = {value}\n", encoding="utf-8")
        done = rdstitch(*arguments, "--overwrite")
        assert (done.status, "attitude-std" in done.line) == (3, True)


def _scaled(factor: float) -> Any:
    return (np.eye(3) * factor).tolist()


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("to_plane", _scaled(1e308)),
        ("to_plane", _scaled(1e-308)),
        ("to_plane", [[1, 0, 1e308], [0, 1, 0], [0, 0, 1]]),
        ("center_px", [1e308, 0.0]),
        ("focal_px", 1e308),
    ],
)
def test_sidecars(rdstitch: Run, frames: list[Path], tmp_path: Path, field: str, value: Any) -> None:
    sidecar = tmp_path / "a.png.json"
    assert rdstitch("pano", *frames[:2], "-o", tmp_path / "a.png", *CACHED).status == 0
    record = json.loads(sidecar.read_text(encoding="utf-8"))
    record["images"][1][field] = value
    sidecar.write_text(json.dumps(record), encoding="utf-8")
    done = rdstitch("apply", sidecar, "--images", frames[0].parent, "-o", tmp_path / "b.png", "-j", "1")
    assert (done.status, "images[1]" in done.line) == (3, True)


def test_an_impossible_estimate_is_no_wrong_usage(
    rdstitch: Run, frames: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*arguments: Any, **options: Any) -> None:
        raise ImpossibleCameraError("distortion -1.2 folds the image")

    monkeypatch.setattr(register, "separate_lenses", fail)
    done = rdstitch("pano", *frames[:2], "-o", tmp_path / "out.png", *CACHED)
    assert (done.status, "no reliable result" in done.line) == (4, True)


def test_no_memory_for_opencv(
    rdstitch: Run, frames: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*arguments: Any, **options: Any) -> None:
        cv2.resize(np.zeros((1000, 1000)), (2**20, 2**20))

    monkeypatch.setattr(register, "separate_lenses", fail)
    done = rdstitch("pano", *frames[:2], "-o", tmp_path / "out.png", *CACHED)
    assert (done.status, "out of memory" in done.line) == (7, True)


def test_webp_obeys_the_memory_limit(rdstitch: Run, frames: list[Path], tmp_path: Path) -> None:
    arguments = ("pano", *frames[:2], *CACHED, "--scale", "5", "--max-memory", "120M")
    done = rdstitch(*arguments, "-o", tmp_path / "out.webp")
    assert (done.status, "--max-memory allows 120 MB; write a .tif" in done.line) == (7, True)
    assert not list(tmp_path.iterdir())


def test_an_image_larger_than_the_memory_limit(rdstitch: Run, frames: list[Path], tmp_path: Path) -> None:
    large = tmp_path / "large.png"
    Image.new("RGB", (6000, 5000)).save(large)
    done = rdstitch("pano", frames[0], large, "-o", tmp_path / "out.png", *CACHED, "--max-memory", "100M")
    assert (done.status, f"{large}: 6000 x 5000 pixels need" in done.line) == (7, True)
    done = rdstitch("mosaic", *frames[:2], large, "-o", tmp_path / "out.png", *CACHED, "--max-memory", "100M")
    assert (done.status, f"left out {large}" in done.line) == (0, True)
