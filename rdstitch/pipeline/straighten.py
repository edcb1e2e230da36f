"""Registered images, turned as the user wants to see them: between registration and canvas."""

import math
from contextlib import suppress
from dataclasses import replace
from functools import reduce

import numpy as np

from rdstitch.alignment.frames.vanishing_points import (
    Edges,
    Focal,
    Upright,
    nearest_axis,
    of_edges,
    of_rectangle,
    of_scene,
    rotation,
    to_axes,
)
from rdstitch.arrays import FloatArray, evenly_spaced
from rdstitch.errors import ArgumentError, LimitError
from rdstitch.features.line_segments import MEGAPIXELS, line_segments
from rdstitch.geometry.planar_motion import nearest_rotation
from rdstitch.options.composite_options import CompositeOptions
from rdstitch.options.upright_options import UprightOptions
from rdstitch.pipeline.map_canvas import plan
from rdstitch.results.messages import Message
from rdstitch.results.placed_images import PlacedImages
from rdstitch.verification.limits import Limits

_MAX_IMAGES = 40
_MIN_LENGTH = 0.03  # of an edge, half diagonals
_POINTING = 2.0  # pixels: how well people point at places
_DETECTION = 0.3  # pixels: how well the detector does
_SURE = 0.01  # relative standard deviation of an aspect ratio that needs no warning
_STEEP = math.cos(math.radians(30.0))  # a camera that looks nearer to straight up or down shows nothing upright


def oriented(placed: PlacedImages, options: CompositeOptions) -> tuple[PlacedImages, list[Message]]:
    """The images as the options turn them, and what the user should know of it.

    :attr:`PlacedImages.orientation` says by what.
    """
    upright, messages = _upright(placed, options) if options.upright else (None, [])
    if upright is not None and options.straighten == "auto":
        before, after = (_cut_away(placed, options, turn) for turn in (np.eye(3), upright))
        if after > before + Limits.max_straightening_cut:
            text = f"not straightened: {after:.0%} of what the images show would be cut away, and not {before:.0%}"
            text += "; choose another --projection, or raise --max-stretch"
            upright, messages = None, [Message(text, code="not-straightened")]
    view = view_rotation(options)
    if view is not None and not placed.turned:
        raise ArgumentError(
            "yaw, pitch and roll are for images taken by turning on the spot; these were not, use --rotate"
        )
    turns = [turn for turn in (view, upright) if turn is not None]
    if not turns:
        return placed, messages
    matrix: FloatArray = reduce(np.matmul, turns)
    return replace(placed, homographies=matrix @ placed.homographies, orientation=matrix), messages


def reoriented(
    placed: PlacedImages, options: CompositeOptions, former: UprightOptions
) -> tuple[PlacedImages, list[Message]]:
    """Images that former options have turned, as other options turn them, and what the user should know of it."""
    if options.same_turn(former):
        return placed, []
    if placed.orientation is not None:
        homographies = np.linalg.inv(placed.orientation) @ placed.homographies
        placed = replace(placed, homographies=homographies, orientation=None, place=None)
    return oriented(placed, options)


def view_rotation(options: UprightOptions) -> FloatArray | None:
    """Rotation (3, 3) by which what is yaw degrees to the right and pitch degrees up comes straight ahead, if any."""
    yaw, pitch, roll = np.radians([options.yaw, options.pitch, options.roll])
    if not (yaw or pitch or roll):
        return None
    return (rotation((0.0, yaw, 0.0)) @ rotation((pitch, 0.0, 0.0)) @ rotation((0.0, 0.0, roll))).T


def _cut_away(placed: PlacedImages, options: CompositeOptions, matrix: FloatArray) -> float:
    """Share of what the images show that has no place in an output that is turned; all, where it has no canvas."""
    with suppress(LimitError):
        canvas = plan(replace(placed, homographies=matrix @ placed.homographies), options)
        return canvas.cut_away(placed.cameras, matrix @ placed.homographies)
    return 1.0


def _upright(placed: PlacedImages, options: CompositeOptions) -> tuple[FloatArray | None, list[Message]]:
    """What takes the images to where the scene is upright; None where nothing shows how."""
    frame, focal = placed.homographies[_reference(placed)], _focal(placed)
    start = nearest_rotation(np.asarray(np.linalg.inv(to_axes(frame, focal.value))))
    upright: Upright | None
    message: Message | None
    if options.rectangle is not None:
        upright, message = _by_rectangle(placed, np.reshape(options.rectangle, (4, 2)), focal)
    elif options.straighten == "auto":
        upright, message = _by_edges(placed, start, focal)
    elif not isinstance(options.straighten, str):
        upright, message = _by_lines(placed, np.reshape(options.straighten, (-1, 2)), start, focal), None
    else:
        upright, message = _by_gravity(placed, start, focal)
    messages = [] if message is None else [message]
    return None if upright is None else upright.matrix(frame, turned=placed.turned), messages


def _reference(placed: PlacedImages) -> int:
    """The reference image, in whose frame everything is turned."""
    if placed.reference is None:
        raise ArgumentError("the reference image is not among the images: nothing can be turned upright")
    return placed.reference


def _by_rectangle(placed: PlacedImages, corners: FloatArray, focal: Focal) -> tuple[Upright, Message]:
    """By the corners (4, 2) of what is a rectangle in the scene, pixels of the reference image."""
    camera = placed.cameras[_reference(placed)]
    pixel = 1.0 / camera.scale
    upright, aspect, error = of_rectangle(_in_reference(placed, corners), focal, pixel)
    text = f"rectangle: {aspect:.4g} times as wide as high ± {error:.1%}"
    text += f", with a focal length of {upright.focal.value / pixel:.0f} pixels ({camera.focal_source or 'guess'})"
    return upright, Message(text, severity="warning" if error > _SURE else "note")


def _by_edges(placed: PlacedImages, start: FloatArray, focal: Focal) -> tuple[Upright | None, Message]:
    """By what seem to be horizontal and vertical edges of the scene."""
    axes = of_scene(_edges(placed), start, focal, depth=placed.turned)
    if axes is None:
        return None, Message("no straight edges were found: the output is not turned", code="not-straightened")
    upright, across, down = axes
    return upright, Message(f"straightened by {across} horizontal and {down} vertical edges", severity="note")


def _by_lines(placed: PlacedImages, ends: FloatArray, start: FloatArray, focal: Focal) -> Upright:
    """By ends (2 L, 2) of lines that are upright or level in the scene, pixels of the reference image."""
    lines = _in_reference(placed, ends).reshape(-1, 2, 2)
    error = _POINTING / placed.cameras[_reference(placed)].scale
    edges = _between(placed, np.concatenate([lines, np.ones((len(lines), 2, 1))], axis=2), error)
    return of_edges(edges, nearest_axis(edges, start[:2], focal.value), start, focal, focal.value)


def _by_gravity(placed: PlacedImages, start: FloatArray, focal: Focal) -> tuple[Upright | None, Message | None]:
    """By what was measured to be down, or is down in most images."""
    if placed.turned:
        return None, Message("the horizon of a panorama is level already", severity="note")
    upright = _level(placed, start, focal)
    return upright, Message("the camera looks straight down: there is nothing to level") if upright is None else None


def _focal(placed: PlacedImages) -> Focal:
    """The focal length of the reference image, as the alignment has it."""
    if placed.turned:
        lengths = np.linalg.norm(placed.homographies[_reference(placed)], axis=0)
        return Focal(float(lengths[2] / lengths[0]))
    camera = placed.cameras[_reference(placed)].with_guessed_focal()
    assert camera.focal is not None
    return Focal(camera.focal / camera.scale, camera.focal_log_std)


def _in_reference(placed: PlacedImages, points: FloatArray) -> FloatArray:
    """Undistorted places (N, 2) of pixels of the reference image, half diagonals from its centre."""
    camera = placed.cameras[_reference(placed)]
    flat = camera.normalize(camera.undistort(points))
    if not np.isfinite(flat).all():
        raise ArgumentError("rectangle, straighten: a place lies where the lens of the reference image shows nothing")
    return flat


def _edges(placed: PlacedImages) -> Edges:
    """Straight edges in the images."""
    to_reference = np.linalg.inv(placed.homographies[_reference(placed)]) @ placed.homographies
    segments, error = [], 0.0
    for k in evenly_spaced(len(placed.sources), _MAX_IMAGES).tolist():
        camera, (ends, pixel) = placed.cameras[k], line_segments(placed.sources[k].view(MEGAPIXELS))
        flat = camera.normalize(camera.undistort(ends.reshape(-1, 2))).reshape(-1, 2, 2)
        flat = flat[np.linalg.norm(flat[:, 1] - flat[:, 0], axis=1) > _MIN_LENGTH]
        segments.append(np.concatenate([flat, np.ones((len(flat), 2, 1))], axis=2) @ to_reference[k].T)
        error = max(error, _DETECTION * pixel / camera.scale)
    return _between(placed, np.concatenate(segments), error)


def _between(placed: PlacedImages, ends: FloatArray, error: float) -> Edges:
    """Edges by their ends (N, 2, 3) in the reference image, undistorted."""
    if not placed.turned:
        return Edges.between(ends[(ends[:, :, 2] > 0.0).all(axis=1)], error)
    focal = _focal(placed).value
    return Edges.between(ends * (1.0, 1.0, focal), error / focal, on_sphere=True)


def _level(placed: PlacedImages, start: FloatArray, focal: Focal) -> Upright | None:
    """With what is down in the scene, or else in most images, down in the output; None where that is ahead."""
    to_reference = np.linalg.inv(placed.homographies[_reference(placed)]) @ placed.homographies
    calibration = np.diag([1.0, 1.0, focal.value])
    measured = [source.down for source in placed.sources]
    known = any(down is not None for down in measured)
    directions = [
        np.sign(matrix[2, 2]) * calibration @ matrix @ np.linalg.inv(calibration) @ (down or (0.0, 1.0, 0.0))
        for matrix, down in zip(to_reference, measured, strict=True)
        if down is not None or not known
    ]
    down = np.mean([direction / np.linalg.norm(direction) for direction in directions], axis=0)
    down /= np.linalg.norm(down)
    ahead = start[2]
    if abs(down @ ahead) > _STEEP:
        return None
    if not known:
        down -= (down @ ahead) * ahead
        down /= np.linalg.norm(down)
    right = np.cross(down, ahead)
    return Upright(np.stack([right / np.linalg.norm(right), down]), focal)
