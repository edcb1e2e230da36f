"""The image circle of a fisheye that does not fill its image: what is black around it is no content."""

from collections import Counter
from collections.abc import Sequence
from concurrent.futures import Executor
from dataclasses import replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from rdstitch.errors import InputError
from rdstitch.features.image_circle import Circle, find_circle
from rdstitch.inputs.input_guard import InputGuard
from rdstitch.inputs.source import Source
from rdstitch.io.reduction import mean_of_channels
from rdstitch.pipeline.run_on_sources import run_on_sources
from rdstitch.system.cache import Cache

_IMAGES = 5  # looked at, from all parts of the sequence: what is dark in their mean is dark in each
_RIM = 0.97  # of the radius that is used: the rim is dark and blurred


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

    circle = store.recall("circles", ([source.content(store) for source in chosen], size, megapixels), compute)
    if circle is None:
        return list(sources)
    return [
        source
        if source.camera.image_size != size
        else replace(source, camera=replace(source.camera, center=circle.center, image_circle=circle.radius))
        for source in sources
    ]


def _grey_of(sources: Sequence[Source], *, megapixels: float | None) -> NDArray[np.float32] | None:
    """Grey levels of a small version of an image, None where it cannot be read."""
    try:
        pixels = sources[0].view(megapixels).image
    except InputError:  # left out, or reported, by the detection
        return None
    return mean_of_channels(pixels.astype(np.float32))
