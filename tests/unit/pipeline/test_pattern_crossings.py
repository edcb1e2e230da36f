"""Boards are calibrated by the crossings of their edges, other ground as before."""

from functools import partial

import numpy as np
import pytest

import rdstitch
from rdstitch.arrays import FloatArray
from rdstitch.camera import Camera
from rdstitch.features import FeatureOptions
from rdstitch.matching.two_view_rounds import Pairing
from rdstitch.pipeline import register as stages
from rdstitch.synthetic import ImageTexture, Sequence, grid_poses, ground, sequence_over

_LENS = Camera((400, 300), distortion=-0.25, focal=380.0)
_OPTIONS = rdstitch.StitchOptions(workers=1, features=FeatureOptions(max_features=800))


def _board() -> Sequence:
    pixels = np.kron(np.indices((20, 44)).sum(axis=0) % 2, np.ones((40, 40)))
    poses = grid_poses(_LENS, 4, 1, overlap=0.6, yaw=0.2, shift=0.05, seed=3).shaken(seed=4, tilt=0.12)
    return sequence_over(ImageTexture((60 + 130 * pixels).astype(np.uint8)), _LENS, poses)


def _bend(camera: Camera) -> float:
    """Largest distance between a camera's and the true undistorted points, pixels, at the best common scale."""
    u, v = np.meshgrid(np.linspace(0, 399, 15), np.linspace(0, 299, 11))
    points = np.column_stack([u.ravel(), v.ravel()])
    ours: FloatArray = camera.undistort(points) - _LENS.center
    true: FloatArray = _LENS.undistort(points) - _LENS.center
    scale = float(np.sum(ours * true) / np.sum(ours * ours))
    return float(np.linalg.norm(scale * ours - true, axis=1).max())


def test_boards_are_calibrated_by_crossings(monkeypatch: pytest.MonkeyPatch) -> None:
    frames = _board().frames()
    found = rdstitch.calibrate(frames, _OPTIONS)
    monkeypatch.setattr(stages, "match_crossings", lambda aligner, pairing, aligned, *_: (aligned, {}))
    before = rdstitch.calibrate(frames, _OPTIONS)
    assert found.alignment.used.all()
    assert found.alignment.rms < 0.3 * before.alignment.rms
    assert _bend(found.camera) < min(0.3, _bend(before.camera))


def test_saddles_of_other_ground_change_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    poses = grid_poses(_LENS, 3, 1, overlap=0.6, seed=3)
    frames = sequence_over(partial(ground, seed=2), _LENS, poses, seed=3).frames()
    plain = rdstitch.calibrate(frames, _OPTIONS)
    monkeypatch.setattr(Pairing, "shows_repeated_pattern", property(lambda pairing: True))
    monkeypatch.setattr(Pairing, "match_repeated_patterns", lambda pairing, pairs: pairs)
    found = rdstitch.calibrate(frames, _OPTIONS)
    assert found.camera == plain.camera
