"""What a hypothesis makes of the images: how far apart the areas are that their pixels get on the common surface."""

import numpy as np

from rdstitch.alignment.adjustment_problem import Fit
from rdstitch.alignment.link_equations import split_lens
from rdstitch.alignment.motion_models import inverses
from rdstitch.arrays import FloatArray
from rdstitch.division_model import undistort

_GRID = np.stack(np.meshgrid([-0.8, 0.0, 0.8], [-0.6, 0.0, 0.6]), axis=-1).reshape(-1, 2)
"""Half diagonals: points of an image of usual proportions, out to the corners."""

_FRAMES = 12
"""Images that are tried as the frame of a plane without a metric."""

MAX_STRETCH = 10.0
"""Ratio of areas from which on a turn about the centre that joins the images is what a person would rather see. A plane
seen from above has up to 7, one seen under 35 degrees 6 to 15, by the focal length, and no turn joins such images."""


def stretch(fit: Fit) -> float:
    """Return the ratio of the areas that a pixel gets, 98 % over 2 % of all images; inf where they are folded.

    On a sphere every direction has the same room. A plane that has no metric is seen as the image shows it that does so
    best.
    """
    if fit.model.on_sphere:
        return 1.0
    distortion, higher, center = split_lens(fit.adjusted.parameters.lens)
    undistorted = undistort(_GRID - center, distortion, higher)
    rays = np.column_stack([undistorted, np.ones(len(_GRID))])
    matrices = fit.adjusted.matrices.matrices
    to_plane = inverses(matrices)
    if fit.model.one_camera:
        return _ratio(rays, to_plane)
    return min(_ratio(rays, frame @ to_plane) for frame in matrices[:: -(-len(matrices) // _FRAMES)])


def _ratio(rays: FloatArray, to_plane: FloatArray) -> float:
    """Ratio of the areas around rays (P, 3) of all images, whose homographies are (N, 3, 3)."""
    depth = rays @ to_plane[:, 2].T
    with np.errstate(all="ignore"):
        areas = np.abs(np.linalg.det(to_plane)) / depth**3
    low, high = np.quantile(np.where(areas > 0.0, areas, np.inf), [0.02, 0.98], method="nearest")
    return float(high / low) if np.isfinite(low) else np.inf
