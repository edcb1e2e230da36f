"""Matched pairs of images, rendered with known truth and real, that several figures use."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from rdstitch.arrays import FloatArray
from rdstitch.features import FeatureOptions, detect, match
from rdstitch.geometry.camera import Camera
from rdstitch.io.read import read_image
from rdstitch.synthetic import Photometry, RenderedSequence, ground, pair_poses, sequence_over
from rdstitch.synthetic.lenses import Lens

Tilt = tuple[float, float]


@dataclass(frozen=True)
class MatchedPair:
    """Matches of two images.

    ``points1``, ``points2``: measured px; shape (N, 2).
    """

    name: str
    points1: FloatArray
    points2: FloatArray
    quality: FloatArray  # the higher, the more distinctive; shape (N,)
    camera: Camera  # size and focal length; its λ is 0
    tilt: Tilt = (0.0, 0.0)  # true tilt (ψ, θ), radians; where it is not known, that of a levelled camera


def rendered_pair(
    lens: Lens,
    *,
    seed: int,
    overlap: float = 0.35,
    yaw: float = 0.3,
    direction: float = 0.6,
    scale: float = 1.0,
    tilt: Tilt = (0.0, 0.0),
) -> RenderedSequence:
    """Two images of a floor; noise and vignetting as of a small camera."""
    poses = pair_poses(lens, overlap, yaw=yaw, direction=direction, scale=scale, tilt=tilt)
    photometry = Photometry(gain=np.array([1.0, 0.85]), vignetting=0.2, blur=0.5, noise=0.01)
    return sequence_over(lambda size: ground(size, seed), lens, poses, photometry=photometry, seed=seed)


def match_rendered(
    sequence: RenderedSequence, name: str, *, ratio: float | None = None, features: int = 2000
) -> MatchedPair:
    """Matches of the first two images of a sequence, whose poses have one tilt."""
    options = FeatureOptions(max_features=features)
    first, second = (detect(sequence.frame(index), options) for index in (0, 1))
    matches = match(first, second, ratio)
    camera = Camera(sequence.lens.image_size, focal=sequence.lens.focal, focal_source="option")
    psi, theta = sequence.poses.tilt[0]
    return MatchedPair(name, matches.points1, matches.points2, -matches.ratio, camera, (float(psi), float(theta)))


def match_files(files: Sequence[Path], *, ratio: float | None = None, features: int = 4000) -> list[MatchedPair]:
    """Matches of consecutive images; their focal length is guessed."""
    options = FeatureOptions(max_features=features)
    images = [read_image(file).pixels for file in files]
    found = [detect(pixels, options) for pixels in images]
    pairs = []
    for k in range(len(files) - 1):
        matches = match(found[k], found[k + 1], ratio)
        camera = Camera((images[k].shape[1], images[k].shape[0])).with_guessed_focal()
        name = f"{files[k].stem} and {files[k + 1].stem}"
        pairs.append(MatchedPair(name, matches.points1, matches.points2, -matches.ratio, camera))
    return pairs
