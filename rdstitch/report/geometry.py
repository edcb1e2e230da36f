"""What several sections draw: where images and matches lie, and small images, as data addresses."""

import base64
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rdstitch.alignment.result import LinkFit
from rdstitch.arrays import FloatArray
from rdstitch.compositing.projection import PROJECTIONS
from rdstitch.errors import InputError
from rdstitch.inputs.source import Source
from rdstitch.io.preview import encode_preview, read_preview
from rdstitch.io.reduction import fitting_reduction
from rdstitch.matching.two_view import PairRegistration
from rdstitch.radial_homography import to_directions, to_plane
from rdstitch.registration import Registration
from rdstitch.stitch_result import StitchResult

_POINTS_PER_SIDE = 16


def footprint(registration: Registration, index: int) -> FloatArray:
    """Outline (K, 2) of an image on the plane; where the camera only turned, longitude and latitude, radians."""
    camera = registration.alignment.cameras[index]
    return _on_plane(registration, index, camera.outline(_POINTS_PER_SIDE))


def middle(registration: Registration, index: int) -> FloatArray:
    """Centre (2,) of an image, as :func:`footprint`."""
    width, height = registration.alignment.cameras[index].image_size
    return _on_plane(registration, index, np.array([[(width - 1) / 2, (height - 1) / 2]])).reshape(2)


def pairs_of(registration: Registration) -> dict[tuple[int, int], PairRegistration]:
    """The pairs by their images."""
    return {(pair.image1, pair.image2): pair for pair in registration.pairs}


def residuals(registration: Registration, fit: LinkFit) -> tuple[FloatArray, FloatArray]:
    """Where the matches of a link are in the second image, and how far from there the alignment puts them, pixels.

    Matches that the pair itself takes for wrong are left out, and those that miss by more than four times the link's
    error.
    """
    pair = pairs_of(registration)[fit.image1, fit.image2]
    inliers = pair.relation.inliers
    given, measured = pair.correspondences.points1[inliers], pair.correspondences.points2[inliers]
    off = registration.alignment.transfer(fit.image1, fit.image2, given) - measured
    kept = np.linalg.norm(off, axis=1) <= 4.0 * fit.rms
    return measured[kept], off[kept]


def _on_plane(registration: Registration, index: int, points: FloatArray) -> FloatArray:
    camera, matrix = registration.alignment.cameras[index], registration.alignment.homographies[index]
    if not registration.alignment.on_sphere:
        return to_plane(camera, matrix, points)
    places = PROJECTIONS["sphere"].project(to_directions(camera, matrix, points))
    # Longitudes of one image have no jump.
    own = np.arctan2(matrix[0, 2], matrix[2, 2])
    places[:, 0] = own + np.mod(places[:, 0] - own + np.pi, 2.0 * np.pi) - np.pi
    return places


def of_source(source: Source, side: int) -> str | None:
    """A thumbnail of an input image; None where it is gone, as frames of videos are."""
    try:
        reduction = fitting_reduction(max(source.camera.image_size) / (2 * side))
        return data_address(source.read(reduction).pixels, side)
    except InputError:
        return None


def of_mosaic(result: StitchResult, side: int, staged: Path | None = None) -> str | None:
    """A thumbnail of the output, or of its staged file; None where there is none, as after a dry run, or it is huge."""
    if result.composite is not None:
        return data_address(result.composite.pixels, side)
    file = staged or result.output
    if file is None or not file.exists():
        return None
    try:
        return data_address(read_preview(file, result.canvas.size, side)[0], side)
    except InputError:
        return None


def data_address(pixels: NDArray[Any], side: int) -> str:
    """An image of any sample type as JPEG inside a ``data:`` address, its longer side at most ``side`` pixels."""
    return "data:image/jpeg;base64," + base64.b64encode(encode_preview(pixels, side)).decode("ascii")
