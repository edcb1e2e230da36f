"""How images are rendered for detection: alike if they have more than 8 bits, equalized if they show too little."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

import rdstitch
from rdstitch.camera import Camera
from rdstitch.features import FeatureOptions, detect
from rdstitch.features.prepared_image import View, common_stretch, usual_stretch
from rdstitch.synthetic import ImageTexture, Photometry, grid_poses, sequence_over
from tests.cli.running import flight

_OPTIONS = rdstitch.StitchOptions(workers=1, channel_order="rgb", features=rdstitch.FeatureOptions(max_features=800))


@pytest.fixture(scope="module")
def frames() -> list[NDArray[np.uint8]]:
    sequence = flight(3, 3)
    return [sequence.frame(index) for index in range(3)]


def _hazy(frames: list[NDArray[np.uint8]]) -> list[NDArray[np.uint8]]:
    rng = np.random.default_rng(0)
    return [
        np.clip(np.rint(150 + (frame - 128.0) / 10 + rng.normal(0.0, 0.7, frame.shape)), 0, 255).astype(np.uint8)
        for frame in frames
    ]


def test_a_tenth_of_the_contrast_with_noise_is_seen_and_said(frames: list[NDArray[np.uint8]]) -> None:
    hazy = _hazy(frames)
    clear, found = (rdstitch.calibrate(images, _OPTIONS) for images in (frames, hazy))
    assert found.alignment.used.all()
    assert any(message.code == "low-contrast" for message in found.messages)
    assert not any(message.code == "low-contrast" for message in clear.messages)
    assert clear.stretch is None
    deviation = np.hypot(clear.alignment.distortion_std, found.alignment.distortion_std)
    assert abs(clear.alignment.distortion - found.alignment.distortion) < 3 * deviation
    # Who says that nothing is to be equalized is obeyed.
    plain = replace(_OPTIONS, features=replace(_OPTIONS.features, equalize=False))
    try:
        as_it_is = rdstitch.calibrate(hazy, plain)
    except rdstitch.RdstitchError:
        return
    assert sum(as_it_is.keypoints) < sum(found.keypoints) / 2


def test_a_single_image_of_little_contrast_is_seen_and_named(frames: list[NDArray[np.uint8]]) -> None:
    clear, found = (rdstitch.calibrate(k, _OPTIONS) for k in (frames, [frames[0], _hazy(frames)[1], frames[2]]))
    assert found.alignment.used.all()
    assert found.keypoints[::2] == clear.keypoints[::2]
    assert found.keypoints[1] > clear.keypoints[1] / 2
    (message,) = [message for message in found.messages if message.code == "low-contrast"]
    assert message.images == (str(found.sources[1].path),)
    assert message.text.startswith("shows little contrast")


def test_deep_images_register_as_their_common_rendering_does(frames: list[NDArray[np.uint8]]) -> None:
    """Each image's own stretch would undo that the second one is darker."""
    darker = [np.rint(f.mean(axis=2) * gain).astype(np.uint8) for f, gain in zip(frames, (1.0, 0.5, 0.9), strict=True)]
    low, high = common_stretch(usual_stretch(View(frame)) for frame in darker) or (0.0, 255.0)
    rendered = [np.clip(np.rint((f - low) * 255.0 / (high - low)), 0, 255).astype(np.uint8) for f in darker]
    deep = [frame.astype(np.uint16) * 40 + 1000 for frame in darker]
    first, second = (rdstitch.calibrate(images, _OPTIONS) for images in (rendered, deep))
    assert second.stretch == pytest.approx((low * 40 + 1000, high * 40 + 1000))
    assert first.keypoints == second.keypoints
    np.testing.assert_allclose(first.alignment.homographies, second.alignment.homographies, atol=1e-9)


def test_an_image_unlike_the_rest_does_not_decide() -> None:
    usual = [(100.0, 900.0)] * 19
    assert common_stretch([*usual, (0.0, 65535.0)]) == (100.0, 900.0)
    assert common_stretch([None, (5.0, 9.0)]) == (5.0, 9.0)
    assert common_stretch([None]) is None
    assert usual_stretch(View(np.zeros((4, 4), np.uint8), np.zeros((4, 4), np.bool_))) is None


@pytest.mark.slow
def test_a_board_shows_few_features_but_no_little_contrast() -> None:
    """Equalized, the noise of its plain squares would drown them."""
    lens = Camera((640, 480), distortion=-0.25, focal=600.0)
    squares = np.kron(np.indices((10, 16)).sum(axis=0) % 2, np.ones((110, 110)))
    poses = grid_poses(lens, 3, 1, overlap=0.7, yaw=0.2, shift=0.05, seed=3).shaken(seed=4, tilt=0.12)
    plane = ImageTexture((60 + 130 * squares).astype(np.uint8))
    frames = sequence_over(plane, lens, poses, photometry=Photometry(noise=0.012, blur=0.7)).frames() * 3
    found = rdstitch.calibrate(frames, rdstitch.StitchOptions(workers=1))
    assert not any(message.code == "low-contrast" for message in found.messages)
    assert found.alignment.used.all()


def test_that_there_are_more_pixels_is_no_contrast(frames: list[NDArray[np.uint8]]) -> None:
    hazy = _hazy(frames)[0]
    options = FeatureOptions(max_features=800, work_megapixels=hazy.shape[0] * hazy.shape[1] / 1e6)
    small, large = (detect(np.kron(hazy, np.ones((k, k, 1), np.uint8)), options) for k in (1, 2))
    assert small.shown == large.shown
    assert small.faint
    assert large.faint
    blank = detect(np.zeros((40, 40), np.uint8), options)
    assert blank.shown == 0
    assert blank.faint
    clear = detect(frames[0], options)
    assert (clear.shown or 0) > 400
    assert not clear.faint
