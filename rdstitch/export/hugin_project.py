"""A project of Hugin: all images with lens and pose, and control points."""

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from rdstitch.alignment.frames.quarter_turns import QuarterTurns
from rdstitch.alignment.result import Alignment
from rdstitch.arrays import FloatArray
from rdstitch.camera_files.polynomials import HEAD, hugin_lens, image_line
from rdstitch.compositing.canvas import Canvas
from rdstitch.errors import ArgumentError
from rdstitch.geometry.camera import Camera
from rdstitch.geometry.planar_motion import nearest_rotation, rotation_from_tilt
from rdstitch.results.registration import Registration

_CONTROL_POINTS = 20  # of a pair; Hugin's own finder takes about as many
_SAMPLES = 65  # places along a side of the canvas, by which its bounds in another projection are found
_LARGEST_VIEW = 170.0  # degrees: of a plane seen from one height, which ends at 180


def project_of_hugin(registration: Registration, canvas: Canvas) -> str:
    """The project: images as their files store them, with yaw, pitch and roll, and over a plane with TrX, TrY, TrZ.

    Its panorama is equirectangular, or the plane seen from one height of the reference image, cropped to the output.
    """
    sources = registration.sources
    if any(source.frame is not None and source.frame.number is not None for source in sources):
        raise ArgumentError("Hugin opens image files, not frames of videos; write them as files first")
    quarters = QuarterTurns.of(sources)
    alignment = quarters.back.alignment(registration.alignment)
    if alignment.poses is None and not alignment.on_sphere:
        raise ArgumentError("Hugin knows no images with a homography of their own; --model pose gives poses")
    # The axes of the output are those of the upright reference image.
    k = alignment.reference
    upright = np.linalg.inv(registration.alignment.homographies[k])
    matrix = alignment.homographies[k] @ quarters.back.matrices[k] @ upright
    if alignment.poses is not None and canvas.orientation is not None:
        matrix = matrix @ np.linalg.inv(canvas.orientation)
    seen = np.tensordot(matrix * np.sign(np.linalg.det(matrix)), _seen_on(canvas), axes=1)
    used = np.flatnonzero(alignment.used).tolist()
    lines, variables = _image_lines(alignment, used, [source.path.absolute() for source in sources])
    control = _control_lines(registration, used, quarters)
    parts = [f"{HEAD}{_panorama(alignment, used, seen)}", "m i0", *lines, *variables, "v", *control]
    return "\n".join(parts) + "\n"


def _image_lines(alignment: Alignment, used: list[int], files: Sequence[Path]) -> tuple[list[str], list[str]]:
    """An image a line, and what is to be optimized of each; a lens that several have is linked."""
    lenses: dict[Camera, int] = {}
    lines, variables = [], []
    for place, k in enumerate(used):
        if set('"\n') & set(str(files[k])):
            raise ArgumentError(f"{files[k]}: Hugin's projects cannot name files with quotes or line ends; rename it")
        camera, pose = alignment.cameras[k], _pose(alignment, k)
        values = hugin_lens(camera)[0]
        lens = image_line(values)
        if camera in lenses:
            own = {name: values[name] for name in "whf"}
            lens = " ".join([image_line(own), *(f"{name}={lenses[camera]}" for name in values if name not in own)])
        lenses.setdefault(camera, place)
        lines.append(f'i {lens} {image_line(pose)} n"{files[k]}"')
        if k != alignment.reference:
            variables += [f"v {name}{place}" for name in pose]
    return lines, variables


def _control_lines(registration: Registration, used: list[int], quarters: QuarterTurns) -> list[str]:
    """Control points of all pairs that hold the images, as pixels of the files."""
    holding = {fit.images for fit in registration.alignment.holding}
    number = {k: place for place, k in enumerate(used)}
    lines = []
    for pair in registration.pairs:
        if pair.images not in holding or not set(pair.images) <= number.keys():
            continue
        link = quarters.back.link(pair.link().thinned(_CONTROL_POINTS), registration.alignment.cameras)
        lines += [
            f"c n{number[pair.image1]} N{number[pair.image2]} x{x:.4f} y{y:.4f} X{X:.4f} Y{Y:.4f} t0"
            for (x, y), (X, Y) in zip(link.points1.tolist(), link.points2.tolist(), strict=True)
        ]
    return lines


def _pose(alignment: Alignment, k: int) -> dict[str, float]:
    """Hugin's parameters of where an image was taken: degrees, and heights to the right, down and back."""
    poses = alignment.poses
    if poses is None:
        focal = alignment.cameras[k].with_guessed_focal().focal or 1.0
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
    camera = alignment.cameras[alignment.reference].with_guessed_focal()
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
