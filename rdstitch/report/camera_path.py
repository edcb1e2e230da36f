"""Where the camera was, or, if it only turned, where it looked: outlines of its images by longitude and latitude."""

import math

import numpy as np

from rdstitch.alignment.trajectory import Trajectory
from rdstitch.arrays import FloatArray
from rdstitch.compositing.panorama_canvas import seen_directions
from rdstitch.export.trajectory_files import path_as_svg
from rdstitch.registration import Registration
from rdstitch.report.geometry import middle
from rdstitch.report.svg import BLUE, GREY, RED, Markup, drawing, element, label, path, section

_WIDTH, _MARGIN = 900.0, 30.0
_STEP = 30  # degrees between the lines of the grid


def path_over_plane(registration: Registration) -> str:
    """The path of the camera over the plane, where the model has metric poses; where it looked, if it only turned."""
    if registration.alignment.on_sphere:
        return view_directions(registration)
    if registration.alignment.poses is None:
        return section("Trajectory", "The general model has a homography for each image, but no poses.")
    path = Trajectory.from_alignment(registration.alignment)
    length = float(np.linalg.norm(np.diff(path.position, axis=0), axis=1).sum())
    return section(
        "Trajectory",
        f"{len(path)} positions in the order of the images, {length:.2f} heights of the first one long; the green "
        "dot is the first, arrows point to the upper side of the image.",
        Markup(path_as_svg(path)),
    )


def view_directions(registration: Registration) -> str:
    """The sphere around the camera, laid out by longitude and latitude, with the outline of every image on it."""
    alignment = registration.alignment
    used = np.flatnonzero(alignment.used).tolist()
    view = seen_directions([alignment.cameras[k] for k in used], alignment.homographies[used])
    scale = (_WIDTH - 2 * _MARGIN) / 360.0
    height = 180.0 * scale + 2 * _MARGIN
    parts, outlines = _grid(scale), []
    for outline in view.outlines:
        degrees = np.degrees(outline)
        # What lies across the edge is drawn at both ends.
        turns = {360.0 * round(float(v) / 360.0) for v in (degrees[:, 0].min(), degrees[:, 0].max())}
        for turn in turns:
            line = _placed(degrees - (turn, 0.0), scale)
            outlines.append(path(line, closed=True, stroke=BLUE, fill=BLUE, fill_opacity=0.08, stroke_opacity=0.6))
    frame = element("rect", x=_MARGIN, y=_MARGIN, width=360.0 * scale, height=180.0 * scale)
    parts.append(element("clipPath", frame, id="all-around"))
    parts.append(element("g", outlines, clip_path="url(#all-around)"))
    for index in used:
        x, y = _placed(np.degrees(middle(registration, index))[None], scale)[0]
        fill = RED if index == alignment.reference else GREY
        parts.append(element("circle", element("title", registration.sources[index].name), cx=x, cy=y, r=3, fill=fill))
    across, down = (math.degrees(angle) for angle in view.extent)
    focal = "" if registration.camera.focal is None else f" The focal length is {registration.camera.focal:.1f} pixels."
    return section(
        "Directions",
        f"The camera turned on the spot. Its {len(used)} images show {across:.0f} x {down:.0f} degrees around it; "
        f"the line in the middle is the horizon, the red dot the reference image.{focal}",
        drawing(_WIDTH, height, parts, "directions"),
    )


def _placed(degrees: FloatArray, scale: float) -> FloatArray:
    """Longitude and latitude (K, 2), degrees, to places in the drawing."""
    placed: FloatArray = (degrees + np.array([180.0, 90.0])) * scale + _MARGIN
    return placed


def _grid(scale: float) -> list[Markup]:
    """Meridians and parallels with their degrees."""
    parts = []
    for angle in range(-180, 181, _STEP):
        line = _placed(np.array([(angle, -90.0), (angle, 90.0)]), scale)
        parts.append(path(line, stroke=GREY, stroke_opacity=0.3))
        parts.append(label(float(line[1, 0]) - 8, float(line[1, 1]) + 14, f"{angle}°", font_size=9))
    for angle in range(-90, 91, _STEP):
        line = _placed(np.array([(-180.0, angle), (180.0, angle)]), scale)
        parts.append(path(line, stroke=GREY, stroke_opacity=0.8 if angle == 0 else 0.3))
        parts.append(label(2.0, float(line[0, 1]) + 3, f"{-angle}°", font_size=9))
    return parts
