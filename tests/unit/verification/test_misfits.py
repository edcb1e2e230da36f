"""What is said of images whose matches agree with each other, but not with the whole."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from rdstitch.alignment.result import LinkFit
from rdstitch.camera import Camera
from rdstitch.radial_homography import RadialHomography
from rdstitch.verification.misfits import disagreeing_pairs, misfitting_images

AHEAD = np.array([[1.0, 0.0, 0.3], [0.0, 1.0, 0.1], [0.0, 0.0, 1.0]])
OBLIQUE = np.array([[1.0, 0.0, 0.3], [0.0, 0.4, 0.9], [0.0, 0.9, 0.6]])


def _registration(
    count: int,
    homography: np.ndarray,
    distortion: float = -0.2,
    *,
    on_sphere: bool = False,
    agree: float = 0.2,
    keypoints: tuple[int, ...] = (900, 900, 900),
) -> Any:
    """Two images of which so many matches were given to the alignment, and a share agrees with it."""
    camera = Camera((400, 300), distortion=distortion)
    relation = RadialHomography(homography, camera, camera, np.ones(count, dtype=np.bool_), distortion_std=0.01)
    fit = LinkFit(0, 1, count, int(agree * count), 0.5, True)
    alignment = SimpleNamespace(links=(fit,), distortion=-0.2, on_sphere=on_sphere)
    pair = SimpleNamespace(image1=0, image2=1, relation=relation)
    sources = [SimpleNamespace(path=f"folder/{name}.jpg", name=f"{name}.jpg") for name in "ab"]
    return SimpleNamespace(alignment=alignment, pairs=(pair,), sources=sources, keypoints=keypoints)


@pytest.mark.parametrize(
    ("registration", "reason"),
    [
        (_registration(39, AHEAD), "too few to place it"),
        (_registration(41, AHEAD), "another plane, or none (trees, walls)?"),
        (_registration(100, AHEAD, -0.12), "another camera or zoom, or no plane?"),
        (_registration(100, AHEAD, -0.16), "another plane, or none (trees, walls)?"),
        (_registration(100, OBLIQUE), "or the horizon in view?"),
        (_registration(100, np.linalg.inv(OBLIQUE)), "or the horizon in view?"),
        (_registration(100, OBLIQUE, on_sphere=True), "another plane, or none (trees, walls)?"),
    ],
)
def test_the_reason_is_what_the_pair_shows(registration: Any, reason: str) -> None:
    (message,) = disagreeing_pairs(registration).values()
    assert message.text.startswith("a.jpg and b.jpg: only ")
    assert reason in message.text
    first, second = misfitting_images(registration, registration.alignment.links)
    assert reason in first.text
    assert second.images == ("folder/b.jpg",)


def test_an_image_of_few_features_is_said_to_be_blurred() -> None:
    registration = _registration(100, AHEAD, keypoints=(900, 200, 900))
    (message,) = disagreeing_pairs(registration).values()
    assert message.text.endswith("; b.jpg has less than a third of the features that others have (blurred?)")
    first, second = misfitting_images(registration, registration.alignment.links)
    assert "(trees, walls)?" in first.text
    assert "b.jpg has less than a third of the features that others have (blurred?)" in second.text


def test_what_agrees_is_not_named() -> None:
    half = _registration(100, AHEAD, agree=0.55)
    assert disagreeing_pairs(half) == {}
    assert len(misfitting_images(half, half.alignment.links)) == 2
    assert misfitting_images(_registration(100, AHEAD, agree=0.65), half.alignment.links[:0]) == []
