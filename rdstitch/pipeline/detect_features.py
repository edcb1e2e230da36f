"""Stage: the features of every picture, and which pictures turned out to be damaged."""

from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace

import numpy as np

from rdstitch.cache import Cache
from rdstitch.errors import InputError
from rdstitch.executors import in_order
from rdstitch.features import FeatureOptions, Features, PackedFeatures, View, detect, detect_view
from rdstitch.features.options import CLOSER
from rdstitch.features.picture import halving
from rdstitch.inputs.input_guard import GuardNotes
from rdstitch.inputs.source import Source
from rdstitch.matching.feature_store import FeatureStore, StoredFeatures
from rdstitch.progress import Progress

_MIN_BATCHES = 16
"""Batches that pictures are at least divided into, so that a few keep several workers busy."""

_PICTURES_AT_ONCE = 8
"""Pictures of a task at the most."""


@dataclass(frozen=True)
class DetectedFeatures:
    """Features of N pictures.

    Attributes
    ----------
    features : FeatureStore
        In pixels of the pictures; a damaged picture has none.
    damaged : mapping of int to str
        Why the pixels of a picture could not be read, by its index.
    """

    features: FeatureStore
    damaged: Mapping[int, str]


@dataclass(frozen=True)
class DetectionTask:
    """Pictures whose features are to be detected together.

    Attributes
    ----------
    sources : sequence of Source
    options : FeatureOptions
    store : Cache
    """

    sources: Sequence[Source]
    options: FeatureOptions
    store: Cache


def detect_features(
    sources: Sequence[Source],
    options: FeatureOptions,
    executor: Executor,
    store: Cache,
    *,
    skip_bad: bool,
    progress: Progress,
) -> DetectedFeatures:
    """Detect the features of every picture, several pictures at a time.

    Parameters
    ----------
    sources : sequence of Source
    options : FeatureOptions
    executor : concurrent.futures.Executor
    store : Cache
        Where the features lie.
    skip_bad : bool
        Go on without damaged pictures instead of raising.
    progress : callable

    Raises
    ------
    InputError
        When the pixels of a picture cannot be read, unless ``skip_bad``.
    """
    results: list[StoredFeatures | InputError] = []
    for found, notes in in_order(executor, detect_batch, _tasks(sources, options, store)):
        sources[0].guard.learn(notes)
        errors = [result for result in found if isinstance(result, InputError)]
        if errors and not skip_bad:
            raise errors[0]
        results += found
        progress("detecting features", len(results), len(sources))
    return DetectedFeatures(
        FeatureStore(
            tuple(
                StoredFeatures.of(_no_features(options, source)) if isinstance(result, InputError) else result
                for source, result in zip(sources, results, strict=True)
            )
        ),
        {index: str(result) for index, result in enumerate(results) if isinstance(result, InputError)},
    )


def _tasks(sources: Sequence[Source], options: FeatureOptions, store: Cache) -> Iterator[DetectionTask]:
    size = min(_PICTURES_AT_ONCE, -(-len(sources) // _MIN_BATCHES))
    return (DetectionTask(sources[start : start + size], options, store) for start in range(0, len(sources), size))


def detect_batch(task: DetectionTask) -> tuple[list[StoredFeatures | InputError], GuardNotes]:
    """The features of each picture of a task, or why it cannot be read; and what was noticed of the files."""
    found: list[StoredFeatures | InputError] = []
    for source in task.sources:
        try:
            found.append(_detected(source, task))
        except InputError as error:
            found.append(error)
    return found, task.sources[0].guard.notes_on([source.path for source in task.sources])


def _detected(source: Source, task: DetectionTask) -> StoredFeatures:
    """The features of a picture, from an earlier run where the store has them."""
    store, options = task.store, task.options
    network = store.file(options.aliked_model)
    # What stands for its content, whatever the file is called.
    wanted = replace(options, aliked_model="") if network else options
    # Megapixels matter by what a picture is halved to; they vary with the number of pictures.
    size, megapixels = source.camera.image_size, options.limits[1]
    halvings = None if megapixels is None else (halving(size, megapixels), halving(size, CLOSER * megapixels))
    wanted = replace(wanted, work_megapixels=None)
    inputs = (source.content(store), store.file(source.mask), size, wanted, halvings, network)

    def load(megapixels: float | None) -> View:
        # It is kept for the checks that read it again.
        reduction = source.reduction(megapixels)
        picture = source.read(reduction, keep=True)
        return View(picture.pixels, picture.alpha, reduction, source.camera.image_size)

    def compute() -> PackedFeatures:
        return PackedFeatures.pack(detect_view(load, options))

    stored = store.stored(
        "features", (PackedFeatures, Features), inputs, compute, lambda found: _are_of(source, found.unpack())
    )
    return StoredFeatures(stored, len(stored.load().features))


def _are_of(source: Source, features: Features) -> bool:
    """Whether features may be those of a picture: all lie in it."""
    size = source.camera.image_size
    within = (features.points >= -0.5) & (features.points <= np.array(size) - 0.5)
    return features.image_size == size and bool(within.all()) and bool(np.isfinite(features.descriptors).all())


def _no_features(options: FeatureOptions, source: Source) -> Features:
    """Features of the same kind as those of the other pictures, but none of them."""
    return replace(detect(np.zeros((1, 1), dtype=np.uint8), options), image_size=source.camera.image_size)
