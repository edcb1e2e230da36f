"""The poses of a mosaic's images as files: a table, COLMAP's ``images.txt`` and OpenDroneMap's ``geo.txt``.

COLMAP's world has x to the east, y to the north and z up, in metres from a place that the first line tells, where the
output is georeferenced; else x to the right and y to the top of the plane, in heights of the reference image. Its
quaternions and translations lead from there to a camera with x to the right, y down and z ahead; camera 1 is that of
``--save-camera cameras.txt``. Its metres are those of the map, heights too; in the other files heights are metres on
the ground.
"""

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from rdstitch.alignment.result import PlanarPoses
from rdstitch.arrays import FloatArray
from rdstitch.choices import PosesFrame
from rdstitch.errors import ArgumentError
from rdstitch.export.trajectory_files import as_csv
from rdstitch.geometry.planar_motion import rigid_in_plane, rotation_from_tilt
from rdstitch.georeferencing.georeference import Georeference
from rdstitch.inputs.frame import frame_numbers
from rdstitch.inputs.times import timestamps_of
from rdstitch.results.stitch_result import StitchResult
from rdstitch.system.late_imports import spatial
from rdstitch.trajectories.trajectory import Trajectory


def poses_table(result: StitchResult, frame: PosesFrame = "enu", height: float = 1.0) -> str:
    """The table that ``rdstitch trajectory`` writes, of a mosaic; with covariances where ``options`` asked for them.

    Frames are those of :mod:`rdstitch.geometry.path_frames`, ``height`` that of the first image in the unit that
    positions shall have; or "map": easting, northing and the height above the ground in metres, with yaw zero where the
    top of an image is north, and covariances relative to the place of the reference image.
    """
    registration = result.registration
    if frame == "map":
        poses, to_map, place = _poses_and_map(result, "leave out --frame map")
        stds = {"length_std": registration.alignment.length_std, "scale_std": place.scale_std}
        path = Trajectory.on_map(poses, to_map, place.map_scale, **stds)
    else:
        path = Trajectory.from_alignment(registration.alignment, height)
    sources = registration.sources
    numbers = frame_numbers([source.frame for source in sources])
    path = path.labelled([source.name for source in sources], numbers, timestamps_of(sources))
    return as_csv(path, "enu" if frame == "map" else frame)


def _poses_and_map(result: StitchResult, remedy: str) -> tuple[PlanarPoses, FloatArray, Georeference]:
    """The poses, what leads (2, 3) from their plane to the map, and the place of the output there."""
    place, poses = result.georeference, result.registration.alignment.poses
    if place is None or poses is None:
        reason = result.not_georeferenced if place is None else "one homography per image has no poses"
        raise ArgumentError(f"there is no map for the poses: {reason}; {remedy}")
    if (to_pixels := result.canvas.from_level_plane) is None:
        raise ArgumentError(f"poses have no map where the plane was tilted to be upright; {remedy}")
    return poses, place.pixel_to_map @ to_pixels, place


def poses_file(result: StitchResult, file: str | Path, frame: PosesFrame = "enu", height: float = 1.0) -> str:
    """What a file of poses holds, by its name: ``images.txt`` is COLMAP's, ``geo.txt`` OpenDroneMap's, else CSV."""
    name = Path(file).name.lower()
    if name not in ("images.txt", "geo.txt"):
        return poses_table(result, frame, height)
    poses, used = result.registration.alignment.poses, result.placed.sources
    if any(source.metadata.orientation != 1 for source in used):
        raise ArgumentError(f"{file}: images that EXIF turns have other axes there; turn the files first")
    if blank := next((source.name for source in used if any(map(str.isspace, source.name))), None):
        raise ArgumentError(f"{file}: names end at blanks there; rename {blank}")
    if name == "geo.txt":
        return _geo_of_opendronemap(result)
    if poses is None:
        raise ArgumentError(f"{file}: one homography per image has no poses; --model pose gives some")
    lenses = {(c.image_size, c.center, c.focal, c.coefficients, c.lens_model) for c in result.placed.cameras}
    if len(lenses) > 1:
        raise ArgumentError(f"{file}: the images are of several cameras or sizes, and there they have the same one")
    to_map = None if result.georeference is None else _poses_and_map(result, "leave out --straighten")[1]
    return _images_of_colmap([source.name for source in result.registration.sources], poses, to_map)


def _geo_of_opendronemap(result: StitchResult) -> str:
    """The text of ``geo.txt``: the ground is where altitudes, as far as they are known, have it."""
    poses, to_map, place = _poses_and_map(result, "write images.txt or a table")
    metadata = [source.metadata for source in result.registration.sources]
    heights = poses.height * math.hypot(to_map[0, 0], to_map[1, 0]) / place.map_scale
    altitudes = [math.nan if m.gps is None or m.gps.altitude is None else m.gps.altitude for m in metadata]
    known = (np.array(altitudes) - heights)[np.isfinite(altitudes) & np.isfinite(heights)]
    ground = float(np.median(known)) if len(known) else 0.0
    centres = np.column_stack([_on_map(poses, to_map)[:, :2], ground + heights])
    rows = [
        "{} {:.4f} {:.4f} {:.4f}".format(source.name, *centre)
        for source, centre in zip(result.registration.sources, centres, strict=True)
        if np.isfinite(centre).all()
    ]
    return "\n".join([f"EPSG:{place.crs.epsg}", *rows]) + "\n"


def _images_of_colmap(names: Sequence[str], poses: PlanarPoses, to_map: FloatArray | None) -> str:
    """The text of ``images.txt``, without points; ``to_map`` (2, 3) leads from the plane, y down, to the map."""
    to_world = np.array([[1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]) if to_map is None else to_map
    unit = float(np.hypot(to_world[0, 0], to_world[1, 0]))
    known = np.flatnonzero(np.isfinite(poses.yaw))
    centres = _on_map(poses, to_world)[known]
    origin = np.zeros(3) if to_map is None else np.append(np.floor(centres[:, :2].mean(axis=0)), 0.0)
    # The plane's z is down.
    axes = np.eye(3)
    axes[:2, :2], axes[2, 2] = to_world[:, :2] / unit, -1.0
    lines = ["# origin (east, north, up): {:.0f} {:.0f} {:.0f}".format(*origin)]
    for number, (k, centre) in enumerate(zip(known.tolist(), centres - origin, strict=True), start=1):
        rotation = rotation_from_tilt(poses.tilt[k]) @ rigid_in_plane(poses.yaw[k], np.zeros(2)) @ axes.T
        x, y, z, w = spatial.transform.Rotation.from_matrix(rotation).as_quat().tolist()
        values = " ".join(f"{value:.10g}" for value in (w, x, y, z, *(-rotation @ centre).tolist()))
        lines += [f"{number} {values} 1 {names[k]}", ""]
    return "\n".join(lines) + "\n"


def _on_map(poses: PlanarPoses, to_map: FloatArray) -> FloatArray:
    """East, north and height (N, 3) of the cameras, m on the map."""
    unit = float(np.hypot(to_map[0, 0], to_map[1, 0]))
    places = poses.position @ to_map[:, :2].T + to_map[:, 2]
    return np.concatenate([places, poses.height[:, None] * unit], axis=1)
