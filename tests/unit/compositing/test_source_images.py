"""Pictures as the tiles need them."""

import numpy as np
from scipy.spatial import KDTree

from rdstitch.compositing.source_images import prepare_picture
from tests.compositing_scenes import as_picture


def test_what_is_transparent_has_the_samples_of_the_nearest_opaque_pixel() -> None:
    rng = np.random.default_rng(0)
    height, width = 60, 80
    opaque = np.ones((height, width), dtype=np.bool_)
    opaque[:, 55:] = False
    opaque[10:25, 10:30] = rng.random((15, 20)) > 0.7
    y, x = np.mgrid[:height, :width]
    pixels = np.stack([x, y, np.zeros_like(x)], axis=-1).astype(np.uint8)
    filled = prepare_picture(as_picture(pixels, np.where(opaque, np.uint8(255), np.uint8(0))), 1.0).pixels
    assert np.array_equal(filled[opaque], pixels[opaque])
    hidden, source = np.argwhere(~opaque), filled[~opaque][:, 1::-1].astype(np.intp)
    assert opaque[tuple(source.T)].all()
    nearest = KDTree(np.argwhere(opaque)).query(hidden)[0]
    assert (np.linalg.norm(source - hidden, axis=1) <= 1.05 * nearest).all()  # distances of 5 x 5 chamfers
