"""Stage: the features of every picture, and which pictures turned out to be damaged."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from rdstitch.cache import Cache
from rdstitch.errors import InputError
from rdstitch.features import FeatureOptions, Features, View, detect, detect_all
from rdstitch.inputs.source import Source
from rdstitch.progress import Progress


@dataclass(frozen=True)
class DetectedFeatures:
    """Features of N pictures.

    Attributes
    ----------
    features : tuple of Features
        One a picture; a damaged picture has none.
    damaged : mapping of int to str
        Why the pixels of a picture could not be read, by its index.
    """

    features: tuple[Features, ...]
    damaged: Mapping[int, str]


def detect_features(
    sources: Sequence[Source],
    options: FeatureOptions,
    workers: int,
    cache: Cache,
    *,
    skip_bad: bool,
    progress: Progress,
) -> DetectedFeatures:
    """Detect the features of every picture, several pictures at a time.

    Parameters
    ----------
    sources : sequence of Source
    options : FeatureOptions
    workers : int
        Pictures at the same time.
    cache : Cache
    skip_bad : bool
        Go on without damaged pictures instead of raising.
    progress : callable

    Raises
    ------
    InputError
        When the pixels of a picture cannot be read, unless ``skip_bad``.
    """
    network = cache.file(options.aliked_model)
    wanted = replace(options, aliked_model=None) if network else options

    def recall(index: int, compute: Callable[[], Features]) -> Features | InputError:
        source = sources[index]
        inputs = (source.content(cache), cache.file(source.mask), source.camera.image_size, wanted, network)
        try:
            return cache.recall("features", (Features,), inputs, compute, valid=lambda found: _are_of(source, found))
        except InputError as error:
            if not skip_bad:
                raise
            return error

    loaders = [partial(_load, source) for source in sources]
    found = detect_all(loaders, options, workers, partial(progress, "detecting features"), recall)
    return DetectedFeatures(
        tuple(
            _no_features(options, source) if isinstance(result, InputError) else result
            for source, result in zip(sources, found, strict=True)
        ),
        {index: str(result) for index, result in enumerate(found) if isinstance(result, InputError)},
    )


def _are_of(source: Source, features: Features) -> bool:
    """Whether features may be those of a picture: all lie in it."""
    size = source.camera.image_size
    within = (features.points >= -0.5) & (features.points <= np.array(size) - 0.5)
    return features.image_size == size and bool(within.all()) and bool(np.isfinite(features.descriptors).all())


def _load(source: Source, megapixels: float | None) -> View:
    """A picture as large as detection needs it; it is kept for the checks that read it again."""
    reduction = source.reduction(megapixels)
    picture = source.read(reduction, keep=True)
    return View(picture.pixels, picture.alpha, reduction, source.camera.image_size)


def _no_features(options: FeatureOptions, source: Source) -> Features:
    """Features of the same kind as those of the other pictures, but none of them."""
    return replace(detect(np.zeros((1, 1), dtype=np.uint8), options), image_size=source.camera.image_size)
