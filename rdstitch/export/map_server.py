"""A mosaic as a map of ROS: the image and the ``map.yaml`` that ``nav2_map_server`` loads.

The map lies in the frame "ros" of a trajectory of the same images: the first image's camera stands at the origin, x
points to the top of that image and y to its left; see :mod:`rdstitch.geometry.path_frames`.
"""

import json
import math
from pathlib import Path

import cv2
import numpy as np

from rdstitch.arrays import FloatArray
from rdstitch.compositing.plan import default_memory
from rdstitch.errors import ArgumentError, LimitError
from rdstitch.geometry.path_frames import AXES
from rdstitch.io.metadata import Metadata
from rdstitch.io.read import read_image
from rdstitch.io.strips import ImageSpec
from rdstitch.io.write import write_strips
from rdstitch.results.stitch_result import StitchResult
from rdstitch.system.outputs import Outputs, text_bytes
from rdstitch.trajectories.trajectory import Trajectory

_OUTPUT_BYTES, _MAP_BYTES = 2, 4  # of a pixel: grey levels and transparency, and on the map also while it is written


def write_map(result: StitchResult, folder: Path, height: float, outputs: Outputs) -> None:
    """Stage ``map.yaml`` and ``map.png`` of a mosaic that was written, in metres by the height of the first image.

    Raises ArgumentError where the images have no metric poses.
    """
    description, map_image = map_files(folder)
    to_metres = _pixel_to_metres(result, height)
    columns, rows = result.canvas.size
    resolution = math.sqrt(abs(float(np.linalg.det(to_metres[:, :2]))))
    corners = np.array([(0, 0), (columns, 0), (columns, rows), (0, rows)]) - 0.5
    outline = corners @ to_metres[:, :2].T + to_metres[:, 2]
    origin = outline.min(axis=0)
    width, length = np.ceil((outline.max(axis=0) - origin) / resolution - 1e-6).astype(int).tolist()
    _check_memory(map_image, result, (width, length))
    # The first pixel is at the top left, the origin at the bottom left of it all.
    to_map = np.array([[1.0, 0.0], [0.0, -1.0]]) @ np.column_stack([to_metres[:, :2], to_metres[:, 2] - origin])
    to_map = to_map / resolution + np.array([[0.0, 0.0, -0.5], [0.0, 0.0, length - 0.5]])
    assert result.output is not None
    image = read_image(outputs.where(result.output))
    grey = image.pixels if image.pixels.ndim == 2 else cv2.cvtColor(image.pixels[..., :3], cv2.COLOR_RGB2GRAY)
    alpha = np.full(grey.shape, 255, np.uint8) if image.alpha is None else image.alpha
    if grey.dtype != np.uint8 and alpha.any():
        low, high = float(grey[alpha > 0].min()), float(grey[alpha > 0].max())
        grey = np.rint((np.clip(grey, low, high) - low) * (255.0 / max(high - low, 1e-12))).astype(np.uint8)
    shown = [cv2.warpAffine(layer, to_map, (width, length), flags=cv2.INTER_LINEAR) for layer in (grey, alpha)]
    grey, alpha = (np.asarray(layer, np.uint8) for layer in shown)
    spec = ImageSpec((width, length), 1, grey.dtype, transparent=True, metadata=Metadata((width, length)))
    write_strips(map_image, spec, [(grey[..., None], alpha)], outputs=outputs)
    fields = {
        "image": map_image.name,
        "mode": "scale",
        "resolution": resolution,
        "origin": [*origin.tolist(), 0.0],
        "negate": 0,
        "occupied_thresh": 0.65,
        "free_thresh": 0.196,
    }
    lines = "".join(f"{name}: {json.dumps(value)}\n" for name, value in fields.items())
    outputs.write(description, text_bytes(lines))


def _check_memory(file: Path, result: StitchResult, size: tuple[int, int]) -> None:
    """Refuse a map whose making would take more memory than there is: that the mosaic is kept counts more."""
    output, sources = result.canvas.size, result.placed.sources
    pixel = max(one.metadata.channels * -(-one.metadata.bit_depth // 8) for one in sources) + _OUTPUT_BYTES
    limit = result.options.composite.max_memory or default_memory()
    if (need := math.prod(output) * pixel + math.prod(size) * _MAP_BYTES) > limit:
        raise LimitError(
            f"{file}: a map of {size[0]} x {size[1]} pixels needs {need / 2**20:.0f} MB of memory, and there are "
            f"{limit / 2**20:.0f} MB; make the output smaller, with --scale or --max-size"
        )


def map_files(folder: Path) -> list[Path]:
    """The description and the image of a map."""
    return [folder / "map.yaml", folder / "map.png"]


def check_map_server(output: Path | None, height: float | None) -> None:
    """Refuse an output of which no map can be made."""
    if output is None:
        raise ArgumentError("--map-server is made from the output: name one")
    if (suffix := output.suffix.lower()) in (".dzi", ".zarr"):
        raise ArgumentError(f"--map-server is made from the output: write .png, .jpg or .tif instead of {suffix}")
    if height is None:
        raise ArgumentError("--map-server is in metres: give the height of the first image's camera with --height")


def _pixel_to_metres(result: StitchResult, height: float) -> FloatArray:
    """From pixels of the output to metres in the frame "ros" of the first image, a similarity (2, 3)."""
    poses = result.registration.alignment.poses
    if poses is None or result.canvas.projection.name != "plane":
        raise ArgumentError("a map needs metric poses over a plane; leave out --map-server, or choose a planar --model")
    if (to_pixels := result.canvas.from_level_plane) is None:
        raise ArgumentError("there is no map where the plane was tilted to be upright; leave out --straighten")
    to_plane = np.linalg.inv(to_pixels)
    first = int(Trajectory.from_poses(poses).frame[0])
    c, s, unit = math.cos(poses.yaw[first]), math.sin(poses.yaw[first]), height / poses.height[first]
    to_first = AXES["ros"] @ np.array([[c, -s], [s, c]]) * unit
    return np.column_stack([to_first @ to_plane[:2, :2], to_first @ (to_plane[:2, 2] - poses.position[first])])
