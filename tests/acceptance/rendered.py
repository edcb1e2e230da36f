"""What the rendered sets share: registration against the truth, and the image against the true plane."""

from functools import partial
from pathlib import Path

import numpy as np

from examples.judging import AlignmentError, PlaneComparison, alignment_error, compare_with_plane
from rdstitch import StitchResult
from rdstitch.io.read import read_image
from rdstitch.radial_homography import to_plane
from rdstitch.synthetic import Sequence


def geometry(sequence: Sequence, result: StitchResult, model: str) -> AlignmentError:
    """How far the stitched plane is from the true one, px, up to one similarity or homography."""
    alignment = result.registration.alignment
    to_output = result.canvas.matrix @ alignment.homographies
    used = np.flatnonzero(alignment.used).tolist()
    places = {i: partial(to_plane, alignment.cameras[i], to_output[i]) for i in used}
    return alignment_error(sequence, places, model=model)


def image(sequence: Sequence, output: Path, model: str) -> PlaneComparison:
    """The written image against what the images could see of the true plane, up to one transform."""
    found = read_image(output)
    assert found.alpha is not None
    shown = np.dstack([found.pixels, found.alpha])
    return compare_with_plane(shown, sequence.texture, model=model, reachable=sequence.reachable())
