"""Tables of a composite give what the compositor gives, for these images and for others in their places."""

from pathlib import Path

import numpy as np
import pytest

from rdstitch import Composer
from rdstitch.compositing import CompositeOptions, compose
from rdstitch.compositing.tables import CompositeTables
from rdstitch.errors import ArgumentError
from rdstitch.options import StitchOptions
from rdstitch.pipeline.apply_sidecar import apply
from rdstitch.pipeline.recipes import pano
from rdstitch.synthetic.rendering import Photometry
from tests.compositing_scenes import Scene, grey, render

FEATHERED = CompositeOptions(blend="feather", exposure="gain")


@pytest.fixture(scope="module")
def scene() -> Scene:
    return render(3, 2, photometry=Photometry(gain=np.array([1.0, 0.8, 1.2, 0.9, 1.1, 1.0])))


def test_the_same_image_as_the_compositor_makes(scene: Scene) -> None:
    whole = compose(scene.images, scene.canvas, FEATHERED)
    tables = CompositeTables.of(scene.images, scene.canvas, FEATHERED)
    found = tables.compose(scene.frames)
    assert found.dtype == np.uint8
    assert found.shape == whole.pixels.shape
    np.testing.assert_array_equal(tables.alpha, whole.alpha)
    difference = np.abs(found.astype(float) - whole.pixels)[tables.alpha > 0]
    assert np.percentile(difference, 99.9) <= 2.0  # coordinates in fixed point, and one rounding less


def test_other_images_from_the_same_places_lie_where_they_belong(scene: Scene) -> None:
    tables = CompositeTables.of(scene.images, scene.canvas, FEATHERED)
    other = render(3, 2, channels=1, seed=0)
    found = tables.compose([frame.astype(np.uint16) * 257 for frame in other.frames])
    assert found.dtype == np.uint16
    assert found.shape == tables.alpha.shape
    whole = compose(other.images, other.canvas, CompositeOptions(blend="none", exposure="none"))
    error = np.abs(grey(found) - grey(whole.pixels))[(tables.alpha > 0) & (whole.alpha > 0)]
    assert np.percentile(error, 95) < 0.03


def test_smaller_outputs_are_smoothed() -> None:
    scene = render(2, 1, scale=0.2)
    tables = CompositeTables.of(scene.images, scene.canvas, FEATHERED)
    error = np.abs(grey(tables.compose(scene.frames)) - scene.truth())[tables.alpha > 0]
    assert np.median(error) < 0.02


def test_what_does_not_fit_is_refused(scene: Scene) -> None:
    tables = CompositeTables.of(scene.images, scene.canvas, FEATHERED)
    with pytest.raises(ArgumentError, match="expected 6 images, not 5"):
        tables.compose(scene.frames[1:])
    with pytest.raises(ArgumentError, match="image 2 is of shape"):
        tables.compose([scene.frames[0], scene.frames[1][:-1], *scene.frames[2:]])
    with pytest.raises(ArgumentError, match="image 1 has"):
        tables.compose([frame.astype(np.int32) for frame in scene.frames])


def test_a_composer_by_a_result_and_by_its_sidecar(tmp_path: Path) -> None:
    scene = render(2, 1, seed=4)
    images = [np.ascontiguousarray(frame[..., ::-1]) for frame in scene.frames]
    options = StitchOptions(composite=CompositeOptions(exposure="none", crop="auto"))
    result = pano(images, tmp_path / "pano.png", options)
    first = Composer(result)
    found = first.compose(images)
    assert first.names == ("image_0000", "image_0001")
    assert found.shape == result.image.shape
    assert np.abs(found.astype(float) - result.image)[first.alpha > 0].mean() < 3.0
    again = Composer(apply(tmp_path / "pano.png.json", images, dry_run=True))
    # The whole canvas, where the sidecar's one was cropped.
    assert again.compose(images).shape[2] == 3
    assert again.alpha.size >= first.alpha.size
