"""Straightening and view rotation of registered images, before their canvas is planned."""

from contextlib import suppress
from dataclasses import dataclass, replace
from functools import reduce

import numpy as np

from rdstitch.alignment.frames.reference_view import ReferenceView, view_rotation
from rdstitch.alignment.frames.vanishing_points import Edges, Upright, of_rectangle, of_scene
from rdstitch.arrays import FloatArray, evenly_spaced
from rdstitch.errors import ArgumentError, LimitError
from rdstitch.features.line_segments import MEGAPIXELS, line_segments
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


@dataclass(frozen=True, eq=False)
class _Straightening:
    """How the scene becomes upright."""

    upright: Upright | None = None  # None: nothing shows how
    message: Message | None = None

    def matrix(self, reference: ReferenceView) -> FloatArray | None:
        """What (3, 3) makes it upright."""
        return None if self.upright is None else self.upright.matrix(reference.frame, turned=reference.turned)


def oriented(placed: PlacedImages, options: CompositeOptions) -> tuple[PlacedImages, list[Message]]:
    """Turn the images as the options say; with messages.

    :attr:`PlacedImages.orientation` is the rotation applied.
    """
    upright, messages = None, list[Message]()
    if options.upright:
        reference = _reference_view(placed)
        found = _straightening(reference, placed, options)
        upright, messages = found.matrix(reference), [] if found.message is None else [found.message]
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
    """Turn images that former options have turned as other options say; with messages."""
    if options.agrees(former, UprightOptions):
        return placed, []
    if placed.orientation is not None:
        homographies = np.linalg.inv(placed.orientation) @ placed.homographies
        placed = replace(placed, homographies=homographies, orientation=None, place=None)
    turned, messages = oriented(placed, options)
    # Another plane has another place on the Earth.
    return turned if turned.orientation is None else replace(turned, place=None), messages


def _cut_away(placed: PlacedImages, options: CompositeOptions, matrix: FloatArray) -> float:
    """Share of the images' content that a turned output cuts away; 1 if it has no canvas."""
    with suppress(LimitError):
        canvas = output_canvas(replace(placed, homographies=matrix @ placed.homographies), options)
        return canvas.cut_away(placed.cameras, matrix @ placed.homographies)
    return 1.0


def _reference_view(placed: PlacedImages) -> ReferenceView:
    if placed.reference is None:
        raise ArgumentError("the reference image is not among the images: nothing can be turned upright")
    camera, frame = placed.cameras[placed.reference], placed.homographies[placed.reference]
    return ReferenceView.of(camera, frame, turned=placed.turned)


def _straightening(reference: ReferenceView, placed: PlacedImages, options: CompositeOptions) -> _Straightening:
    if options.rectangle is not None:
        return _by_rectangle(reference, np.reshape(options.rectangle, (4, 2)))
    if options.straighten == "auto":
        return _by_edges(reference, placed)
    if options.straighten != "off":
        return _Straightening(reference.upright_by_lines(np.reshape(options.straighten, (-1, 2)), _POINTING))
    return _by_gravity(reference, placed)


def _by_rectangle(reference: ReferenceView, corners: FloatArray) -> _Straightening:
    """By the corners (4, 2) of what is a rectangle in the scene, pixels of the reference image."""
    camera = reference.camera
    pixel = 1.0 / camera.scale
    upright, aspect, error = of_rectangle(reference.undistorted(corners), reference.focal, pixel)
    text = f"rectangle: {aspect:.4g} times as wide as high ± {error:.1%}"
    text += f", with a focal length of {upright.focal.value / pixel:.0f} pixels ({camera.focal_source or 'guess'})"
    return _Straightening(upright, Message(text, severity="warning" if error > _SURE else "note"))


def _by_edges(reference: ReferenceView, placed: PlacedImages) -> _Straightening:
    """By what seem to be horizontal and vertical edges of the scene."""
    edges = _detected_edges(reference, placed)
    axes = of_scene(edges, reference.start, reference.focal, depth=reference.turned)
    if axes is None:
        text = "no straight edges were found: the output is not turned"
        return _Straightening(message=Message(text, code="not-straightened"))
    upright, across, down = axes
    text = f"straightened by {across} horizontal and {down} vertical edges"
    return _Straightening(upright, Message(text, severity="note"))


def _detected_edges(reference: ReferenceView, placed: PlacedImages) -> Edges:
    """Straight edges in the images."""
    segments, error = [], 0.0
    to_reference = np.linalg.inv(reference.frame) @ placed.homographies
    for k in evenly_spaced(len(placed.sources), _MAX_IMAGES).tolist():
        camera, (ends, pixel) = placed.cameras[k], line_segments(placed.sources[k].view(MEGAPIXELS))
        flat = camera.normalize(camera.undistort(ends.reshape(-1, 2))).reshape(-1, 2, 2)
        flat = flat[np.linalg.norm(flat[:, 1] - flat[:, 0], axis=1) > _MIN_LENGTH]
        segments.append(np.concatenate([flat, np.ones((len(flat), 2, 1))], axis=2) @ to_reference[k].T)
        error = max(error, _DETECTION * pixel / camera.scale)
    return reference.edges(np.concatenate(segments), error)


def _by_gravity(reference: ReferenceView, placed: PlacedImages) -> _Straightening:
    """By what was measured to be down, or is down in most images."""
    if reference.turned:
        return _Straightening(message=Message("the horizon of a panorama is level already", severity="note"))
    upright = reference.upright_by_gravity(placed.homographies, [source.down for source in placed.sources])
    level = Message("the camera looks straight down: there is nothing to level") if upright is None else None
    return _Straightening(upright, level)
