"""Files that other programs read, made from a result: layers for retouching, and poses."""

import math
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from rdstitch.alignment.result import PlanarPoses
from rdstitch.alignment.trajectory import Trajectory
from rdstitch.arrays import FloatArray
from rdstitch.choices import PosesFrame
from rdstitch.compositing.boxes import intersection
from rdstitch.compositing.preparation import decide, prepare_composite
from rdstitch.errors import ArgumentError, OutputError
from rdstitch.export.poses_files import geo_of_opendronemap, images_of_colmap
from rdstitch.export.trajectory_files import as_csv
from rdstitch.inputs.times import timestamps_of
from rdstitch.io.cropped_tiff import write_cropped_tiff
from rdstitch.pipeline.composer import placed_by
from rdstitch.results.stitch_result import StitchResult
from rdstitch.system.native_threads import one_native_thread
from rdstitch.system.outputs import Outputs, check_outputs, file_name

if TYPE_CHECKING:
    from rdstitch.pipeline.recomposition import Recomposition


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
    result: "StitchResult | Recomposition",
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
    placed, options = placed_by(result), result.options.composite
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


def poses_table(result: StitchResult, frame: PosesFrame = "enu", height: float = 1.0) -> str:
    """The table that ``rdstitch trajectory`` writes, of a mosaic; with covariances where ``options`` asked for them.

    Frames are those of :mod:`rdstitch.export.trajectory_files`, ``height`` that of the first image in the unit that
    positions shall have; or "map": easting, northing and the height above the ground in metres, with yaw zero where the
    top of an image is north, and covariances relative to the reference image.
    """
    registration = result.registration
    path = Trajectory.from_alignment(registration.alignment, height)
    if frame == "map":
        path = Trajectory.on_map(*_poses_and_map(result))
    sources = registration.sources
    numbers = [source.number(k) for k, source in enumerate(sources)]
    path = path.labelled([source.name for source in sources], numbers, timestamps_of(sources))
    return as_csv(path, "enu" if frame == "map" else frame)


def _poses_and_map(result: StitchResult) -> tuple[PlanarPoses, FloatArray]:
    """The poses, and what leads (2, 3) from their plane to the map."""
    place, poses = result.georeference, result.registration.alignment.poses
    if place is None or poses is None:
        raise ArgumentError(f"there is no map for the poses: {result.not_georeferenced}; leave out --frame map")
    if (to_pixels := result.canvas.from_level_plane) is None:
        raise ArgumentError("poses have no map where the plane was tilted to be upright; leave out --frame map")
    return poses, place.pixel_to_map @ to_pixels


def poses_file(result: StitchResult, file: str | Path, frame: PosesFrame = "enu", height: float = 1.0) -> str:
    """What a file of poses holds, by its name: ``images.txt`` is COLMAP's, ``geo.txt`` OpenDroneMap's, else CSV."""
    name = Path(file).name.lower()
    if name not in ("images.txt", "geo.txt"):
        return poses_table(result, frame, height)
    sources, poses = result.registration.sources, result.registration.alignment.poses
    names = [source.name for source in sources]
    if any(source.metadata.orientation != 1 for source in sources):
        raise ArgumentError(f"{file}: images that EXIF turns have other axes there; turn the files first")
    if name == "geo.txt":
        place = result.georeference
        poses, to_map = _poses_and_map(result)
        assert place is not None
        unit = math.hypot(to_map[0, 0], to_map[1, 0])
        known = (None if s.metadata.gps is None else s.metadata.gps.altitude for s in sources)
        altitudes = [math.nan if altitude is None else altitude for altitude in known]
        above = np.array(altitudes) - unit * poses.height
        ground = float(np.median(above[np.isfinite(above)])) if np.isfinite(above).any() else 0.0
        return geo_of_opendronemap(names, poses, to_map, place.crs.epsg, ground)
    if poses is None:
        raise ArgumentError(f"{file}: one homography per image has no poses; --model pose gives some")
    return images_of_colmap(names, poses, None if result.georeference is None else _poses_and_map(result)[1])
