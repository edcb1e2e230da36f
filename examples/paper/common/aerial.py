"""Aerial surveys: rendered ones, and how the path of their images' centres drifts and bends."""

import numpy as np

from examples.judging import fit_similarity
from examples.judging.fitting import apply
from rdstitch.arrays import FloatArray
from rdstitch.camera import Camera
from rdstitch.radial_homography import project
from rdstitch.registration import Registration
from rdstitch.synthetic import Photometry, Sequence, ground, sequence_over, survey_poses

_CENTRE = np.array([0.0, 0.0, 1.0])


def rendered_survey(count: int, size: tuple[int, int], distortion: float, seed: int) -> Sequence:
    """Images of a drone that keeps its height and attitude, as the two-point solver asks for; a texel is a pixel."""
    lens = Camera(size, distortion, focal=1.1 * size[0], focal_source="option")
    poses = survey_poses(lens, count, forward_overlap=0.6, side_overlap=0.4, height_jitter=0.0, seed=seed)
    photometry = Photometry(vignetting=0.2, noise=0.01, blur=0.4)
    return sequence_over(lambda plane: ground(plane, seed), lens, poses, photometry=photometry, seed=seed)


def true_centres(sequence: Sequence) -> FloatArray:
    """What each image's centre shows, texels, shape (N, 2)."""
    centre = np.array([sequence.lens.center])
    return np.concatenate([sequence.to_plane(index, centre) for index in range(len(sequence))])


def adjusted_centres(registration: Registration) -> FloatArray:
    """Where the adjustment puts the images' distortion centres, shape (N, 2); NaN for images left out."""
    return project(registration.alignment.homographies @ _CENTRE)


def chained_centres(registration: Registration) -> FloatArray:
    """The same by the homographies of consecutive images, one after the other, in the frame of the first image.

    NaN from the first pair on that has none.
    """
    steps = {pair.image1: pair.relation for pair in registration.pairs if pair.image2 == pair.image1 + 1}
    count = len(registration.sources)
    to_first = np.full((count, 3, 3), np.nan)
    to_first[0] = np.eye(3)
    for index in range(count - 1):
        if not steps.get(index):
            break
        to_first[index + 1] = to_first[index] @ np.linalg.inv(steps[index].homography)
    return project(to_first @ _CENTRE)


def laid_on(truth: FloatArray, centres: FloatArray) -> FloatArray:
    """Centres after the similarity that takes them nearest to the truth."""
    known = np.isfinite(centres).all(axis=1)
    return apply(fit_similarity(centres[known], truth[known]), centres)


def drift(truth: FloatArray, centres: FloatArray) -> float:
    """Largest distance of a centre from the truth, in the unit of the truth, once laid on it."""
    return float(np.nanmax(np.linalg.norm(laid_on(truth, centres) - truth, axis=1)))


def bend(truth: FloatArray, centres: FloatArray) -> float:
    """How far the middle of a lane is displaced from where its ends say that it is: the largest of all lanes."""
    displaced = laid_on(truth, centres) - truth
    largest = [0.0]
    for lane in lanes(truth):
        share = np.linspace(0.0, 1.0, len(lane))[:, None]
        chord = (1.0 - share) * displaced[lane[0]] + share * displaced[lane[-1]]
        largest.append(float(np.nanmax(np.linalg.norm(displaced[lane] - chord, axis=1), initial=0.0)))
    return max(largest)


def lanes(truth: FloatArray) -> list[FloatArray]:
    """Indices of the images of each lane: lanes run along Y, the steps between them along X."""
    step = np.abs(np.diff(truth, axis=0))
    return np.split(np.arange(len(truth)), np.flatnonzero(step[:, 0] > step[:, 1]) + 1)
