"""The poses of the cameras of a mosaic as a table, in the axes of its first image or of the map."""

from typing import Literal

import numpy as np

from rdstitch.alignment.trajectory import Trajectory
from rdstitch.errors import ArgumentError
from rdstitch.export.trajectory_files import as_csv
from rdstitch.inputs.measurements import timestamps_of
from rdstitch.stitch_result import StitchResult

_LEVEL = 1e-9  # rounding of what a turn within the plane leaves as it is

PosesFrame = Literal["enu", "camera", "map"]


def poses_table(result: StitchResult, frame: PosesFrame = "enu") -> str:
    """The table that ``rdstitch trajectory`` writes, of a mosaic; with covariances where ``options`` asked for them.

    Parameters
    ----------
    frame : str
        "enu" or "camera", see :mod:`rdstitch.export.trajectory_files`, in heights of the first image; "map": easting,
        northing and the height above the ground in metres, with yaw zero where the top of an image is north. The
        covariances are then relative to the reference image; how well that is placed, the georeference says.
    """
    registration = result.registration
    path = Trajectory.from_alignment(registration.alignment)
    if frame == "map":
        place, poses = result.georeference, registration.alignment.poses
        if place is None or poses is None:
            raise ArgumentError(f"there is no map for the poses: {result.not_georeferenced}; leave out --frame map")
        turned = np.eye(3) if result.canvas.orientation is None else result.canvas.orientation
        if np.abs(turned[2, :2]).max() > _LEVEL * abs(turned[2, 2]):
            raise ArgumentError("poses have no map where the plane was tilted to be upright; leave out --frame map")
        path = Trajectory.on_map(poses, place.pixel_to_map @ result.canvas.matrix @ (turned / turned[2, 2]))
    sources = registration.sources
    numbers = [source.number(k) for k, source in enumerate(sources)]
    path = path.labelled([source.name for source in sources], numbers, timestamps_of(sources))
    return as_csv(path, "enu" if frame == "map" else frame)
