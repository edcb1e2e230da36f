"""Where the camera was."""

import numpy as np

from rdstitch.alignment.trajectory import Trajectory
from rdstitch.export.path_plot import path_as_svg
from rdstitch.registration import Registration
from rdstitch.report.svg import section
from rdstitch.report.view_directions import view_directions


def path_over_plane(registration: Registration) -> str:
    """The path of the camera over the plane, where the model has metric poses; where it looked, if it only turned."""
    if registration.alignment.on_sphere:
        return view_directions(registration)
    if registration.alignment.poses is None:
        return section("Trajectory", "The general model has a homography for each picture, but no poses.")
    path = Trajectory.from_alignment(registration.alignment)
    length = float(np.linalg.norm(np.diff(path.position, axis=0), axis=1).sum())
    return section(
        "Trajectory",
        f"{len(path)} positions in the order of the pictures, {length:.2f} heights of the first one long; the green "
        "dot is the first, arrows point to the upper side of the picture.",
        path_as_svg(path),
    )
