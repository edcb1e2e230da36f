"""``rdstitch pano``, run for real."""

import json
import math
from pathlib import Path

import numpy as np
import pytest

from examples.judging import alignment_error, compare_with_plane
from rdstitch.geometry.camera import Camera
from rdstitch.io.read import read_image
from rdstitch.synthetic import RenderedSequence
from tests.cli.running import CACHED, DISTORTION, FAST, Run, sidecar_of, transfers


def test_writes_image_sidecar_and_camera(
    rdstitch: Run, frames: list[Path], sequence: RenderedSequence, tmp_path: Path
) -> None:
    output, camera = tmp_path / "pano.png", tmp_path / "camera.json"
    done = rdstitch("pano", *frames, "-o", output, "--save-camera", camera, *CACHED, err="")
    assert done.out == f"{float(done.out):.6f}\n"
    assert abs(float(done.out) - DISTORTION) < 0.01
    assert sorted(p.name for p in tmp_path.iterdir()) == ["camera.json", "pano.png", "pano.png.json"]

    record = sidecar_of(tmp_path / "pano.png")
    assert record["lambda"] == pytest.approx(float(done.out), abs=1e-6)
    assert 0 < record["lambda_std"] < 0.01
    assert record["lambda_px"] == pytest.approx(record["lambda"] / 250.0**2)
    assert [image["name"] for image in record["images"]] == [path.name for path in frames]
    assert all(image["used"] and image["reason"] == "" for image in record["images"])
    assert record["verdict"]["ok"] is True
    assert record["output"]["file"] == "pano.png"
    assert Camera.load(camera).distortion == pytest.approx(record["lambda"])

    written = read_image(output)
    assert [*written.pixels.shape[1::-1]] == record["output"]["size"]
    numbers = alignment_error(sequence, transfers(record), model="homography")
    assert numbers.median < 1.0
    seen = compare_with_plane(
        np.dstack([written.pixels, written.alpha]), sequence.texture, model="homography", start=numbers.transform
    )
    assert seen.median < 1.0


@pytest.mark.parametrize("how", ["lambda", "camera"])
def test_known_lens_is_kept(rdstitch: Run, frames: list[Path], tmp_path: Path, how: str) -> None:
    Camera((400, 300), distortion=-0.21).save(tmp_path / "camera.json")
    known = ("--lambda", "-0.21") if how == "lambda" else ("--camera", tmp_path / "camera.json")
    rdstitch("pano", *frames[:2], "-o", tmp_path / "pano.jpg", *known, *CACHED, out="-0.210000\n")
    record = sidecar_of(tmp_path / "pano.jpg")
    assert record["lambda_known"] is True
    assert record["lambda_std"] == 0.0
    assert (record["camera"]["lambda_std"], record["camera"]["lambda_observable"]) == (None, True)


def test_an_image_without_overlap_is_named(rdstitch: Run, frames: list[Path], stranger: Path, tmp_path: Path) -> None:
    rdstitch("pano", *frames[:2], stranger, "-o", tmp_path / "pano.jpg", *CACHED, told=str(stranger))
    record = sidecar_of(tmp_path / "pano.jpg")
    assert [image["used"] for image in record["images"]] == [True, True, False]
    assert record["images"][2]["reason"]

    strict = rdstitch("pano", *frames[:2], stranger, "-o", tmp_path / "strict.jpg", "--strict", *CACHED, status=5)
    assert str(stranger) in strict.line
    assert not (tmp_path / "strict.jpg").exists()


def test_quiet_prints_nothing_verbose_more(rdstitch: Run, frames: list[Path], stranger: Path, tmp_path: Path) -> None:
    arguments = ("pano", *frames[:2], stranger, "-o", tmp_path / "pano.jpg", "--overwrite", *CACHED)
    quiet, usual, verbose = rdstitch(*arguments, "-q"), rdstitch(*arguments), rdstitch(*arguments, "-v")
    assert quiet.err == quiet.made == ""
    assert len(usual.err.splitlines()) < len(verbose.err.splitlines())
    assert quiet.out == usual.out == verbose.out


def test_json_is_the_sidecar(rdstitch: Run, frames: list[Path], tmp_path: Path) -> None:
    done = rdstitch("pano", *frames[:2], "-o", tmp_path / "pano.png", "--json", *CACHED, err="")
    assert json.loads(done.out) == sidecar_of(tmp_path / "pano.png")
    found = rdstitch("calibrate", *frames[:2], "-o", tmp_path / "camera.json", "--json", *CACHED)
    assert json.loads(found.out) == sidecar_of(tmp_path / "camera")


def test_same_bytes_whatever_the_number_of_workers(rdstitch: Run, frames: list[Path], tmp_path: Path) -> None:
    results = []
    for number, threads in enumerate(("1", "2", "1", "2")):
        output = tmp_path / str(number) / "pano.tif"
        output.parent.mkdir()
        rdstitch("pano", *frames, "-o", output, *FAST, "-j", threads)
        record = sidecar_of(output)
        del record["options"]["workers"]
        results.append((output.read_bytes(), record))
    assert all(result == results[0] for result in results[1:])


def test_unobservable_lambda_is_nan(rdstitch: Run, frames: list[Path], tmp_path: Path) -> None:
    again = tmp_path / "again.png"
    again.write_bytes(frames[0].read_bytes())
    done = rdstitch("pano", frames[0], again, "-o", tmp_path / "pano.jpg", *CACHED)
    assert math.isnan(float(done.out))
    assert "λ not observable" in done.made
    assert not done.err
