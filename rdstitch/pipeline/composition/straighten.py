"""Registered images, turned as the user wants to see them: between registration and canvas."""

import math
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import reduce
from typing import Self

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
from rdstitch.geometry.camera import Camera
from rdstitch.geometry.planar_motion import nearest_rotation
from rdstitch.options.composite_options import CompositeOptions
from rdstitch.options.upright_options import UprightOptions
from rdstitch.pipeline.composition.map_canvas import output_canvas
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
    if options.agrees(former, UprightOptions):
        return placed, []
    if placed.orientation is not None:
        homographies = np.linalg.inv(placed.orientation) @ placed.homographies
        placed = replace(placed, homographies=homographies, orientation=None, place=None)
    turned, messages = oriented(placed, options)
    # Another plane has another place on the Earth.
    return turned if turned.orientation is None else replace(turned, place=None), messages


def view_rotation(options: UprightOptions) -> FloatArray | None:
    """Rotation (3, 3) by which what is yaw degrees to the right and pitch degrees up comes straight ahead, if any."""
    yaw, pitch, roll = np.radians([options.yaw, options.pitch, options.roll])
    if not (yaw or pitch or roll):
        return None
    return (rotation((0.0, yaw, 0.0)) @ rotation((pitch, 0.0, 0.0)) @ rotation((0.0, 0.0, roll))).T


def _cut_away(placed: PlacedImages, options: CompositeOptions, matrix: FloatArray) -> float:
    """Share of what the images show that has no place in an output that is turned; all, where it has no canvas."""
    with suppress(LimitError):
        canvas = output_canvas(replace(placed, homographies=matrix @ placed.homographies), options)
        return canvas.cut_away(placed.cameras, matrix @ placed.homographies)
    return 1.0


@dataclass(frozen=True, eq=False)
class _Reference:
    """The reference image, in whose frame everything is turned."""

    placed: PlacedImages
    camera: Camera
    frame: FloatArray  # (3, 3): its undistorted coordinates to the plane, or to directions
    focal: Focal

    @classmethod
    def of(cls, placed: PlacedImages) -> Self:
        """That of placed images, with the focal length that the alignment has."""
        if placed.reference is None:
            raise ArgumentError("the reference image is not among the images: nothing can be turned upright")
        camera, frame = placed.cameras[placed.reference], placed.homographies[placed.reference]
        if placed.turned:
            lengths = np.linalg.norm(frame, axis=0)
            return cls(placed, camera, frame, Focal(float(lengths[2] / lengths[0])))
        known = camera.with_guessed_focal()
        assert known.focal is not None
        return cls(placed, camera, frame, Focal(known.focal / known.scale, known.focal_log_std))

    @property
    def start(self) -> FloatArray:
        """Its axes (3, 3) as a rotation, where a search for those of the scene begins."""
        return nearest_rotation(np.asarray(np.linalg.inv(to_axes(self.frame, self.focal.value))))

    @property
    def from_images(self) -> FloatArray:
        """From undistorted coordinates of each image to its own, (N, 3, 3)."""
        return np.asarray(np.linalg.inv(self.frame) @ self.placed.homographies)

    def undistorted(self, points: FloatArray) -> FloatArray:
        """Undistorted places (N, 2) of its pixels, half diagonals from its centre."""
        flat = self.camera.normalize(self.camera.undistort(points))
        if not np.isfinite(flat).all():
            raise ArgumentError(
                "rectangle, straighten: a place lies where the lens of the reference image shows nothing"
            )
        return flat

    def edges(self, ends: FloatArray, error: float) -> Edges:
        """Edges by their ends (N, 2, 3) in it, undistorted."""
        if not self.placed.turned:
            return Edges.between(ends[(ends[:, :, 2] > 0.0).all(axis=1)], error)
        focal = self.focal.value
        return Edges.between(ends * (1.0, 1.0, focal), error / focal, on_sphere=True)


def _upright(placed: PlacedImages, options: CompositeOptions) -> tuple[FloatArray | None, list[Message]]:
    """What takes the images to where the scene is upright; None where nothing shows how."""
    reference = _Reference.of(placed)
    upright: Upright | None
    message: Message | None
    if options.rectangle is not None:
        upright, message = _by_rectangle(reference, np.reshape(options.rectangle, (4, 2)))
    elif options.straighten == "auto":
        upright, message = _by_edges(reference)
    elif options.straighten != "off":
        upright, message = _by_lines(reference, np.reshape(options.straighten, (-1, 2))), None
    else:
        upright, message = _by_gravity(reference)
    messages = [] if message is None else [message]
    return None if upright is None else upright.matrix(reference.frame, turned=placed.turned), messages


def _by_rectangle(reference: _Reference, corners: FloatArray) -> tuple[Upright, Message]:
    """By the corners (4, 2) of what is a rectangle in the scene, pixels of the reference image."""
    camera = reference.camera
    pixel = 1.0 / camera.scale
    upright, aspect, error = of_rectangle(reference.undistorted(corners), reference.focal, pixel)
    text = f"rectangle: {aspect:.4g} times as wide as high ± {error:.1%}"
    text += f", with a focal length of {upright.focal.value / pixel:.0f} pixels ({camera.focal_source or 'guess'})"
    return upright, Message(text, severity="warning" if error > _SURE else "note")


def _by_edges(reference: _Reference) -> tuple[Upright | None, Message]:
    """By what seem to be horizontal and vertical edges of the scene."""
    axes = of_scene(_detected_edges(reference), reference.start, reference.focal, depth=reference.placed.turned)
    if axes is None:
        return None, Message("no straight edges were found: the output is not turned", code="not-straightened")
    upright, across, down = axes
    return upright, Message(f"straightened by {across} horizontal and {down} vertical edges", severity="note")


def _by_lines(reference: _Reference, ends: FloatArray) -> Upright:
    """By ends (2 L, 2) of lines that are upright or level in the scene, pixels of the reference image."""
    lines, start, focal = reference.undistorted(ends).reshape(-1, 2, 2), reference.start, reference.focal
    error = _POINTING / reference.camera.scale
    edges = reference.edges(np.concatenate([lines, np.ones((len(lines), 2, 1))], axis=2), error)
    return of_edges(edges, nearest_axis(edges, start[:2], focal.value), start, focal, focal.value)


def _detected_edges(reference: _Reference) -> Edges:
    """Straight edges in the images."""
    placed, to_reference = reference.placed, reference.from_images
    segments, error = [], 0.0
    for k in evenly_spaced(len(placed.sources), _MAX_IMAGES).tolist():
        camera, (ends, pixel) = placed.cameras[k], line_segments(placed.sources[k].view(MEGAPIXELS))
        flat = camera.normalize(camera.undistort(ends.reshape(-1, 2))).reshape(-1, 2, 2)
        flat = flat[np.linalg.norm(flat[:, 1] - flat[:, 0], axis=1) > _MIN_LENGTH]
        segments.append(np.concatenate([flat, np.ones((len(flat), 2, 1))], axis=2) @ to_reference[k].T)
        error = max(error, _DETECTION * pixel / camera.scale)
    return reference.edges(np.concatenate(segments), error)


def _by_gravity(reference: _Reference) -> tuple[Upright | None, Message | None]:
    """By what was measured to be down, or is down in most images; None where the output is level, or that is ahead."""
    if reference.placed.turned:
        return None, Message("the horizon of a panorama is level already", severity="note")
    calibration = np.diag([1.0, 1.0, reference.focal.value])
    measured = [source.down for source in reference.placed.sources]
    known = any(down is not None for down in measured)
    directions = [
        np.sign(matrix[2, 2]) * calibration @ matrix @ np.linalg.inv(calibration) @ (down or (0.0, 1.0, 0.0))
        for matrix, down in zip(reference.from_images, measured, strict=True)
        if down is not None or not known
    ]
    down = np.mean([direction / np.linalg.norm(direction) for direction in directions], axis=0)
    down /= np.linalg.norm(down)
    ahead = reference.start[2]
    if abs(down @ ahead) > _STEEP:
        return None, Message("the camera looks straight down: there is nothing to level")
    if not known:
        down -= (down @ ahead) * ahead
        down /= np.linalg.norm(down)
    right = np.cross(down, ahead)
    return Upright(np.stack([right / np.linalg.norm(right), down]), reference.focal), None
