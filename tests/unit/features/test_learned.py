"""Networks from the user's ONNX files: stand-ins with the inputs and outputs of ALIKED and LightGlue."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from rdstitch.errors import ArgumentError, InputError
from rdstitch.features import FeatureOptions, Features, detect
from rdstitch.features.learned import LightGlue

onnx = pytest.importorskip("onnx")
if not hasattr(cv2, "ALIKED"):
    pytest.skip("this OpenCV has no ALIKED", allow_module_level=True)

from tests.networks import save  # noqa: E402 - imports onnx

SIDE = 64
CELL = 8


@pytest.fixture
def aliked(tmp_path: Path) -> Path:
    """A network that sees a keypoint in every cell of a grid, described by its pixels, brighter ones stronger."""
    helper = onnx.helper
    cells = SIDE // CELL
    place = (np.arange(cells) + 0.5) / cells * 2 - 1
    v, u = np.meshgrid(place, place, indexing="ij")
    keypoints = np.column_stack([u.ravel(), v.ravel()]).astype(np.float32)
    keypoints[5] = np.nan  # it is left out
    pick = np.zeros((CELL * CELL, 3, CELL, CELL), np.float32)
    pick[np.arange(64), 0, np.arange(64) // CELL, np.arange(64) % CELL] = 1
    weights = {"keypoints0": keypoints, "pick": pick, "shape": np.array([64, cells**2]), "one": np.array([1])}
    nodes = [
        helper.make_node("Identity", ["keypoints0"], ["keypoints"]),
        helper.make_node("Conv", ["image", "pick"], ["cells"], strides=[CELL, CELL]),
        helper.make_node("Reshape", ["cells", "shape"], ["columns"]),
        helper.make_node("Transpose", ["columns"], ["descriptors"], perm=[1, 0]),
        helper.make_node("ReduceMean", ["descriptors", "one"], ["scores"], keepdims=1),
    ]
    outputs = {"keypoints": (cells**2, 2), "descriptors": (cells**2, 64), "scores": (cells**2, 1)}
    return save(tmp_path / "aliked.onnx", nodes, {"image": (1, 3, SIDE, SIDE)}, outputs, weights)


@pytest.fixture
def lightglue(tmp_path: Path) -> Path:
    """A network that matches keypoint i with keypoint i, the more certain the farther to the right it is."""
    helper = onnx.helper
    pairs = np.repeat(np.arange(5)[:, None], 2, axis=1).astype(np.int64)
    weights = {"pairs": pairs, "zero": np.array(0), "half": np.array(0.5, np.float32)}
    nodes = [
        helper.make_node("Identity", ["pairs"], ["matches0"]),
        helper.make_node("Gather", ["kpts0", "zero"], ["u"], axis=2),
        helper.make_node("Mul", ["u", "half"], ["halved"]),
        helper.make_node("Add", ["halved", "half"], ["certain"]),
        helper.make_node("Squeeze", ["certain", "squeezed"], ["mscores0"]),
    ]
    weights["squeezed"] = np.array([0])
    inputs = {name: (1, 5, width) for name, width in (("kpts0", 2), ("kpts1", 2), ("desc0", 64), ("desc1", 64))}
    return save(tmp_path / "lightglue.onnx", nodes, inputs, {"matches0": (5, 2), "mscores0": (5,)}, weights)


def five(points: np.ndarray) -> Features:
    zeros = np.zeros(5)
    return Features(points, np.eye(5, 64, dtype=np.float32), zeros + 1, zeros, zeros, None, "aliked", (200, 100))


def test_keypoints_of_a_network_are_features(aliked: Path) -> None:
    image = np.random.default_rng(0).integers(0, 256, (2 * SIDE, 2 * SIDE), dtype=np.uint8)
    image = np.asarray(cv2.GaussianBlur(image, (0, 0), 3.0))
    options = FeatureOptions(kind="aliked", aliked_model=aliked, aliked_size=SIDE, max_features=20, spread=False)
    found = detect(image, options)
    assert found.descriptors.shape == (20, 64)
    assert found.image_size == (128, 128)
    np.testing.assert_allclose(np.linalg.norm(found.descriptors, axis=1), 1.0, rtol=1e-5)
    assert (np.diff(found.response) <= 0).all()
    # Each keypoint tells the brightness of the cell that it lies in.
    for point, response in zip(found.points, found.response, strict=True):
        u, v = (point // (2 * CELL) * 2 * CELL).astype(int)
        cell = image[v : v + 2 * CELL, u : u + 2 * CELL]
        assert response * 255 == pytest.approx(cell.mean(), abs=2.0)


def test_lightglue_orders_by_confidence(lightglue: Path) -> None:
    points = np.array([[150.0, 10], [20, 20], [199, 30], [90, 40], [60, 50]])
    found = LightGlue(lightglue, min_score=0.2).match(five(points), five(points + 1))
    np.testing.assert_array_equal(found.indices, [[2, 2], [0, 0], [3, 3], [4, 4]])
    np.testing.assert_allclose(found.ratio, 1 - points[[2, 0, 3, 4], 0] / 200, atol=1e-5)
    np.testing.assert_array_equal(found.points2, points[[2, 0, 3, 4]] + 1)


def test_what_is_no_network_is_refused(tmp_path: Path, aliked: Path, lightglue: Path) -> None:
    image = np.zeros((SIDE, SIDE), np.uint8)
    text = tmp_path / "text.onnx"
    text.write_text("not a network")
    for model, said in (
        (tmp_path / "none.onnx", "no such file"),
        (text, "not an ONNX file"),
        (lightglue, "not an ALIKED"),
    ):
        with pytest.raises(InputError, match=said):
            detect(image, FeatureOptions(kind="aliked", aliked_model=model))
    with pytest.raises(ArgumentError, match="ONNX file"):
        detect(image, FeatureOptions(kind="aliked"))
    with pytest.raises(InputError, match="not an ONNX file"):
        LightGlue(text)
    points = np.zeros((5, 2))
    with pytest.raises(InputError, match="not a LightGlue"):
        LightGlue(aliked).match(five(points), five(points))
