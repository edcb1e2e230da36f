"""Stage: features of all pictures by the same rendering in 8 bits, equalized where the set shows little contrast.

Pictures of more than 8 bits are stretched alike, so that they register as their common rendering in 8 bits does. Where
half of the pictures show few features for their size (haze, the sea bed, concrete, snow), all are detected again, after
a stretch and with local contrast equalized.
"""

from collections.abc import Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from rdstitch.cache import Cache
from rdstitch.errors import InputError
from rdstitch.executors import in_order
from rdstitch.features import FeatureOptions, View
from rdstitch.features.picture import Stretch, common_stretch, usual_stretch
from rdstitch.inputs.input_guard import GuardNotes
from rdstitch.inputs.source import Source
from rdstitch.pipeline.detect_features import DetectedFeatures, detect_features
from rdstitch.progress import Progress

_USUAL_DENSITY = 2000
"""Features per 10⁶ pixels that pictures of usual contrast show at least; flights show 10,000 to 15,000."""

_FEW = 0.5
"""Of those, or of the features wanted if these are fewer: where half of the pictures show less, contrast is low."""


@dataclass(frozen=True)
class DetectionByContrast:
    """Features, and how the pictures were rendered for detection.

    Attributes
    ----------
    detected : DetectedFeatures
    stretch : (float, float) or None
        Grey levels that became 0 and 255 in all pictures; None where they are those of 8 bits.
    equalized : bool
        Whether local contrast was equalized because the pictures showed too little otherwise.
    """

    detected: DetectedFeatures
    stretch: Stretch | None
    equalized: bool


def detect_by_contrast(
    sources: Sequence[Source],
    options: FeatureOptions,
    executor: Executor,
    store: Cache,
    *,
    skip_bad: bool,
    progress: Progress,
) -> DetectionByContrast:
    """Detect the features of all pictures, if necessary once more; see :func:`detect_features`."""
    detect = partial(detect_features, executor=executor, store=store, skip_bad=skip_bad, progress=progress)
    depths = {source.metadata.bit_depth > 8 for source in sources}
    stretch = options.stretch or (_stretch_of(sources, options, executor, store) if depths == {True} else None)
    options = replace(options, stretch=stretch)
    detected = detect(sources, options)
    # Samples of two kinds have no grey levels in common: each picture is stretched on its own.
    if options.equalize is not None or len(depths) > 1 or not _shows_little(sources, detected, options):
        return DetectionByContrast(detected, stretch, bool(options.equalize))
    stretch = stretch or _stretch_of(sources, options, executor, store)
    again = detect(sources, replace(options, stretch=stretch, equalize=True))
    if _typical_count(again) <= _typical_count(detected):
        return DetectionByContrast(detected, options.stretch, False)
    return DetectionByContrast(again, stretch, True)


def _shows_little(sources: Sequence[Source], detected: DetectedFeatures, options: FeatureOptions) -> bool:
    """Whether half of the pictures show few features for their size."""
    most, megapixels = options.limits
    shares = []
    for index, (source, count) in enumerate(zip(sources, detected.features.counts.tolist(), strict=True)):
        if index not in detected.damaged:
            size = np.prod(source.metadata.size) / source.reduction(megapixels) ** 2 / 1e6
            shares.append(count / min(most, _USUAL_DENSITY * size))
    return bool(shares) and float(np.median(shares)) < _FEW


def _typical_count(detected: DetectedFeatures) -> float:
    return float(np.median(detected.features.counts))


def _stretch_of(sources: Sequence[Source], options: FeatureOptions, executor: Executor, store: Cache) -> Stretch | None:
    """The stretch that suits all pictures together."""
    tasks = (_StretchTask(source, options.limits[1], store) for source in sources)
    found = []
    for stretch, notes in in_order(executor, _stretch_of_one, tasks):
        sources[0].guard.learn(notes)
        found.append(stretch)
    return common_stretch(found)


@dataclass(frozen=True)
class _StretchTask:
    """A picture whose own stretch is wanted, at so many 10⁶ pixels."""

    source: Source
    megapixels: float | None
    store: Cache


def _stretch_of_one(task: _StretchTask) -> tuple[Stretch | None, GuardNotes]:
    """The stretch of a picture, None for one that cannot be read; and what was noticed of its file."""
    source, store = task.source, task.store

    def compute() -> Stretch | None:
        reduction = source.reduction(task.megapixels)
        try:
            picture = source.read(reduction, keep=True)
        except InputError:  # left out, or reported, by the detection
            return None
        return usual_stretch(View(picture.pixels, picture.alpha, reduction, source.camera.image_size))

    inputs = (source.content(store), store.file(source.mask), task.megapixels)
    return store.recall("stretches", (), inputs, compute), source.guard.notes_on([source.path])
