"""Files that other programs read, made from a result: layers for retouching, a table of poses, a project of Hugin."""

import math
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from rdstitch.alignment.frames import stored, turned_alignment, turns
from rdstitch.alignment.result import Alignment, PlanarPoses
from rdstitch.alignment.trajectory import Trajectory
from rdstitch.arrays import FloatArray
from rdstitch.choices import PosesFrame
from rdstitch.compositing.boxes import intersection
from rdstitch.compositing.canvas import Canvas
from rdstitch.compositing.preparation import prepare_composite
from rdstitch.errors import ArgumentError, OutputError
from rdstitch.export.poses_files import geo_of_opendronemap, images_of_colmap
from rdstitch.export.trajectory_files import as_csv
from rdstitch.geometry.camera import Camera
from rdstitch.geometry.exif_orientation import quarter_turn, turning_matrix
from rdstitch.geometry.planar_motion import nearest_rotation, rotation_from_tilt
from rdstitch.inputs.measurements import timestamps_of
from rdstitch.io.tiff import write_cropped_tiff
from rdstitch.pipeline.composer import placed_by
from rdstitch.results.stitch_result import StitchResult
from rdstitch.system.opencv_state import one_opencv_thread
from rdstitch.system.outputs import Outputs, check_outputs, file_name

if TYPE_CHECKING:
    from rdstitch.pipeline.apply_sidecar import Recomposition


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


@one_opencv_thread()
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
    placed, options = placed_by(result)
    files = layer_files([source.name for source in placed.sources], folder)
    if outputs is None:
        with Outputs(overwrite) as staging:
            return write_layers(result, folder, whole=whole, overwrite=overwrite, outputs=staging)
    make_folder(folder)
    check_outputs(files, overwrite, [source.path for source in placed.sources])
    images = placed.images(result.canvas.near)
    with prepare_composite(images, result.canvas, replace(options, crop="none")) as prepared:
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
            with outputs.writing(files[2 * index]) as staged:
                write(staged, samples, alpha)
            with outputs.writing(files[2 * index + 1]) as staged:
                write(staged, shown, None)
    return files


_LEVEL = 1e-9  # rounding of what a turn within the plane leaves as it is


def poses_table(result: StitchResult, frame: PosesFrame = "enu", height: float = 1.0) -> str:
    """The table that ``rdstitch trajectory`` writes, of a mosaic; with covariances where ``options`` asked for them.

    Parameters
    ----------
    frame : str
        "enu", "ros" or "camera", see :mod:`rdstitch.export.trajectory_files`; "map": easting, northing and the height
        above the ground in metres, with yaw zero where the top of an image is north. The
        covariances are then relative to the reference image; how well that is placed, the georeference says.
    height : float
        Of the first image, in the unit that positions shall have; not for "map".
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
    turned = np.eye(3) if result.canvas.orientation is None else result.canvas.orientation
    if np.abs(turned[2, :2]).max() > _LEVEL * abs(turned[2, 2]):
        raise ArgumentError("poses have no map where the plane was tilted to be upright; leave out --frame map")
    return poses, place.pixel_to_map @ result.canvas.matrix @ (turned / turned[2, 2])


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


_CONTROL_POINTS = 20  # of a pair; Hugin's own finder takes about as many
_SAMPLES = 65  # places along a side of the canvas, by which its bounds in another projection are found
_LARGEST_VIEW = 170.0  # degrees: of a plane seen from one height, which ends at 180


def project_of_hugin(result: StitchResult) -> str:
    """The project: images as their files store them, with yaw, pitch and roll, and over a plane with TrX, TrY, TrZ.

    Its panorama is equirectangular, or the plane seen from one height of the reference image, cropped to the output.
    """
    from rdstitch.camera_files.polynomials import HEAD, hugin_lens

    registration, sources = result.registration, result.registration.sources
    if any(source.frame is not None and source.frame.number is not None for source in sources):
        raise ArgumentError("Hugin opens image files, not frames of videos; write them as files first")
    orientations = [quarter_turn(source.metadata.orientation) for source in sources]
    alignment = turned_alignment(registration.alignment, stored(orientations), None)
    if alignment.poses is None and not alignment.on_sphere:
        raise ArgumentError("Hugin knows no images with a homography of their own; --model pose gives poses")
    # The axes of the output are those of the upright reference image.
    k = alignment.reference
    matrix = (
        alignment.homographies[k]
        @ turns(stored(orientations))[k]
        @ np.linalg.inv(registration.alignment.homographies[k])
    )
    if alignment.poses is not None and result.canvas.orientation is not None:
        matrix = matrix @ np.linalg.inv(result.canvas.orientation)
    seen = np.tensordot(matrix * np.sign(np.linalg.det(matrix)), _seen_on(result.canvas), axes=1)
    used = np.flatnonzero(alignment.used).tolist()
    number = {k: place for place, k in enumerate(used)}
    lenses: dict[Camera, int] = {}
    lines, variables = [], []
    for place, k in enumerate(used):
        camera = alignment.cameras[k]
        lens = hugin_lens(camera)[0].split()
        if camera in lenses:  # linked with the image that has the same
            lens = [part if part[0] in "whf" else f"{part[0]}={lenses[camera]}" for part in lens]
        lenses.setdefault(camera, place)
        path = str(sources[k].path.absolute())
        lines.append(" ".join(["i", *lens, *(f"{n}{v!r}" for n, v in _pose(alignment, k).items()), f'n"{path}"']))
        if k != alignment.reference:
            variables += [f"v {name}{place}" for name in _pose(alignment, k)]
    control = []
    for pair in registration.pairs:
        ends = pair.images
        if ends in alignment.support and set(ends) <= number.keys():
            link = pair.link().thinned(_CONTROL_POINTS)
            points = [
                _in_file(points, registration.alignment.cameras[k], alignment.cameras[k], orientations[k])
                for points, k in zip((link.points1, link.points2), ends, strict=True)
            ]
            control += [
                f"c n{number[ends[0]]} N{number[ends[1]]} x{x:.4f} y{y:.4f} X{X:.4f} Y{Y:.4f} t0"
                for (x, y), (X, Y) in zip(*(ends.tolist() for ends in points), strict=True)
            ]
    parts = [f"{HEAD}{_panorama(alignment, used, seen)}", "m i0", *lines, *variables, "v", *control]
    return "\n".join(parts) + "\n"


def _pose(alignment: Alignment, k: int) -> dict[str, float]:
    """Hugin's parameters of where an image was taken: degrees, and heights to the right, down and back."""
    poses = alignment.poses
    if poses is None:
        focal = alignment.cameras[k].with_focal().focal or 1.0
        scaled = alignment.homographies[k] @ np.diag([1.0, 1.0, focal / alignment.cameras[k].scale])
        rotation = nearest_rotation(scaled * np.sign(np.linalg.det(scaled)))
        place = {}
    else:
        c, s = np.cos(poses.yaw[k]), np.sin(poses.yaw[k])
        about_axis = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        rotation = (rotation_from_tilt(poses.tilt[k]) @ about_axis).T
        x, y = poses.position[k].tolist()
        place = {"TrX": x, "TrY": y, "TrZ": float(poses.height[k]) - 1.0}
    angles = {
        "y": math.atan2(rotation[0, 2], rotation[2, 2]),
        "p": -math.asin(float(np.clip(rotation[1, 2], -1.0, 1.0))),
        "r": math.atan2(rotation[1, 0], rotation[1, 1]),
    }
    return {**{name: math.degrees(angle) for name, angle in angles.items()}, **place}


def _panorama(alignment: Alignment, used: list[int], seen: FloatArray) -> str:
    """The line of the output, at the resolution of the reference image, cropped to what is ``seen`` (3, N, N)."""
    camera = alignment.cameras[alignment.reference].with_focal()
    focal = camera.focal or 1.0
    x, y, z = seen
    if alignment.poses is None:
        width = 2 * round(math.pi * focal)
        height = width // 2
        kind, view = 2, 360.0
        across = np.unwrap(np.arctan2(x, z), axis=1) * width / (2.0 * math.pi)
        down = np.arctan2(y, np.hypot(x, z)) * height / math.pi
        if np.ptp(across, axis=1).max() > 0.99 * width or np.abs(across).max() > width / 2:
            across = np.array([-width / 2, width / 2])
    else:
        reach = camera.scale / focal + np.abs(alignment.poses.position[used]).max(axis=0)
        half = np.minimum(reach, math.tan(math.radians(_LARGEST_VIEW / 2)))
        width, height = (2 * math.ceil(side * focal) for side in half.tolist())
        kind, view = 0, 2 * math.degrees(math.atan(width / 2 / focal))
        across, down = focal * x / z, focal * y / z
    left, right = np.clip([np.floor(across.min()), np.ceil(across.max())], -width / 2, width / 2) + width / 2
    top, bottom = np.clip([np.floor(down.min()), np.ceil(down.max())], -height / 2, height / 2) + height / 2
    crop = f"S{left:.0f},{right:.0f},{top:.0f},{bottom:.0f}"
    return f'p f{kind} w{width} h{height} v{view:.8g} {crop} n"TIFF_m c:LZW"'


def _seen_on(canvas: Canvas) -> FloatArray:
    """Directions, or places of the plane (3, N, N), of places all over a canvas."""
    width, height = canvas.size
    across, down = (np.linspace(-0.5, side - 0.5, _SAMPLES) for side in (width, height))
    places = np.stack([*np.meshgrid(across, down), np.ones((_SAMPLES, _SAMPLES))])
    x, y, _ = np.tensordot(np.linalg.inv(canvas.matrix), places, axes=1)
    return np.stack(np.broadcast_arrays(*canvas.projection.directions(x, y)))


def _in_file(points: FloatArray, upright: Camera, camera: Camera, orientation: int) -> FloatArray:
    """Pixels (N, 2) of an upright image as pixels of its file."""
    return camera.denormalize(upright.normalize(points) @ turning_matrix(orientation))
