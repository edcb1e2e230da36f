"""The image circle of a fisheye that does not fill its image: what is black around it is no content."""

from collections import Counter
from collections.abc import Sequence
from concurrent.futures import Executor
from functools import partial

import cv2
import numpy as np
from numpy.typing import NDArray

from rdstitch.arrays import FloatArray
from rdstitch.errors import InputError
from rdstitch.inputs.input_guard import InputGuard
from rdstitch.inputs.source import Source
from rdstitch.io.reduction import mean_of_channels
from rdstitch.pipeline.run_on_sources import run_on_sources
from rdstitch.system.cache import Cache
from rdstitch.system.dataclasses import dataclass, replace

_IMAGES = 5  # looked at, from all parts of the sequence: what is dark in their mean is dark in each
_DARK = 0.1  # of the brightest twentieth, up to which a pixel is dark: a surround has stray light, and noise
_TOLERANCE = 0.01  # of the radius that the edge of the circle may be off: JPEG files and blurred rims
_MIN_ARC = 0.5  # share of the circle that has to be seen: longer sides may cut off the rest
_RIM = 0.97  # of the radius that is used: the rim is dark and blurred


@dataclass(frozen=True)
class Circle:
    """A circle, pixels: (x, y) of its centre, and its radius."""

    center: tuple[float, float]
    radius: float


def with_image_circle(
    sources: Sequence[Source], executor: Executor, store: Cache, guard: InputGuard, megapixels: float | None
) -> list[Source]:
    """Give the cameras their image circle where the images show one; given lenses stay."""
    given = any(any(source.camera.coefficients) or source.camera.image_circle for source in sources)
    size = Counter(source.camera.image_size for source in sources).most_common(1)[0][0]
    alike = [source for source in sources if source.camera.image_size == size]
    chosen = alike[:: -(-len(alike) // _IMAGES)]
    if given or any(source.mask is not None for source in chosen):
        return list(sources)

    def compute() -> Circle | None:
        grey_of = partial(_grey_of, megapixels=megapixels)
        read = run_on_sources(executor, ((grey_of, [source]) for source in chosen), guard)
        seen = [grey for grey in read if grey is not None]
        circle = find_circle(np.mean(seen, axis=0)) if seen else None
        if circle is None:
            return None
        factor = size[0] / seen[0].shape[1]
        x, y = ((value + 0.5) * factor - 0.5 for value in circle.center)
        return Circle((x, y), _RIM * circle.radius * factor)

    found = store.recall("circles", ([source.content(store) for source in chosen], size, megapixels), compute)
    if found is None:
        return list(sources)
    return [
        source
        if source.camera.image_size != size
        else replace(source, camera=replace(source.camera, center=found.center, image_circle=found.radius))
        for source in sources
    ]


def _grey_of(sources: Sequence[Source], *, megapixels: float | None) -> NDArray[np.float32] | None:
    """Grey levels of a small version of an image, None where it cannot be read."""
    try:
        pixels = sources[0].view(megapixels).image
    except InputError:  # left out, or reported, by the detection
        return None
    return mean_of_channels(pixels.astype(np.float32))


def find_circle(grey: NDArray[np.float32]) -> Circle | None:
    """Find the circle outside which an image (h, w) is dark, up to all four corners; None where there is none."""
    black = min(float(grey.min()), 0.0)  # of samples with a sign the lowest
    dark = grey - black <= _DARK * (float(np.quantile(grey, 0.95)) - black)
    height, width = grey.shape
    if not dark[[0, 0, -1, -1], [0, -1, 0, -1]].all():
        return None
    _, labels = cv2.connectedComponents(dark.astype(np.uint8))
    surround = np.isin(labels, labels[[0, 0, -1, -1], [0, -1, 0, -1]])
    contours, _ = cv2.findContours((~surround).astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    if not contours:
        return None
    edge = max(contours, key=len)[:, 0].astype(np.float64)
    inner = (edge > 1.0).all(axis=1) & (edge < np.array([width, height]) - 2.0).all(axis=1)
    return _circle_through(edge[inner])


def _circle_through(points: FloatArray) -> Circle | None:
    """The circle on which nearly all points (N, 2) lie, around most of it."""
    if len(points) < 8:
        return None
    chosen = np.ones(len(points), dtype=np.bool_)
    for _ in range(3):
        x, y = points[chosen].T
        (a, b, c), *_ = np.linalg.lstsq(np.stack([2 * x, 2 * y, np.ones_like(x)], axis=1), x**2 + y**2, rcond=None)
        radius = float(np.sqrt(max(c + a * a + b * b, 0.0)))
        off = np.abs(np.hypot(*(points - (a, b)).T) - radius)
        chosen = off <= _TOLERANCE * radius + 1.0
        if chosen.mean() < 0.9:
            return None
    angles = np.arctan2(*(points[chosen] - (a, b)).T)
    seen = len(np.unique(np.floor(angles / np.radians(5.0)))) / 72.0
    return Circle((float(a), float(b)), radius) if seen >= _MIN_ARC else None
