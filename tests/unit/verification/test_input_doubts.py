"""What headers and masks show of the images."""

from types import SimpleNamespace
from typing import Any

import pytest

from rdstitch.verification.input_doubts import doubtful_inputs


def _source(
    name: str, *, model: str = "", make: str = "", serial: str = "", focal: float | None = None, mask: Any = None
) -> Any:
    metadata = SimpleNamespace(make=make, model=model, serial=serial, focal_px=focal, size=(1000, 800))
    return SimpleNamespace(name=name, metadata=metadata, mask=mask)


def _texts(*sources: Any) -> list[str]:
    return [message.text for message in doubtful_inputs(sources)]


def test_images_of_one_camera_are_fine() -> None:
    assert _texts(*(_source(f"{k}.jpg", model="A", serial="1", focal=900.0) for k in range(3))) == []
    assert _texts(_source("a"), _source("b")) == []
    assert _texts() == []


@pytest.mark.parametrize("other", [{"model": "B"}, {"model": "A", "serial": "2"}, {"make": "X", "model": "A"}])
def test_several_cameras_are_named_the_commonest_first(other: dict[str, str]) -> None:
    (text,) = _texts(
        _source("z.jpg", focal=None, mask=None, **other), *(_source(f"{k}.jpg", model="A") for k in range(2))
    )
    assert text.startswith("the images come from 2 cameras: A (2: 0.jpg, 1.jpg); ")
    assert "(1: z.jpg); stitch those of each on their own" in text


def test_a_serial_number_is_enough_and_no_header_is_no_camera() -> None:
    assert len(_texts(_source("a", serial="1"), _source("b", serial="2"))) == 1
    assert _texts(_source("a", serial="1"), _source("b", make="X")) == []


@pytest.mark.parametrize(("focal", "zoomed"), [(925.0, False), (930.0, True), (870.0, True)])
def test_a_lens_that_was_zoomed_is_noticed(focal: float, zoomed: bool) -> None:
    """By more than three per cent, of which one is rounding."""
    found = _texts(_source("a.jpg", model="A", focal=900.0), _source("b.jpg", model="A", focal=focal))
    assert bool(found) is zoomed
    if zoomed:
        near, far = ("a.jpg", "b.jpg") if focal > 900 else ("b.jpg", "a.jpg")
        ratio = max(focal, 900.0) / min(focal, 900.0)
        assert f"by up to {ratio:.2f} (between {near} and {far})" in found[0]


def test_images_without_a_mask_among_others_are_named() -> None:
    masked = [_source(f"{k}.png", mask="m") for k in range(3)]
    assert _texts(*masked) == []
    assert _texts(*masked, _source("x.png")) == ["1 of 4 images have no mask: x.png"]
    assert _texts(masked[0], _source("x.png"), _source("y.png")) == ["2 of 3 images have no mask: x.png, y.png"]
