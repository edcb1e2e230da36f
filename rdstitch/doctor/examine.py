"""The examination of a set of images, as data and in words; nothing is registered."""

import time
from collections import Counter
from collections.abc import Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from rdstitch.compositing.plan import default_memory
from rdstitch.doctor.glance import Glance, glance_at, overlap_of
from rdstitch.errors import InputError
from rdstitch.features import FeatureOptions, Features, detect
from rdstitch.inputs.find import found_images
from rdstitch.inputs.frame import ChannelOrder, Images, as_inputs
from rdstitch.inputs.source import Source, read_sources
from rdstitch.machine import processor_count
from rdstitch.matching.match_graph import connected_components
from rdstitch.messages import bytes_in_words, seconds_in_words, shortened
from rdstitch.progress import Progress, silent

_GLANCE = FeatureOptions(max_features=500, work_megapixels=None)
_MEGAPIXELS = 0.3  # of the versions that are examined
_EXHAUSTIVE_UP_TO = 24  # images of which every pair is compared; of more, those up to three apart
_MAX_SEQUENCE_GAP = 3
_BLURRED = 0.6  # of the median sharpness
_DARK, _BURNT = 0.06, 0.05  # mean brightness; share of burnt-out pixels
_MIN_OVERLAP = 0.3
_ZOOMED = 1.03  # ratio of focal lengths by EXIF
# Bytes, fitted to the sets of python -m tests.benchmarks.doctor: interpreter and libraries, detection in each thread,
# features and matches of an image, and of the compositor for each byte of the mosaic.
_BASE_MEMORY, _DETECTION_MEMORY, _FEATURES_MEMORY, _COMPOSITE_SHARE = 130 * 2**20, 75 * 2**20, 3 * 2**19, 1.5
# Of processor time, s: per pair matched and estimated, and per megapixel composited.
_SECONDS_PAIR, _SECONDS_MEGAPIXEL = 0.1, 0.2
_PAIRS_PER_IMAGE = 4


@dataclass(frozen=True)
class Examination:
    """What to expect of a run.

    Attributes
    ----------
    images : int
        That can be read.
    unreadable : tuple of str
        Every other one, with the reason.
    sizes : tuple of (str, int)
        "width x height" and how many images have it, commonest first.
    cameras : tuple of (str, int)
        Make, model and serial number by EXIF, and how many images; "unknown" where it says nothing.
    focal : str
        What is known of the focal length.
    blurred, dark, burnt : tuple of str
        Names of images that are much less sharp than the others, that are dark, and that are burnt out.
    alone : tuple of str
        Names of images that seem to overlap with no other one that was compared.
    groups : int
        Groups of images that seem to hang together.
    overlap : float or None
        Median share of an image that its best partner shows too; None where no pair was found.
    megapixels : float
        Of all images together.
    memory_bytes : int
        Expected at the peak of ``mosaic``, roughly.
    seconds : float
        Expected time of ``mosaic``, roughly, on this machine.
    advice : tuple of str
        What to change, most important first; empty where nothing is amiss.
    """

    images: int
    unreadable: tuple[str, ...]
    sizes: tuple[tuple[str, int], ...]
    cameras: tuple[tuple[str, int], ...]
    focal: str
    blurred: tuple[str, ...]
    dark: tuple[str, ...]
    burnt: tuple[str, ...]
    alone: tuple[str, ...]
    groups: int
    overlap: float | None
    megapixels: float
    memory_bytes: int
    seconds: float
    advice: tuple[str, ...]

    def as_dict(self) -> dict[str, Any]:
        """For JSON."""
        return asdict(self)

    def as_text(self) -> str:
        """For people, one line for each thing, advice at the end."""
        overlap = "none found" if self.overlap is None else f"about {self.overlap:.0%} with the best partner"
        lines = [
            f"images:   {self.images}" + (f", and {len(self.unreadable)} unreadable" if self.unreadable else ""),
            f"sizes:      {_counted(self.sizes)}",
            f"cameras:    {_counted(self.cameras)}",
            f"focal:      {self.focal}",
            f"sharpness:  {_few(self.blurred, 'blurred', 'nothing blurred')}",
            f"exposure:   {_few(self.dark, 'dark', 'nothing dark')}; "
            f"{_few(self.burnt, 'burnt out', 'nothing burnt out')}",
            f"overlap:    {overlap}; {_few(self.alone, 'without a partner', 'every image has a partner')}; "
            f"{self.groups} group" + "s" * (self.groups != 1),
            f"effort:     about {bytes_in_words(self.memory_bytes)} of memory, "
            f"{seconds_in_words(self.seconds)} for a mosaic",
        ]
        return "\n".join([*lines, *(f"advice:     {item}" for item in self.advice or ["none: go ahead"])]) + "\n"


def _counted(items: tuple[tuple[str, int], ...]) -> str:
    return "; ".join(f"{name} ({count})" for name, count in items) or "none"


def _few(names: tuple[str, ...], what: str, none: str) -> str:
    """The first names of a list, and how many there are."""
    if not names:
        return none
    return f"{len(names)} {what}: {shortened(names)}"


@dataclass(frozen=True)
class _Examined:
    glance: Glance
    features: Features
    seconds: float


def examine(
    inputs: Images,
    *,
    every: int | None = None,
    topic: str | None = None,
    channel_order: ChannelOrder = "bgr",
    progress: Progress = silent,
) -> Examination:
    """Find out at a glance what a run will meet.

    Every image is decoded once, small; neighbours are compared by a few features. It says what is likely, and decides
    nothing.

    Parameters
    ----------
    inputs, every, progress
        As for :func:`rdstitch.mosaic`.
    topic, channel_order : str
        As of :class:`rdstitch.StitchOptions`.

    Returns
    -------
    Examination

    Raises
    ------
    InputError
        When an input names nothing, or nothing can be read.
    """
    with found_images(as_inputs(inputs, channel_order), every=every, topic=topic) as images:
        sources, unread = read_sources(images.frames, skip_bad=True)
        unreadable = [f"{message.images[0]}: {message.text}" for message in unread]
        found: dict[int, _Examined] = {}
        workers = processor_count()
        with ThreadPoolExecutor(workers) as pool:
            waiting = [pool.submit(_examine_one, source) for source in sources]
            for index, future in enumerate(waiting):
                try:
                    found[index] = future.result()
                except InputError as error:
                    unreadable.append(str(error))
                progress("examining", index + 1, len(sources))
    if not found:
        raise InputError(unreadable[0] if unreadable else "there is nothing to examine")
    return _conclude([sources[k] for k in found], list(found.values()), tuple(unreadable), workers)


def _examine_one(source: Source) -> _Examined:
    began = time.thread_time()
    reduction = max(1, round(np.sqrt(np.prod(source.camera.image_size) / (_MEGAPIXELS * 1e6))))
    image = source.read(reduction)
    features = detect(image.pixels, _GLANCE, image.alpha)
    return _Examined(glance_at(image), features, time.thread_time() - began)


def _conclude(
    sources: Sequence[Source], examined: Sequence[_Examined], unreadable: tuple[str, ...], workers: int
) -> Examination:
    names, count = [source.name for source in sources], len(sources)
    sharpness = np.array([item.glance.sharpness for item in examined])
    blurred = tuple(
        name for name, value in zip(names, sharpness, strict=True) if value < _BLURRED * np.median(sharpness)
    )
    dark = tuple(n for n, item in zip(names, examined, strict=True) if item.glance.brightness < _DARK)
    burnt = tuple(n for n, item in zip(names, examined, strict=True) if item.glance.clipped > _BURNT)
    shares = _overlaps([item.features for item in examined])
    best = np.zeros(count)
    for (i, j), share in shares.items():
        best[[i, j]] = np.maximum(best[[i, j]], share)
    joined = [pair for pair, share in shares.items() if share > 0.0]
    groups = connected_components(count, [i for i, _ in joined], [j for _, j in joined])
    alone = tuple(name for name, share in zip(names, best, strict=True) if share == 0.0)
    overlap = float(np.median(best[best > 0])) if (best > 0).any() else None
    sizes = _common("{} x {}".format(*source.metadata.size) for source in sources)
    cameras = _common(_camera(source) for source in sources)
    focal, zoomed = _focal(sources)
    megapixels = sum(np.prod(source.metadata.size) for source in sources) / 1e6
    found = Examination(
        count,
        unreadable,
        sizes,
        cameras,
        focal,
        blurred,
        dark,
        burnt,
        alone,
        len(groups),
        overlap,
        float(megapixels),
        _memory(sources, overlap or 0.5, workers),
        _seconds(sources, examined, overlap or 0.5, workers),
        (),
    )
    return replace(found, advice=tuple(_advice(found, zoomed)))


def _overlaps(features: Sequence[Features]) -> dict[tuple[int, int], float]:
    """Share of overlap of the pairs that are compared: all of a few images, neighbours of many."""
    count = len(features)
    reach = count if count <= _EXHAUSTIVE_UP_TO else _MAX_SEQUENCE_GAP
    pairs = [(i, j) for i in range(count) for j in range(i + 1, min(i + reach + 1, count))]
    return {(i, j): overlap_of(features[i], features[j]) for i, j in pairs}


def _common(items: Iterable[str]) -> tuple[tuple[str, int], ...]:
    return tuple(Counter(items).most_common())


def _camera(source: Source) -> str:
    m = source.metadata
    # Many makers begin the model with their name.
    make = "" if m.make and m.model and m.model.lower().startswith(m.make.lower().split()[0]) else m.make
    return " ".join(filter(None, (make, m.model, m.serial))) or "unknown"


def _focal(sources: Sequence[Source]) -> tuple[str, bool]:
    """What is known of the focal length, and whether the lens was zoomed."""
    known = [s.metadata.focal_px / max(s.metadata.size) for s in sources if s.metadata.focal_px is not None]
    if not known:
        return "not known from EXIF; it is guessed, which matters for trajectory only", False
    zoomed = max(known) > _ZOOMED * min(known)
    pixels = [s.metadata.focal_px for s in sources if s.metadata.focal_px is not None]
    low, high = min(pixels), max(pixels)
    text = f"{low:.0f} pixels" if not zoomed else f"{low:.0f} to {high:.0f} pixels"
    return f"{text} by EXIF in {len(known)} of {len(sources)} images", zoomed


def _memory(sources: Sequence[Source], overlap: float, workers: int) -> int:
    """Libraries, features, and what detection or the compositor hold at a time."""
    shown = sum(np.prod(m.size) * m.channels * m.bit_depth / 8 for m in (source.metadata for source in sources))
    composite = min(_COMPOSITE_SHARE * _mosaic_share(overlap) * float(shown), default_memory())
    return int(_BASE_MEMORY + _FEATURES_MEMORY * len(sources) + max(_DETECTION_MEMORY * workers, composite))


def _mosaic_share(overlap: float) -> float:
    """Size of the mosaic in sizes of all images together, roughly."""
    return 1.0 - overlap / 2.0


def _seconds(sources: Sequence[Source], examined: Sequence[_Examined], overlap: float, workers: int) -> float:
    """From the time that the glance took: features of larger versions, pairs, and the composite."""
    working = FeatureOptions().for_images(len(sources)).limits[1] or np.inf
    detecting = sum(
        item.seconds * min(working, np.prod(source.metadata.size) / 1e6) / _MEGAPIXELS
        for source, item in zip(sources, examined, strict=True)
    )
    pairs = min(_PAIRS_PER_IMAGE * len(sources), len(sources) * (len(sources) - 1) / 2)
    composite = sum(np.prod(source.metadata.size) for source in sources) / 1e6 * _mosaic_share(overlap)
    total = detecting + _SECONDS_PAIR * pairs + _SECONDS_MEGAPIXEL * composite
    return float(total / workers)


def _advice(found: Examination, zoomed: bool) -> list[str]:
    """What to change, most important first."""
    advice = []
    if found.images < 2:
        advice.append("stitching needs two images or more; name another one")
    elif found.overlap is None:
        advice.append("no overlap was found: take images that overlap by a half, of something with texture")
    if len(found.cameras) > 1:
        advice.append(f"the images come from {len(found.cameras)} cameras: stitch those of each on their own")
    if zoomed:
        advice.append("the lens was zoomed between the images: stitch those of one zoom on their own")
    if found.unreadable:
        advice.append(
            f"{len(found.unreadable)} file{'s' * (len(found.unreadable) != 1)} cannot be read: {found.unreadable[0]}"
        )
    if found.overlap is not None and found.overlap < _MIN_OVERLAP:
        advice.append(f"images overlap by about {found.overlap:.0%} only: take more images, a third is the least")
    if found.overlap is not None and found.alone:
        advice.append(f"no overlap with a neighbour was seen, and may lead to being left out: {shortened(found.alone)}")
    elif found.groups > 1:
        advice.append(
            f"at a glance the images fall into {found.groups} groups: if so, only the largest becomes the mosaic"
        )
    if found.blurred:
        advice.append(
            f"leave blurred images out if their neighbours overlap without them: {', '.join(found.blurred[:3])}"
        )
    if found.dark or found.burnt:
        advice.append("dark or burnt-out images have few features: fix the exposure if you can take them again")
    return advice
