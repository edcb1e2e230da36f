"""Stage: features of all images by the same rendering in 8 bits, equalized where the set shows little contrast.

Images of more than 8 bits are stretched alike, so that they register as their common rendering in 8 bits does. Where
half of the images show few features for their size (haze, the sea bed, concrete, snow), all are detected again, after
a stretch and with local contrast equalized. Where fewer do, or show few for the set (a cloud), they alone are.
"""

from collections.abc import Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from rdstitch.arrays import IntArray
from rdstitch.choices import Purpose
from rdstitch.errors import InputError
from rdstitch.executors import batches
from rdstitch.features import FeatureOptions, Features, PackedFeatures, detect, detect_view
from rdstitch.features.prepared_image import Stretch, common_stretch, halving, usual_stretch
from rdstitch.inputs.source import Source
from rdstitch.matching.feature_store import FeatureStore, StoredFeatures
from rdstitch.options.feature_options import CLOSER
from rdstitch.pipeline.run import Run
from rdstitch.pipeline.run_on_sources import run_on_sources
from rdstitch.system.cache import Cache
from rdstitch.system.process_memory import reuse_freed_memory

_IMAGES_AT_ONCE, _MIN_BATCHES = 8, 16  # images of a task at the most; tasks at the least
# Features per 10⁶ pixels that images of usual contrast show at least; flights show 10,000 to 15,000.
_USUAL_DENSITY = 2000
# Of those, or of the features wanted if these are fewer: where half of the images show less, contrast is low.
_LOW_SHARE = 0.5


@dataclass(frozen=True)
class DetectedFeatures:
    """Features of N images, and how the images were rendered for detection."""

    features: FeatureStore  # in pixels of the images; an unreadable image has none
    unreadable: Mapping[int, str]  # why the pixels of an image could not be read, by its index
    stretch: Stretch | None = None  # grey levels that became 0 and 255 in all images; None: those of 8 bits
    equalized: tuple[int, ...] = ()  # images whose local contrast was equalized, as they showed too little otherwise


@dataclass(frozen=True)
class Unreadable:
    """An image whose pixels cannot be read."""

    reason: str


def _detect_all(
    sources: Sequence[Source], options: FeatureOptions, run: Run, executor: Executor, store: Cache
) -> DetectedFeatures:
    """Detect the features of every image, several images at a time, into ``store``."""
    features: list[StoredFeatures] = []
    unreadable: dict[int, str] = {}
    of_batch = partial(detect_batch, options=options, store=store)
    tasks = ((of_batch, batch) for batch in batches(sources, _IMAGES_AT_ONCE, _MIN_BATCHES))
    for batch in run_on_sources(executor, tasks, run.guard):
        for detected in batch:
            index, source = len(features), sources[len(features)]
            if isinstance(detected, Unreadable):
                if run.purpose is Purpose.PANO:
                    raise InputError(detected.reason)
                run.guard.unreadable[source.path] = unreadable[index] = detected.reason
                features.append(StoredFeatures.of(_no_features(options, source)))
            else:
                features.append(detected)
        run.progress("detecting features", len(features), len(sources))
    return DetectedFeatures(FeatureStore(tuple(features)), unreadable, options.stretch)


def detect_batch(
    sources: Sequence[Source], *, options: FeatureOptions, store: Cache
) -> list[StoredFeatures | Unreadable]:
    """The features of each image."""
    reuse_freed_memory()  # also in a worker, whose later tasks return it
    detected: list[StoredFeatures | Unreadable] = []
    for source in sources:
        try:
            detected.append(_detected(source, options, store))
        except InputError as error:
            detected.append(Unreadable(str(error)))
    return detected


def _detected(source: Source, options: FeatureOptions, store: Cache) -> StoredFeatures:
    """The features of an image, from an earlier run where the store has them."""
    network = store.file(options.aliked_model)
    # What stands for its content, whatever the file is called.
    wanted = replace(options, aliked_model=network) if network else options
    # Megapixels matter by what an image is halved to; they vary with the number of images.
    size, megapixels = source.camera.image_size, options.limits[1]
    halvings = None if megapixels is None else (halving(size, megapixels), halving(size, CLOSER * megapixels))
    wanted = replace(wanted, work_megapixels=None)
    inputs = (source.content(store), source.mask_content(store), size, wanted, halvings)

    def compute() -> PackedFeatures:
        return PackedFeatures.pack(detect_view(source.view, options))

    return StoredFeatures.at(store.stored("features", inputs, compute))


def _no_features(options: FeatureOptions, source: Source) -> Features:
    """An empty set of features of the same kind."""
    return replace(detect(np.zeros((1, 1), dtype=np.uint8), options), image_size=source.camera.image_size)


def detect_by_contrast(
    sources: Sequence[Source], options: FeatureOptions, run: Run, executor: Executor, store: Cache
) -> DetectedFeatures:
    """Detect the features of all images into ``store``, again and equalized if they show few.

    Damaged images of a panorama raise.
    """
    detect = partial(_detect_all, run=run, executor=executor, store=store)
    of_one = partial(_stretch_of_one, megapixels=options.limits[1], store=store)

    def stretch_of(images: Sequence[Source]) -> Stretch | None:
        return common_stretch(list(run_on_sources(executor, ((of_one, [image]) for image in images), run.guard)))

    depths = {source.metadata.bit_depth > 8 for source in sources}
    stretch = options.stretch or (stretch_of(sources) if depths == {True} else None)
    options = replace(options, stretch=stretch)
    detected = detect(sources, options)
    # Samples of two kinds have no grey levels in common: each image is stretched on its own.
    poor = [] if options.equalize is not None or len(depths) > 1 else _of_low_contrast(sources, detected, options)
    all_of_them = tuple(range(len(sources)))
    if not poor:
        return replace(detected, equalized=all_of_them if options.equalize else ())
    most = 2 * len(poor) >= len(sources) - len(detected.unreadable)
    chosen = all_of_them if most else tuple(poor)
    wanted = [sources[k] for k in chosen]
    common = options.stretch or stretch_of(wanted)
    again = detect(wanted, replace(options, stretch=common, equalize=True))
    if np.median(_counts_of(again.features.items)) <= np.median(_counts_of(detected.features.items)[list(chosen)]):
        return detected
    items = dict(enumerate(detected.features.items)) | dict(zip(chosen, again.features.items, strict=True))
    features = FeatureStore(tuple(items.values()))
    return replace(detected, features=features, stretch=common if most else stretch, equalized=chosen)


def _of_low_contrast(sources: Sequence[Source], detected: DetectedFeatures, options: FeatureOptions) -> list[int]:
    """The images that show few features for their size, or for what the set shows, for want of contrast.

    A board of black and white squares shows few, but strong ones; equalization would only add noise.
    """
    most, megapixels = options.limits
    counts, poor = np.minimum(_counts_of(detected.features.items), most), []
    readable = np.delete(counts, list(detected.unreadable))
    usual = float(np.median(readable)) if len(readable) else 0.0
    for index, (source, count) in enumerate(zip(sources, counts.tolist(), strict=True)):
        size = np.prod(source.metadata.size) / source.reduction(megapixels) ** 2 / 1e6
        few = count < _LOW_SHARE * min(most, max(_USUAL_DENSITY * size, usual))
        if few and detected.features.items[index].low_contrast and index not in detected.unreadable:
            poor.append(index)
    return poor


def _counts_of(features: Sequence[StoredFeatures]) -> IntArray:
    """Keypoints that each image shows at its working size, (N,)."""
    return np.array([item.detected_count for item in features], dtype=np.intp)


def _stretch_of_one(sources: Sequence[Source], *, megapixels: float | None, store: Cache) -> Stretch | None:
    """The stretch of an image, None for one that cannot be read."""
    (source,) = sources

    def compute() -> Stretch | None:
        try:
            return usual_stretch(source.view(megapixels))
        except InputError:  # left out, or reported, by the detection
            return None

    return store.recall("stretches", (source.content(store), source.mask_content(store), megapixels), compute)
