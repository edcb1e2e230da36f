"""Tiles with stains are stitched where the stains agree."""

from functools import partial

import numpy as np
import pytest

import rdstitch
from examples.judging import alignment_error
from rdstitch.camera import Camera
from rdstitch.matching.two_view_rounds import Pairing
from rdstitch.pipeline import repeated_pattern
from rdstitch.radial_homography import to_plane
from rdstitch.synthetic import ImageTexture, Photometry, Sequence, grid_poses, ground, repeated, sequence_over
from rdstitch.verification.unique_places import UniqueShift

LENS = Camera((320, 240), distortion=-0.15, focal=350.0)
OPTIONS = rdstitch.StitchOptions(workers=1, features=rdstitch.FeatureOptions(max_features=500))


def _stained_tiles() -> Sequence:
    poses = grid_poses(LENS, 2, 1, overlap=0.5, yaw=0.1, tilt=(0.03, -0.05), seed=3)
    taken = sequence_over(
        partial(repeated, seed=3, period=60), LENS, poses, photometry=Photometry(noise=0.01), seed=3, margin=60
    )
    width, height = taken.texture.size
    pixels = taken.texture.region(0, 0, width, height).copy()
    rng = np.random.default_rng(8)
    for x, y in zip(rng.integers(8, width - 8, 25), rng.integers(8, height - 8, 25), strict=True):
        pixels[y - 4 : y + 5, x - 4 : x + 5] = rng.choice([0.02, 0.9])
    return Sequence(ImageTexture(pixels), taken.lens, taken.poses, taken.photometry, seed=3)


def test_stained_tiles_are_stitched_where_the_stains_agree() -> None:
    sequence = _stained_tiles()
    result = rdstitch.mosaic([sequence.frame(k) for k in range(len(sequence))], None, OPTIONS)
    alignment = result.registration.alignment
    assert alignment.used.all()
    transfers = {k: partial(to_plane, alignment.cameras[k], alignment.homographies[k]) for k in range(len(sequence))}
    assert alignment_error(sequence, transfers, model="homography").median < 0.3
    assert "repeated-pattern" in [message.code for message in result.registration.warnings]


def test_images_that_look_alike_nowhere_else_keep_their_places(monkeypatch: pytest.MonkeyPatch) -> None:
    # As over a car park beside a meadow: keypoints repeat, but an image shows too few periods to find stains in.
    sequence = sequence_over(partial(ground, seed=2), LENS, grid_poses(LENS, 3, 1, overlap=0.6, seed=3), seed=3)
    decided = {(0, 1): UniqueShift(np.zeros(2), 1.0, 1.0, 0.0)}
    monkeypatch.setattr(Pairing, "shows_repeated_pattern", property(lambda pairing: True))
    monkeypatch.setattr(repeated_pattern, "unique_shifts", lambda placed, pairs, workers: decided)
    result = rdstitch.mosaic([sequence.frame(k) for k in range(3)], None, OPTIONS)
    assert result.registration.alignment.used.all(), result.registration.messages
