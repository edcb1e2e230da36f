"""Images of a result as layers for retouching: each warped, with its mask, in TIFF files as enblend reads them."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from rdstitch.arrays import AnyArray, UInt8Array
from rdstitch.compositing.boxes import intersection
from rdstitch.compositing.preparation import decide, prepare_composite
from rdstitch.errors import OutputError
from rdstitch.io.samples import as_alpha
from rdstitch.io.strips import with_alpha
from rdstitch.io.tiff import ExtraTag
from rdstitch.results.stitch_result import OutputImage
from rdstitch.system.late_imports import tifffile
from rdstitch.system.native_threads import one_native_thread
from rdstitch.system.output_checks import check_outputs
from rdstitch.system.outputs import Outputs, file_name

_DPI = 150  # offsets are counted in inches; any resolution will do
_X_POSITION, _Y_POSITION, _FULL_WIDTH, _FULL_LENGTH = 286, 287, 33300, 33301
_RATIONAL, _LONG = 5, 4


def layer_files(names: Sequence[str], folder: str | Path) -> dict[str, tuple[Path, Path]]:
    """Of each image, by its name, the files of the layer and of its mask.

    They are called like the images without their suffixes, or with them, where two files would have one name.
    """
    safe = [file_name(name) for name in names]
    for stems in ([Path(name).stem for name in safe], safe):
        files = [(Path(folder) / f"{stem}.tif", Path(folder) / f"{stem}_mask.tif") for stem in stems]
        if len({str(file).casefold() for pair in files for file in pair}) == 2 * len(files):
            return dict(zip(names, files, strict=True))
    raise OutputError(f"{folder}: several images have one name, but layers need different ones; rename them")


@one_native_thread()
def write_layers(
    result: OutputImage, folder: str | Path, *, whole: bool = False, overwrite: bool = False
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

    Returns
    -------
    list of Path

    Raises
    ------
    OutputError
        When a file exists or cannot be written.
    """
    files = layer_files([source.name for source in result.placed.sources], folder)
    written = [file for pair in files.values() for file in pair]
    with Outputs(overwrite) as outputs:
        outputs.make_folder(Path(folder))
        check_outputs(written, overwrite, [source.path for source in result.placed.sources])
        stage_layers(result, files, outputs, whole=whole)
    return written


def stage_layers(result: OutputImage, files: Mapping[str, tuple[Path, Path]], outputs: Outputs, *, whole: bool) -> None:
    """Stage the layer and the mask of each image of a result, whose names say the files."""
    images = result.placed.images(result.canvas)
    task = decide(images, result.canvas, replace(result.options.composite, crop="none"))
    with prepare_composite(task) as tiles:
        canvas = tiles.box
        metadata = result.placed.profile_source.metadata.with_samples(tiles.renderer.channels)
        for index, (source, warp) in enumerate(zip(result.placed.sources, tiles.renderer.warps, strict=True)):
            box = canvas if whole else intersection(warp.box, canvas) or canvas
            samples, covered, mask = tiles.renderer.layer(index, box)
            x, y = box[0] - canvas[0], box[1] - canvas[1]
            shift = np.array([[1.0, 0.0, -x], [0.0, 1.0, -y], [0.0, 0.0, 1.0]])
            tags: list[ExtraTag] = [
                (_X_POSITION, _RATIONAL, 1, (x, _DPI), True),
                (_Y_POSITION, _RATIONAL, 1, (y, _DPI), True),
                (_FULL_WIDTH, _LONG, 1, canvas[2] - canvas[0], True),
                (_FULL_LENGTH, _LONG, 1, canvas[3] - canvas[1], True),
            ]
            tags += [] if result.georeference is None else result.georeference.after(shift).tiff_tags()
            layer, mask_file = files[source.name]
            with outputs.writing(layer) as staged:
                _write_tiff(staged, samples, as_alpha(covered), tags, metadata.icc_profile)
            with outputs.writing(mask_file) as staged:
                _write_tiff(staged, as_alpha(mask)[..., None], None, tags, b"")


def _write_tiff(
    path: Path, samples: AnyArray, alpha: UInt8Array | None, tags: Sequence[ExtraTag], profile: bytes
) -> None:
    """Write samples (h, w, C), and alpha (h, w), which is 0 or 255."""
    colours = 3 if samples.shape[2] == 3 else 1
    extra = ["unspecified"] * (samples.shape[2] - colours)
    if alpha is not None:
        samples, extra = with_alpha(samples, alpha), [*extra, "unassalpha"]
    tifffile.imwrite(
        path,
        samples if extra else samples[..., 0] if colours == 1 else samples,
        photometric="rgb" if colours == 3 else "minisblack",
        planarconfig="contig",
        extrasamples=extra or None,
        compression="zlib",
        predictor=samples.dtype.kind == "u",
        resolution=(_DPI, _DPI),
        resolutionunit="inch",
        iccprofile=profile or None,
        extratags=tags,
        metadata=None,
        software=False,
    )
