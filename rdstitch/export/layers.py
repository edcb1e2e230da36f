"""Images of a result as layers for retouching: each warped, with its mask."""

from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from rdstitch.compositing.boxes import intersection
from rdstitch.compositing.preparation import decide, prepare_composite
from rdstitch.errors import OutputError
from rdstitch.io.cropped_tiff import write_cropped_tiff
from rdstitch.results.stitch_result import OutputImage
from rdstitch.system.native_threads import one_native_thread
from rdstitch.system.outputs import Outputs, check_outputs, file_name


def layer_files(names: list[str], folder: str | Path) -> list[Path]:
    """The files of images of these names, two each: the layer, and its mask.

    They are called like the images without their suffixes, or with them, where two files would have one name.
    """
    whole = [file_name(name) for name in names]
    for stems in ([Path(name).stem for name in whole], whole):
        files = [Path(folder) / f"{stem}{kind}.tif" for stem in stems for kind in ("", "_mask")]
        if len({str(file).casefold() for file in files}) == len(files):
            return files
    raise OutputError(f"{folder}: several images have one name, but layers need different ones; rename them")


def make_folder(folder: str | Path) -> None:
    """Make a folder of outputs, or say why not, which is better known before long work than after it."""
    try:
        Path(folder).mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(f"{folder}: cannot make the folder: {error.strerror}") from error


@one_native_thread()
def write_layers(
    result: OutputImage,
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
    placed, options = result.placed, result.options.composite
    files = layer_files([source.name for source in placed.sources], folder)
    make_folder(folder)
    check_outputs(files, overwrite, [source.path for source in placed.sources])
    images = placed.images(result.canvas.near)
    task = decide(images, result.canvas, replace(options, crop="none"))
    with prepare_composite(task) as prepared, Outputs.or_own(outputs, overwrite) as staging:
        canvas = prepared.tiles.box
        size = canvas[2] - canvas[0], canvas[3] - canvas[1]
        for index, warp in enumerate(prepared.renderer.warps):
            box = canvas if whole else intersection(warp.box, canvas) or canvas
            samples, covered, mask = prepared.renderer.layer(index, box)
            offset = box[0] - canvas[0], box[1] - canvas[1]
            shift = np.array([[1.0, 0.0, -offset[0]], [0.0, 1.0, -offset[1]], [0.0, 0.0, 1.0]])
            tags = () if result.georeference is None else result.georeference.after(shift).tiff_tags()
            write = partial(write_cropped_tiff, offset=offset, size=size, extra_tags=tags)
            alpha, shown = (np.where(where, np.uint8(255), np.uint8(0)) for where in (covered, mask))
            with staging.writing(files[2 * index]) as staged:
                write(staged, samples, alpha)
            with staging.writing(files[2 * index + 1]) as staged:
                write(staged, shown, None)
    return files
