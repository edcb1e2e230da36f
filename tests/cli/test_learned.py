"""Networks from ONNX files, given on the command line."""

from pathlib import Path

import cv2
import pytest

from tests.cli.running import DISTORTION, FAST, Run, sidecar_of

pytest.importorskip("onnx")
if not hasattr(cv2, "ALIKED"):
    pytest.skip("this OpenCV has no ALIKED", allow_module_level=True)

from tests.networks import KEYPOINTS, save_aliked, save_lightglue
from tests.sampled import sampled


@pytest.mark.parametrize("matcher", sampled(["lightglue", "distances"]))
def test_images_are_stitched_by_networks(rdstitch: Run, frames: list[Path], tmp_path: Path, matcher: str) -> None:
    aliked = save_aliked(tmp_path / "aliked.onnx")
    matching = ("--lightglue-model", save_lightglue(tmp_path / "glue.onnx")) if matcher == "lightglue" else ()
    output = tmp_path / "pano.png"
    done = rdstitch(
        "pano", *frames[:2], "-o", output, "--features", "aliked", "--aliked-model", aliked, *matching, *FAST
    )
    assert all("[few-images]" in line for line in done.err.splitlines())
    assert abs(float(done.out) - DISTORTION) < 0.01
    record = sidecar_of(output)
    assert [image["features"] for image in record["images"]] == [KEYPOINTS, KEYPOINTS]
    assert record["options"]["features"]["aliked_model"] == str(aliked)


def test_a_network_that_is_not_there_is_named(rdstitch: Run, frames: list[Path], tmp_path: Path) -> None:
    arguments = ("pano", *frames[:2], "-o", tmp_path / "pano.png", *FAST)
    for option, more in (("--aliked-model", ("--features", "aliked")), ("--lightglue-model", ())):
        rdstitch(*arguments, *more, option, tmp_path / "absent.onnx", status=3, told=str(tmp_path / "absent.onnx"))
    rdstitch(*arguments, "--features", "aliked", status=2, told="--aliked-model")
    assert not (tmp_path / "pano.png").exists()


def test_opencv_has_none(rdstitch: Run, frames: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delattr(cv2, "ALIKED")
    arguments = ("--features", "aliked", "--aliked-model", tmp_path / "absent.onnx")
    done = rdstitch("pano", *frames[:2], "-o", tmp_path / "pano.png", *arguments, *FAST, status=2)
    assert f"this OpenCV ({cv2.__version__}) has no ALIKED" in done.line
