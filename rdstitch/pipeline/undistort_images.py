"""Undistorting single pictures with a known lens."""

from collections.abc import Iterable
from functools import partial
from pathlib import Path
from typing import Literal

import numpy as np

from rdstitch.arrays import FloatArray
from rdstitch.camera import Camera
from rdstitch.compositing import Canvas, CompositeOptions, compose
from rdstitch.errors import ArgumentError, OutputError
from rdstitch.inputs.source import read_sources
from rdstitch.io.atomic import check_output
from rdstitch.io.read import read_image
from rdstitch.io.write import write_image
from rdstitch.progress import Progress, silent

View = Literal["same", "all", "valid"]

_POINTS_PER_SIDE = 256


def undistort(
    paths: Iterable[str | Path],
    folder: str | Path,
    *,
    camera: Camera | None = None,
    distortion: float | None = None,
    view: View = "same",
    overwrite: bool = False,
    progress: Progress = silent,
) -> list[Path]:
    """Undistort pictures, each into a file of the same name in a folder.

    Parameters
    ----------
    paths : iterable of path
    folder : path
        Made if it does not exist.
    camera : Camera, optional
        The lens; adapted to the size of each picture.
    distortion : float, optional
        λ in the half-diagonal frame, instead of a camera.
    view : str
        "same": size and scale at the centre stay. "all": everything that the picture shows, at that scale. "valid":
        the largest upright rectangle around the centre that the picture covers, at that scale.
    overwrite : bool
    progress : callable

    Returns
    -------
    list of Path
        The files written.
    """
    if (camera is None) == (distortion is None):
        raise ArgumentError("give either a camera or a distortion")
    if view not in ("same", "all", "valid"):
        raise ArgumentError(f"unknown view {view!r}; choose same, all or valid")
    sources, _ = read_sources(paths, camera=camera, focal=None, distortion=distortion, skip_bad=False)
    target = Path(folder)
    try:
        target.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(f"{target}: cannot make the folder: {error.strerror}") from error
    outputs = [target / source.name for source in sources]
    twice = {path for path in outputs if outputs.count(path) > 1}
    if twice:
        raise OutputError(f"{min(twice)}: two of the pictures have this name; undistort them into different folders")
    inputs = [source.path for source in sources]
    for output in outputs:
        check_output(output, overwrite, inputs)
    plain = CompositeOptions(exposure="none", seam="none", blend="none")
    for done, (source, output) in enumerate(zip(sources, outputs, strict=True), start=1):
        canvas = undistorted_canvas(source.camera, view)
        loader = partial(read_image, source.path)
        picture = compose([loader], [source.camera], np.eye(3)[None], canvas, plain)
        write_image(output, picture.pixels, picture.alpha, metadata=source.metadata)
        progress("undistorting", done, len(sources))
    return outputs


def undistorted_canvas(camera: Camera, view: View) -> Canvas:
    """Where the undistorted picture lies in the output, at the scale that it has at its distortion centre."""
    outline = camera.undistort(camera.outline(_POINTS_PER_SIDE))
    if view == "same":
        low, high = np.full(2, -0.5), np.array(camera.image_size) - 0.5
    elif view == "all":
        low, high = outline.min(axis=0), outline.max(axis=0)
    else:
        low, high = _inner_rectangle(outline, camera)
    size = np.maximum(np.floor(high - low + 1e-6), 1).astype(int)
    shift = -(low + 0.5)
    matrix = np.eye(3)
    matrix[:2, :2] *= camera.half_diagonal
    matrix[:2, 2] = np.array(camera.center) + shift
    return Canvas((int(size[0]), int(size[1])), matrix, (outline + shift,))


def _inner_rectangle(outline: FloatArray, camera: Camera) -> tuple[FloatArray, FloatArray]:
    """Largest of the rectangles of the picture's aspect ratio within the undistorted outline, about the centre."""
    half = np.array(camera.image_size) / 2.0
    middle = (np.array(camera.image_size) - 1.0) / 2.0
    # A rectangle reaches an outline point where the larger of its relative coordinates is the scale.
    scale = float(np.abs((outline - middle) / half).max(axis=1).min())
    return middle - scale * half, middle + scale * half
