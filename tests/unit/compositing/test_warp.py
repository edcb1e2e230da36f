"""Resampling: the right place, the right border, no aliasing."""

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from examples.worlds.compositing_scenes import as_image, grey, inner, loader, place_images, render
from rdstitch.compositing import Composite, CompositeOptions, compose, plan_canvas
from rdstitch.compositing.warp import locate, plan_warp
from rdstitch.geometry.camera import Camera

PLAIN = CompositeOptions(exposure="none", seam="none", blend="none")


def _alone(
    frame: NDArray[Any], distortion: float = 0.0, *, alpha: NDArray[np.uint8] | None = None, **canvas: float
) -> Composite:
    """One image in its own frame."""
    lens = Camera((frame.shape[1], frame.shape[0]), distortion=distortion)
    planned = plan_canvas([lens], np.eye(3)[None], **canvas)  # type: ignore[arg-type]
    return compose(place_images([loader(as_image(frame, alpha))], [lens], np.eye(3)[None]), planned, PLAIN)


def test_identity_gives_the_image_back_and_a_quarter_turn_the_image_turned() -> None:
    frame = np.random.default_rng(0).integers(0, 256, (150, 200, 3), dtype=np.uint8)
    result = _alone(frame)
    np.testing.assert_array_equal(result.pixels, frame)
    assert (result.alpha == 255).all()
    np.testing.assert_array_equal(_alone(frame[..., 0], rotate=90).pixels, np.rot90(frame[..., 0], -1))


@pytest.mark.parametrize("scale", [1.0, 0.125])
@pytest.mark.parametrize("distortion", [-0.6, -0.25, 0.0, 0.3])
def test_coordinates_are_exact_to_what_resampling_rounds(distortion: float, scale: float) -> None:
    """The interpolated lattice against the model itself, inside the image; of a smaller output, in its pixels."""
    lens = Camera((800, 600), distortion=distortion)
    matrix = np.array([[0.95, 0.2, 0.1], [-0.2, 0.95, 0.3], [0.05, -0.03, 1.0]])
    canvas = plan_canvas([lens], matrix[None], scale=scale)
    warp = plan_warp(lens, matrix, canvas, 0)
    geometry = locate(warp, warp.box)
    x0, y0, x1, y1 = warp.box
    truth = warp.source_points(
        np.arange(x0, x1, dtype=np.float64)[None, :], np.arange(y0, y1, dtype=np.float64)[:, None]
    )
    error = np.hypot(geometry.maps[0] - truth[..., 0], geometry.maps[1] - truth[..., 1])[geometry.inside]
    assert np.nanmax(error) < max(1.0, warp.shrink) / 32.0
    if distortion <= 0.0:
        assert warp.step >= (8 if scale == 1.0 else 2)


def test_a_box_anywhere_gives_the_same_coordinates() -> None:
    lens = Camera((640, 480), distortion=-0.3)
    warp = plan_warp(lens, np.eye(3), plan_canvas([lens], np.eye(3)[None]), 0)
    whole, part = locate(warp, (-40, -40, 700, 600)), locate(warp, (33, 57, 201, 190))
    cut = whole.on(part.box)
    np.testing.assert_array_equal(part.maps, cut.maps)
    np.testing.assert_array_equal(part.maps, [axis[97:230, 73:241] for axis in whole.maps])
    np.testing.assert_array_equal(part.inside, whole.inside[97:230, 73:241])
    assert cut.lattice is whole.lattice
    beyond = part.on((0, 0, 300, 200))
    np.testing.assert_array_equal(beyond.maps, whole.on(beyond.box).maps)


def test_coverage_ends_half_a_pixel_outside() -> None:
    """Shifted by 0.3 px the image still covers as many px; by 0.7 px it does too, one further on."""
    lens = Camera((50, 40))
    base = plan_canvas([lens], np.eye(3)[None])
    for shift, first in ((0.3, 0), (0.7, 1)):
        matrix = np.eye(3)
        matrix[0, 2] = shift / lens.scale
        canvas = type(base)((60, 40), base.matrix, (base.footprints[0] + (shift, 0.0),))
        result = compose(
            place_images([loader(as_image(np.full((40, 50), 9, np.uint8)))], [lens], matrix[None]), canvas, PLAIN
        )
        covered = np.flatnonzero(result.alpha[20])
        assert (covered[0], covered[-1]) == (first, first + 49)
        assert (result.pixels[result.alpha > 0] == 9).all()


def test_shrinking_does_not_alias() -> None:
    """A pattern finer than the output can show becomes its mean."""
    v, u = np.mgrid[:600, :800]
    stripes = np.where((u + v) % 3 == 0, 255, 0).astype(np.uint8)
    for scale in (0.5, 0.27, 0.1):
        middle = _alone(stripes, scale=scale).pixels[5:-5, 5:-5].astype(float)
        assert middle.mean() == pytest.approx(85, abs=1.0)
        assert middle.std() < 12


def test_shrunk_image_stays_in_place() -> None:
    scene = render(1, 1, size=(640, 480), scale=0.23)
    result = compose(scene.images, scene.canvas, PLAIN)
    truth, mine, ok = scene.truth(), grey(result.pixels), inner(result.alpha)
    shifts = [np.mean((np.roll(mine, (dy, dx), (0, 1))[ok] - truth[ok]) ** 2) for dy in (-1, 0, 1) for dx in (-1, 0, 1)]
    assert int(np.argmin(shifts)) == 4
    assert np.corrcoef(mine[ok], truth[ok])[0, 1] > 0.99


@pytest.mark.parametrize("shape", [(90, 120), (90, 120, 3), (90, 120, 5)])
@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.float32])
def test_any_samples(shape: tuple[int, ...], dtype: type) -> None:
    frame: NDArray[Any] = (np.random.default_rng(0).random(shape) * 200).astype(dtype)
    result = _alone(frame, -0.1)
    assert result.pixels.dtype == dtype
    assert result.pixels.shape[2:] == shape[2:]
    lit = result.pixels[result.alpha > 0]
    assert lit.mean() == pytest.approx(float(frame.mean()), rel=0.03)


def test_transparent_parts_leave_no_trace() -> None:
    frame = np.full((120, 160, 3), 200, np.uint8)
    alpha = np.full((120, 160), 255, np.uint8)
    frame[40:80, 50:100] = 0
    alpha[40:80, 50:100] = 0
    result = _alone(frame, -0.2, alpha=alpha)
    assert (result.pixels[result.alpha > 0] == 200).all()
    assert result.alpha[result.alpha.shape[0] // 2, result.alpha.shape[1] // 2] == 0
