"""Registered images, turned as the user wants to see them: between registration and canvas."""

from dataclasses import fields, replace

import numpy as np

from rdstitch.compositing.upright import UprightOptions
from rdstitch.errors import ArgumentError
from rdstitch.pipeline.placed_images import PlacedImages


def turned(placed: PlacedImages, options: UprightOptions) -> PlacedImages:
    """The images as the options turn them; :attr:`PlacedImages.orientation` says by what.

    Raises
    ------
    ArgumentError
        When a plane should be turned as only a panorama can be.
    """
    view = options.view
    if view is None:
        return placed
    if not placed.turned:
        raise ArgumentError(
            "yaw, pitch and roll are for images taken by turning on the spot; these were not, use --rotate"
        )
    return replace(placed, homographies=view @ placed.homographies, orientation=view)


def turned_anew(placed: PlacedImages, options: UprightOptions, former: UprightOptions) -> PlacedImages:
    """The same of images that other options have turned before."""
    if all(getattr(options, name) == getattr(former, name) for name in (f.name for f in fields(UprightOptions))):
        return placed
    if placed.orientation is not None:
        homographies = np.linalg.inv(placed.orientation) @ placed.homographies
        placed = replace(placed, homographies=homographies, orientation=None, place=None)
    return turned(placed, options)
