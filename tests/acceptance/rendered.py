"""What the rendered sets share: registration against the truth, and the picture against the true plane."""

from functools import partial
from pathlib import Path

import numpy as np

from rdstitch import StitchResult
from rdstitch.camera import FloatArray
from rdstitch.io.read import read_image
from rdstitch.radial_homography import project
from rdstitch.synthetic import AlignmentError, PlaneComparison, Sequence, alignment_error, compare_with_plane


def geometry(sequence: Sequence, result: StitchResult, model: str) -> AlignmentError:
    """How far the stitched plane is from the true one, px, up to one similarity or homography."""
    alignment = result.registration.alignment
    places = {i: partial(_to_output, result, i) for i in range(len(sequence)) if alignment.used[i]}
    return alignment_error(sequence, places, model=model)


def picture(sequence: Sequence, output: Path, model: str) -> PlaneComparison:
    """The written picture against what the pictures could see of the true plane, up to one transform."""
    found = read_image(output)
    assert found.alpha is not None
    shown = np.dstack([found.pixels, found.alpha])
    return compare_with_plane(shown, sequence.texture, model=model, reachable=sequence.reachable())


def _to_output(result: StitchResult, index: int, points: FloatArray) -> FloatArray:
    alignment = result.registration.alignment
    camera = alignment.cameras[index]
    flat = camera.normalize(camera.undistort(points))
    matrix = result.canvas.matrix @ alignment.homographies[index]
    return project(np.column_stack([flat, np.ones(len(flat))]) @ matrix.T)
