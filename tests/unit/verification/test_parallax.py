"""Parallax of a turn by hand, from images rendered with and without it."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from rdstitch.camera import Camera
from rdstitch.messages import Message
from rdstitch.pipeline import StitchOptions, pano
from rdstitch.synthetic import Photometry, camera_rotations, turning_sequence
from rdstitch.verification.parallax import find_parallax
from tests.sampled import sampled

LENS = Camera((320, 240), -0.2, focal=260.0, focal_source="option")
HEADINGS = np.radians([-35.0, 0.0, 35.0])


def _warnings(folder: Path, radius: float) -> tuple[str, list[Message]]:
    """Model and warnings of a camera that is held so far before the axis it turns about, in radii of the scene."""
    ahead = np.stack([np.sin(HEADINGS), np.zeros(3), np.cos(HEADINGS)], axis=1)
    between = np.radians([-17.0, 17.0])
    near = np.stack([np.sin(between), [0.02, -0.03], np.cos(between), [0.4, 0.4]], axis=1) * 0.45
    sequence = turning_sequence(
        LENS,
        camera_rotations(HEADINGS, [0.03, -0.02, 0.01]),
        seed=7,
        photometry=Photometry(noise=0.005),
        position=radius * ahead,
        near=near,
    )
    registration = pano(sequence.write(folder), options=StitchOptions()).registration
    return registration.alignment.model, list(registration.messages)


@pytest.mark.parametrize("radius", sampled([0.02, 0.05]))
def test_a_turn_by_hand_is_warned_of_with_the_pair_and_the_size(tmp_path: Path, radius: float) -> None:
    model, messages = _warnings(tmp_path, radius)
    assert model == "rotation"
    (warning,) = [message for message in messages if message.code == "parallax"]
    assert len(warning.images) == 2
    assert (
        "between frame_0000.png and frame_0001.png" in warning.text or "frame_0001.png and frame_0002" in warning.text
    )


def test_the_size_is_that_of_what_is_near(tmp_path: Path) -> None:
    (warning,) = [message for message in _warnings(tmp_path, 0.02)[1] if message.code == "parallax"]
    size = float(warning.text.split(" pixels")[0].rsplit(" ", 1)[1])
    # Between neighbours the camera moves by 2 r sin(17.5°) at right angles to what lies between them, whose nearest
    # point is 0.45 (1 - 0.4) away, before a scene at a distance of 1.
    expected = 260.0 * 2.0 * 0.02 * np.sin(np.radians(17.5)) * (1.0 / (0.45 * 0.6) - 1.0)
    assert size == pytest.approx(expected, rel=0.4)


def test_a_pure_turn_is_not_warned_of(tmp_path: Path) -> None:
    model, messages = _warnings(tmp_path, 0.0)
    assert model == "rotation"
    assert not messages


@pytest.mark.parametrize("focal", [0.7, 3.0])
def test_parallax_is_along_one_translation_within_pixels(focal: float) -> None:
    """What is off lies on great circles through one direction, or misses them by a share of the image at most."""
    lens = Camera((800, 600))
    scale = np.diag([1.0 / focal, 1.0 / focal, 1.0])
    rng = np.random.default_rng(0)
    points = rng.uniform((0, 0), (799, 599), (200, 2))
    far, near = points[:100], points[100:]
    for miss, found_any in (
        (0.4, True),
        (6.0, False),
    ):  # pixels beside the circle; 1.25 of a diagonal of 1000 are allowed
        off = np.zeros((100, 2))
        off[:, 0], off[:, 1] = rng.uniform(5.0, 60.0, 100), miss * np.sign(rng.normal(size=100))
        points2 = np.concatenate([far, near + off])
        matched = SimpleNamespace(points1=points, points2=points2)
        pair: Any = SimpleNamespace(image1=0, image2=1, relation=True, correspondences=matched)
        alignment: Any = SimpleNamespace(
            cameras=[lens] * 2,
            homographies=np.stack([scale, scale]),
            used=np.ones(2, dtype=np.bool_),
            focal=focal,
            transfer=lambda i, j, points: points,
        )
        found = find_parallax(alignment, [pair])
        assert bool(found) is found_any
        if found:
            assert found[0].share == pytest.approx(0.5, abs=0.02)
            assert found[0].size == pytest.approx(np.percentile(np.hypot(off[:, 0], off[:, 1]), 95), rel=0.05)
