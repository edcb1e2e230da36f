"""The lens of a band beside registered images, by what images of both show."""

import cv2
import numpy as np
import pytest

from rdstitch.errors import InputError
from rdstitch.inputs.frame import as_inputs
from rdstitch.inputs.source import Source, read_sources
from rdstitch.matching.band_lens import band_lens


def _bands(shifts: list[tuple[int, int] | None]) -> dict[int, tuple[Source, Source]]:
    """Images and those of a band with reversed contrast, shifted by (x, y); None: of something else."""
    rng = np.random.default_rng(0)
    ground = [cv2.GaussianBlur(rng.uniform(0, 255, (240, 320)), (0, 0), 2.0) * 4.0 - 380.0 for _ in shifts]
    other = [cv2.GaussianBlur(rng.uniform(0, 255, (240, 320)), (0, 0), 2.0) for _ in shifts]
    moved = [
        o if shift is None else 255.0 - np.roll(g, shift[::-1], (0, 1))
        for g, o, shift in zip(ground, other, shifts, strict=True)
    ]
    arrays = [np.clip(image, 0, 255).astype(np.uint8) for image in (*ground, *moved)]
    sources, _ = read_sources(as_inputs(arrays), skip_bad=False)
    return {k: (sources[k], sources[len(shifts) + k]) for k in range(len(shifts))}


@pytest.mark.parametrize("shown", [1, 2, 5])
def test_images_that_show_nothing_in_common_do_not_hide_a_shift(shown: int) -> None:
    lens = band_lens(_bands([(25, -14)] * shown + [None] * (5 - shown)))
    assert lens is not None
    assert not lens.is_same
    assert lens.shift == pytest.approx(np.hypot(25, 14), abs=0.5)


def test_a_lens_that_is_the_same_is_told_from_one_that_is_not_known() -> None:
    same = band_lens(_bands([(0, 0)] * 3))
    assert same is not None
    assert same.is_same
    assert band_lens(_bands([None] * 3)) is None


def test_of_two_images_both_are_named_with_their_difference() -> None:
    message = "image_0002: shows what image_0000 does 60 pixels further off than image_0003 does: one of them was not"
    with pytest.raises(InputError, match=message):
        band_lens(_bands([(0, 0), (60, 0)]))
    with pytest.raises(InputError, match="further off than the others do: it was not taken from the same place"):
        band_lens(_bands([(0, 0), (60, 0), (1, 0)]))
