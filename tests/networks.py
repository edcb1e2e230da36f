"""Small networks with the inputs and outputs of ALIKED and LightGlue, good enough to stitch rendered images.

Imported by tests only after ``pytest.importorskip("onnx")``.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import onnx
from numpy.typing import NDArray
from onnx import TensorProto, helper, numpy_helper

SIDE = 640
KEYPOINTS = 500
WIDTH = 64
_RADIUS = 12  # of the blobs, px of the network's image


def save_aliked(path: Path) -> Path:
    """Blobs as keypoints, the strongest first; smoothed samples around them, without their mean, as descriptors."""
    v, u = np.mgrid[-_RADIUS : _RADIUS + 1, -_RADIUS : _RADIUS + 1]
    blob = _gaussian(u, v, 3.0) - _gaussian(u, v, 4.5)
    samples = np.eye(WIDTH) - 1 / WIDTH
    weights = {
        "grey": np.full((1, 3, 1, 1), 1 / 3, np.float32),
        "blob": blob[None, None].astype(np.float32),
        "smooth": _gaussian(u, v, 3.0)[None, None].astype(np.float32),
        "samples": samples.reshape(WIDTH, 1, 8, 8).astype(np.float32),
        "much": np.array(1000.0, np.float32),
        "flat": np.array([-1]),
        "rows": np.array([WIDTH, -1]),
        "column": np.array([-1, 1]),
        "count": np.array([KEYPOINTS]),
        "side": np.array(float(SIDE), np.float32),
        "scale": np.array(2.0 / SIDE, np.float32),
        "shift": np.array(1.0 / SIDE - 1.0, np.float32),
    }
    pads = [_RADIUS] * 4
    nodes = [
        helper.make_node("Conv", ["image", "grey"], ["light"]),
        helper.make_node("Conv", ["light", "blob"], ["signed"], pads=pads),
        helper.make_node("Abs", ["signed"], ["response"]),
        helper.make_node("MaxPool", ["response"], ["highest"], kernel_shape=[9, 9], pads=[4] * 4, strides=[1, 1]),
        # The highest of a neighbourhood stays as it is, all others sink.
        helper.make_node("Sub", ["response", "highest"], ["below"]),
        helper.make_node("Mul", ["below", "much"], ["deep"]),
        helper.make_node("Add", ["response", "deep"], ["peaks"]),
        helper.make_node("Reshape", ["peaks", "flat"], ["line"]),
        helper.make_node("TopK", ["line", "count"], ["best", "index"], axis=0),
        helper.make_node("Reshape", ["best", "column"], ["scores"]),
        helper.make_node("Cast", ["index"], ["position"], to=TensorProto.FLOAT),
        helper.make_node("Div", ["position", "side"], ["row"]),
        helper.make_node("Floor", ["row"], ["v"]),
        helper.make_node("Mul", ["v", "side"], ["before"]),
        helper.make_node("Sub", ["position", "before"], ["u"]),
        helper.make_node("Reshape", ["u", "column"], ["us"]),
        helper.make_node("Reshape", ["v", "column"], ["vs"]),
        helper.make_node("Concat", ["us", "vs"], ["places"], axis=1),
        helper.make_node("Mul", ["places", "scale"], ["scaled"]),
        helper.make_node("Add", ["scaled", "shift"], ["keypoints"]),
        helper.make_node("Conv", ["light", "smooth"], ["soft"], pads=pads),
        # Eight samples in a row, four px apart: from -14 to 14.
        helper.make_node("Conv", ["soft", "samples"], ["windows"], dilations=[4, 4], pads=[14] * 4),
        helper.make_node("Reshape", ["windows", "rows"], ["everywhere"]),
        helper.make_node("Gather", ["everywhere", "index"], ["chosen"], axis=1),
        helper.make_node("Transpose", ["chosen"], ["descriptors"], perm=[1, 0]),
    ]
    outputs = {"keypoints": (KEYPOINTS, 2), "descriptors": (KEYPOINTS, WIDTH), "scores": (KEYPOINTS, 1)}
    return save(path, nodes, {"image": (1, 3, SIDE, SIDE)}, outputs, weights)


def save_lightglue(path: Path) -> Path:
    """Nearest descriptors; certain where that is mutual."""
    weights = {
        "numbers": np.arange(KEYPOINTS),
        "column": np.array([-1, 1]),
        "flat": np.array([-1]),
        "axis": np.array([0]),
    }
    nodes = [
        helper.make_node("Squeeze", ["desc0", "axis"], ["one"]),
        helper.make_node("Squeeze", ["desc1", "axis"], ["two"]),
        helper.make_node("Transpose", ["two"], ["turned"], perm=[1, 0]),
        helper.make_node("MatMul", ["one", "turned"], ["alike"]),
        helper.make_node("ArgMax", ["alike"], ["there"], axis=1, keepdims=0),
        helper.make_node("ArgMax", ["alike"], ["back"], axis=0, keepdims=0),
        helper.make_node("Gather", ["back", "there"], ["returned"], axis=0),
        helper.make_node("Equal", ["returned", "numbers"], ["mutual"]),
        helper.make_node("Cast", ["mutual"], ["mscores0"], to=TensorProto.FLOAT),
        helper.make_node("Reshape", ["numbers", "column"], ["left"]),
        helper.make_node("Reshape", ["there", "column"], ["right"]),
        helper.make_node("Concat", ["left", "right"], ["matches0"], axis=1),
    ]
    inputs = {f"{name}{i}": (1, KEYPOINTS, width) for name, width in (("kpts", 2), ("desc", WIDTH)) for i in (0, 1)}
    return save(path, nodes, inputs, {"matches0": (KEYPOINTS, 2), "mscores0": (KEYPOINTS,)}, weights)


def save(
    path: Path,
    nodes: Sequence[Any],
    inputs: Mapping[str, tuple[int, ...]],
    outputs: Mapping[str, tuple[int, ...]],
    weights: Mapping[str, NDArray[Any]],
) -> Path:
    """Write a network of float inputs and outputs; matches are integers."""
    kinds = {"matches0": TensorProto.INT64}
    graph = helper.make_graph(
        nodes,
        path.stem,
        [helper.make_tensor_value_info(name, TensorProto.FLOAT, shape) for name, shape in inputs.items()],
        [
            helper.make_tensor_value_info(name, kinds.get(name, TensorProto.FLOAT), shape)
            for name, shape in outputs.items()
        ],
        [numpy_helper.from_array(values, name) for name, values in weights.items()],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 18)], ir_version=9)
    onnx.checker.check_model(model)
    onnx.save(model, str(path))
    return path


def _gaussian(u: NDArray[Any], v: NDArray[Any], sigma: float) -> NDArray[np.float64]:
    values = np.exp(-(u**2 + v**2) / (2 * sigma**2))
    return np.asarray(values / values.sum(), np.float64)
