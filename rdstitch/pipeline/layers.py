"""Each image of a result as a layer: warped, with alpha, its exposure corrected; and its mask, what it has in it.

For whoever retouches by hand, or blends with another program.
"""

from collections import Counter
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from rdstitch.compositing.boxes import intersection
from rdstitch.compositing.preparation import prepare_composite
from rdstitch.errors import OutputError
from rdstitch.io.cropped_tiff import write_cropped_tiff
from rdstitch.outputs import Outputs, check_outputs
from rdstitch.pipeline.composer import placed_by
from rdstitch.pipeline.recomposition import Recomposition
from rdstitch.stitch_result import StitchResult


def layer_files(names: list[str], folder: str | Path) -> list[Path]:
    """The files of images of these names, two each: the layer, and its mask."""
    stems = [Path(name).stem for name in names]
    twice = [stem for stem, count in Counter(stems).items() if count > 1]
    if twice:
        raise OutputError(f"{folder}: several images are called {min(twice)}; layers need different names")
    return [Path(folder) / f"{stem}{kind}.tif" for stem in stems for kind in ("", "_mask")]


def make_folder(folder: str | Path) -> None:
    """Make a folder of outputs, or say why not, which is better known before long work than after it."""
    try:
        Path(folder).mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(f"{folder}: cannot make the folder: {error.strerror}") from error


def write_layers(
    result: StitchResult | Recomposition,
    folder: str | Path,
    *,
    whole: bool = False,
    overwrite: bool = False,
    outputs: Outputs | None = None,
) -> list[Path]:
    """Write each image of a result as a layer, and its mask, as TIFF.

    Parameters
    ----------
    result : StitchResult or Recomposition
        Its images are read once more.
    folder : path
        Made if it does not exist. ``left.jpg`` becomes ``left.tif``, in the samples of the image with alpha, and
        ``left_mask.tif``, 255 where the result shows this image.
    whole : bool
        On the whole canvas; otherwise cropped, with the offset in the tags XPosition and YPosition and the canvas in
        PixarImageFullWidth and -Length, as enblend reads it.
    overwrite : bool
    outputs : Outputs, optional
        Where the files are staged, to be published with the image.

    Returns
    -------
    list of Path

    Raises
    ------
    OutputError
        When a file exists or cannot be written.
    """
    placed, options = placed_by(result)
    files = layer_files([source.name for source in placed.sources], folder)
    if outputs is None:
        with Outputs(overwrite) as own:
            return write_layers(result, folder, whole=whole, overwrite=overwrite, outputs=own)
    make_folder(folder)
    check_outputs(files, overwrite, [source.path for source in placed.sources])
    images = placed.images(result.canvas.near)
    with prepare_composite(images, result.canvas, replace(options, crop="none")) as prepared:
        canvas = prepared.tiles.box
        size = canvas[2] - canvas[0], canvas[3] - canvas[1]
        for index, warp in enumerate(prepared.renderer.warps):
            box = canvas if whole else intersection(warp.box, canvas) or canvas
            samples, covered, mask = prepared.renderer.layer(index, box)
            write = partial(write_cropped_tiff, offset=(box[0] - canvas[0], box[1] - canvas[1]), size=size)
            alpha, shown = (np.where(where, np.uint8(255), np.uint8(0)) for where in (covered, mask))
            with outputs.writing(files[2 * index]) as staged:
                write(staged, samples, alpha)
            with outputs.writing(files[2 * index + 1]) as staged:
                write(staged, shown, None)
    return files
