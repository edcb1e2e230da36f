"""What a run will meet: a look at each image, and the plan of a mosaic of small versions of them."""

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any, Self

import numpy as np

from rdstitch.alignment import Alignment
from rdstitch.choices import ChannelOrder
from rdstitch.compositing import CompositePlan
from rdstitch.errors import InputError, LimitError, RegistrationError
from rdstitch.features import FeatureOptions
from rdstitch.features.image_quality import ImageQuality
from rdstitch.geometry.camera import points_over
from rdstitch.inputs.find import found_images
from rdstitch.inputs.frame import Frame, Images, as_inputs
from rdstitch.inputs.source import Source, read_sources
from rdstitch.options.option import check_parameter
from rdstitch.options.shared_options import Every
from rdstitch.options.stitch_options import StitchOptions
from rdstitch.pipeline.recipes import mosaic
from rdstitch.results.messages import Message, merge_by_reason, shortened
from rdstitch.results.registration import Registration
from rdstitch.system.native_threads import one_native_thread
from rdstitch.system.progress import Progress, silent
from rdstitch.verification.limits import Limits
from rdstitch.verification.rules import focal_ratio
from rdstitch.verification.verdict import RefusedError

_MEGAPIXELS, _FEATURES = 0.2, 500  # of the small versions
_BLURRED = 0.6  # of the median sharpness
_DARK, _BURNT = 0.06, 0.05  # mean brightness; share of burnt-out pixels
_OVERLAP = 0.3  # of neighbours, below which more images are advised
_GRID = 24  # points a side by which an overlap is measured


@dataclass(frozen=True)
class Examination:
    """What to expect of a run."""

    images: int
    """That can be read."""
    unreadable: tuple[str, ...]
    """Every other one, with the reason."""
    sizes: tuple[tuple[tuple[int, int], int], ...]
    """Width and height, and how many images have them, commonest first."""
    cameras: tuple[tuple[str, int], ...]
    """Make, model and serial number by EXIF, and how many images; "" where it says nothing."""
    focal_px: tuple[float, ...]
    """Focal lengths by EXIF of the images that have one, pixels."""
    zoomed: bool
    """Whether the lens was zoomed between the images."""
    blurred: tuple[str, ...]
    """Names of images that are much less sharp than the others."""
    dark: tuple[str, ...]
    """Names of images that are dark."""
    burnt: tuple[str, ...]
    """Names of images that are burnt out."""
    alone: tuple[str, ...]
    """Names of images that found no place among the others."""
    overlap: float | None
    """Median share of an image that its best partner shows too; None where nothing fits together."""
    plan: CompositePlan | None
    """Size of the mosaic, with memory and time of compositing it; None where there would be none."""
    problems: tuple[Message, ...]
    """What a run would say, gravest first."""

    @property
    def advice(self) -> tuple[str, ...]:
        """What to change, most important first; empty where nothing is amiss."""
        known, unread = [camera for camera, _ in self.cameras if camera], self.unreadable
        advice = (
            (self.images < 2, "stitching needs two images or more; name another one"),
            (len(known) > 1, f"the images come from {len(known)} cameras: stitch those of each on their own"),
            (self.zoomed, "the lens was zoomed between the images: stitch those of one zoom on their own"),
            (unread, f"{len(unread)} file{'s' * (len(unread) != 1)} cannot be read: {''.join(unread[:1])}"),
            *((True, str(problem)) for problem in self.problems),
            (
                self.overlap is not None and self.overlap < _OVERLAP,
                f"images overlap by about {self.overlap or 0.0:.0%} only: take more images, a third is the least",
            ),
            (
                self.blurred,
                f"leave blurred images out if their neighbours overlap without them: {shortened(self.blurred)}",
            ),
            (
                self.dark or self.burnt,
                "dark or burnt-out images have few features: fix the exposure if you can take them again",
            ),
        )
        return tuple(text for applies, text in advice if applies)


@one_native_thread()
def examine(
    inputs: Images,
    *,
    every: int | None = None,
    topic: str | None = None,
    channel_order: ChannelOrder = "bgr",
    progress: Progress = silent,
) -> Examination:
    """Find out what a run will meet, by a dry run of :func:`rdstitch.mosaic` on small versions of the images.

    It says what is likely: a run on larger ones sees more.

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
    check_parameter("every", Every, every)
    with found_images(as_inputs(inputs, channel_order), every=every, topic=topic) as listed:
        measured, unreadable = _measured(listed.frames, progress)
        tried = _dry_run(listed.frames, progress) if len(measured) > 1 else _DryRun()
    sources = [source for source, _ in measured]
    sharp, bright, burnt_out = np.array([(q.sharpness, q.brightness, q.burnt_out) for _, q in measured]).T

    def named(which: Iterable[Any]) -> tuple[str, ...]:
        return tuple(source.name for source, is_one in zip(sources, which, strict=True) if is_one)

    alone, overlap = named([True] * len(sources)), None
    if (registration := tried.registration) is not None:
        alignment = registration.alignment
        placed = zip(registration.sources, alignment.used, strict=True)
        alone, overlap = tuple(source.name for source, is_used in placed if not is_used), _median_overlap(alignment)
    return Examination(
        images=len(sources),
        unreadable=tuple(unreadable),
        sizes=tuple(Counter(source.metadata.size for source in sources).most_common()),
        cameras=tuple(Counter(map(_camera_name, sources)).most_common()),
        focal_px=tuple(source.metadata.focal_px for source in sources if source.metadata.focal_px is not None),
        zoomed=focal_ratio(source.metadata for source in sources)[0] > Limits.max_focal_ratio,
        blurred=named(sharp < _BLURRED * np.median(sharp)),
        dark=named(bright < _DARK),
        burnt=named(burnt_out > _BURNT),
        alone=alone,
        overlap=overlap,
        plan=tried.plan,
        problems=tried.problems,
    )


def _measured(frames: Sequence[Frame], progress: Progress) -> tuple[list[tuple[Source, ImageQuality]], list[str]]:
    """The images that can be read, with their quality; and why others cannot."""
    sources, unread = read_sources(frames, skip_bad=True)
    unreadable = [f"{message.images[0]}: {message.text}" for message in unread]
    measured = []
    for done, source in enumerate(sources, start=1):
        reduction = max(1, round(np.sqrt(np.prod(source.camera.image_size) / (_MEGAPIXELS * 1e6))))
        try:
            image = source.read(reduction)
            measured.append((source, ImageQuality.of(image.pixels, image.alpha)))
        except InputError as error:
            unreadable.append(str(error))
        progress("examining", done, len(sources))
    if not measured:
        raise InputError(unreadable[0] if unreadable else "there is nothing to examine")
    # A sensor of 12 or 14 bits shows how much of 16 it fills in the brightest image; any darker one is not burnt out.
    full = np.nanmax(np.array([quality.full_scale for _, quality in measured]), initial=0.0)
    return [(source, quality.at_full_scale(full)) for source, quality in measured], unreadable


@dataclass(frozen=True)
class _DryRun:
    """What came of a dry run, as far as it went."""

    registration: Registration | None = None
    plan: CompositePlan | None = None
    problems: tuple[Message, ...] = ()

    @classmethod
    def of(cls, registration: Registration, plan: CompositePlan | None = None) -> Self:
        """With what is amiss of a registration."""
        problems = merge_by_reason((*registration.failures, *registration.warnings, *registration.left_out))
        return cls(registration, plan, tuple(problems))


def _dry_run(frames: Sequence[Frame], progress: Progress) -> _DryRun:
    features = FeatureOptions(max_features=_FEATURES, work_megapixels=_MEGAPIXELS)
    try:
        result = mosaic(frames, options=StitchOptions(features=features, dry_run=True), progress=progress)
        return _DryRun.of(result.registration, result.plan)
    except RefusedError as refused:
        return _DryRun.of(refused.registration)
    except (RegistrationError, LimitError) as error:
        return _DryRun(problems=(Message(str(error)),))


def _median_overlap(alignment: Alignment) -> float | None:
    """Median over the images of the largest share that another one shows too; None where none overlap."""
    best = np.zeros(len(alignment.used))
    for fit in (fit for fit in alignment.links if fit.used):
        for first, second in (fit.images, fit.images[::-1]):
            size, other = alignment.cameras[first].image_size, alignment.cameras[second].image_size
            with np.errstate(invalid="ignore"):
                moved = alignment.transfer(first, second, points_over(size, _GRID))
                inside = ((moved >= -0.5) & (moved < np.array(other) - 0.5)).all(axis=1)
            best[first] = max(best[first], inside.mean())
    return float(np.median(best[best > 0])) if (best > 0).any() else None


def _camera_name(source: Source) -> str:
    m = source.metadata
    # Many makers begin the model with their name.
    make = "" if m.make and m.model and m.model.lower().startswith(m.make.lower().split()[0]) else m.make
    return " ".join(filter(None, (make, m.model, m.serial)))
