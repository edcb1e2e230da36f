"""Parallax of a turn by hand, from images rendered with and without it."""

from pathlib import Path

import numpy as np
import pytest

from rdstitch.camera import Camera
from rdstitch.messages import Message
from rdstitch.options import StitchOptions
from rdstitch.pipeline.recipes import pano
from rdstitch.synthetic import Photometry, camera_rotations, turning_sequence
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


@pytest.mark.parametrize("radius", sampled([0.05, 0.1]))
def test_a_turn_by_hand_is_warned_of_with_the_pair_and_the_size(tmp_path: Path, radius: float) -> None:
    model, messages = _warnings(tmp_path, radius)
    assert model == "rotation"
    (warning,) = [message for message in messages if message.code == "parallax"]
    assert len(warning.images) == 2
    assert (
        "between frame_0000.png and frame_0001.png" in warning.text or "frame_0001.png and frame_0002" in warning.text
    )


def test_a_pure_turn_is_not_warned_of(tmp_path: Path) -> None:
    model, messages = _warnings(tmp_path, 0.0)
    assert model == "rotation"
    assert not messages
