"""The poses of a mosaic's images, as tables that other programs read."""

import math
from pathlib import Path

import numpy as np

from rdstitch.alignment.result import PlanarPoses
from rdstitch.alignment.trajectory import Trajectory
from rdstitch.arrays import FloatArray
from rdstitch.choices import PosesFrame
from rdstitch.errors import ArgumentError
from rdstitch.export.poses_files import geo_of_opendronemap, images_of_colmap
from rdstitch.export.trajectory_files import as_csv
from rdstitch.geometry.camera import Camera
from rdstitch.inputs.times import timestamps_of
from rdstitch.results.stitch_result import StitchResult


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
    if blank := next((name for name in names if any(map(str.isspace, name))), None):
        raise ArgumentError(f"{file}: names end at blanks there; rename {blank}")
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
    if len({_lens(camera) for camera in result.registration.alignment.cameras}) > 1:
        raise ArgumentError(f"{file}: the images are of several cameras or sizes, and there they have the same one")
    return images_of_colmap(names, poses, None if result.georeference is None else _poses_and_map(result)[1])


def _lens(camera: Camera) -> tuple[object, ...]:
    """What a camera of COLMAP has."""
    return camera.image_size, camera.center, camera.focal, camera.coefficients, camera.lens_model
