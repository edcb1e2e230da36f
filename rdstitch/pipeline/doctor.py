"""What a run will meet: a look at each image, and the plan of a mosaic of small versions of them."""

import math
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import cv2
import numpy as np

from rdstitch.arrays import FloatArray
from rdstitch.choices import ChannelOrder
from rdstitch.compositing import CompositePlan
from rdstitch.errors import InputError, LimitError, RegistrationError
from rdstitch.features import FeatureOptions
from rdstitch.geometry.camera import points_over
from rdstitch.inputs.find import found_images
from rdstitch.inputs.frame import Frame, Images, as_inputs
from rdstitch.inputs.source import Source, read_sources
from rdstitch.io.read import DecodedImage
from rdstitch.options.option import check_parameter
from rdstitch.options.shared_options import Every
from rdstitch.options.stitch_options import StitchOptions
from rdstitch.pipeline.recipes import mosaic
from rdstitch.results.messages import Message, bytes_in_words, merge_by_reason, seconds_in_words, shortened
from rdstitch.results.registration import Registration
from rdstitch.system.native_threads import one_native_thread
from rdstitch.system.progress import Progress, silent
from rdstitch.verification.limits import Limits
from rdstitch.verification.rules import focal_ratio
from rdstitch.verification.verdict import RefusedError

_MEGAPIXELS, _FEATURES = 0.2, 500  # of the small versions
_BLURRED = 0.6  # of the median sharpness
_DARK, _BURNT = 0.06, 0.05  # mean brightness; share of burnt-out pixels
_MIN_OVERLAP = 0.3
_UNKNOWN_CAMERA = "unknown"
_GRID = 24  # points a side by which an overlap is measured


@dataclass(frozen=True)
class Examination:
    """What to expect of a run."""

    images: int
    """That can be read."""
    unreadable: tuple[str, ...]
    """Every other one, with the reason."""
    sizes: tuple[tuple[str, int], ...]
    """Width x height and how many images have it, commonest first."""
    cameras: tuple[tuple[str, int], ...]
    """Make, model and serial number by EXIF, and how many images; "unknown" where it says nothing."""
    focal: str
    """What is known of the focal length."""
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
    advice: tuple[str, ...]
    """What to change, most important first; empty where nothing is amiss."""

    def as_dict(self) -> dict[str, Any]:
        """For JSON."""
        return asdict(self)

    def as_text(self) -> str:
        """For people, one line for each thing, advice at the end."""

        def few(names: tuple[str, ...], what: str, none: str) -> str:
            return f"{len(names)} {what}: {shortened(names)}" if names else none

        overlap = "none found" if self.overlap is None else f"about {self.overlap:.0%} with the best partner"
        effort = "no mosaic is to be expected"
        if (plan := self.plan) is not None:
            effort = "{} x {} pixels; about {} of memory and {} to composite them".format(
                *plan.canvas_size, bytes_in_words(plan.memory_bytes), seconds_in_words(plan.seconds)
            )
        burnt = few(self.burnt, "burnt out", "nothing burnt out")
        lines = [
            ("images", f"{self.images}" + (f", and {len(self.unreadable)} unreadable" if self.unreadable else "")),
            *(
                (name, "; ".join(f"{item} ({count})" for item, count in items))
                for name, items in (("sizes", self.sizes), ("cameras", self.cameras))
            ),
            ("focal", self.focal),
            ("sharpness", few(self.blurred, "blurred", "nothing blurred")),
            ("exposure", f"{few(self.dark, 'dark', 'nothing dark')}; {burnt}"),
            ("overlap", f"{overlap}; {few(self.alone, 'without a place', 'every image has a place')}"),
            ("mosaic", effort),
            *(("advice", item) for item in self.advice or ["none: go ahead"]),
        ]
        return "".join(f"{name + ':':<12}{text}\n" for name, text in lines)


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
        sources, unreadable, (sharpness, brightness, burnt_out) = _measured(listed.frames, progress)
        plan, registration, problems = _dry_run(listed.frames, progress) if len(sources) > 1 else (None, None, ())

    def named(which: Iterable[Any]) -> tuple[str, ...]:
        return tuple(source.name for source, is_one in zip(sources, which, strict=True) if is_one)

    alone, overlap = named([True] * len(sources)), None
    if registration is not None:
        placed = zip(registration.sources, registration.alignment.used, strict=True)
        alone, overlap = tuple(source.name for source, is_used in placed if not is_used), _overlap(registration)
    focal, zoomed = _focal(sources)
    examination = Examination(
        images=len(sources),
        unreadable=tuple(unreadable),
        sizes=tuple(Counter("{} x {}".format(*source.metadata.size) for source in sources).most_common()),
        cameras=tuple(Counter(map(_camera, sources)).most_common()),
        focal=focal,
        blurred=named(sharpness < _BLURRED * np.median(sharpness)),
        dark=named(brightness < _DARK),
        burnt=named(burnt_out > _BURNT),
        alone=alone,
        overlap=overlap,
        plan=plan,
        advice=(),
    )
    return replace(examination, advice=_advice(examination, problems, zoomed=zoomed))


def _measured(frames: Sequence[Frame], progress: Progress) -> tuple[list[Source], list[str], FloatArray]:
    """The images that can be read, why others cannot, and sharpness, brightness and burnt-out share (3, N) of each."""
    sources, unread = read_sources(frames, skip_bad=True)
    unreadable = [f"{message.images[0]}: {message.text}" for message in unread]
    read, measured = [], []
    for done, source in enumerate(sources, start=1):
        reduction = max(1, round(np.sqrt(np.prod(source.camera.image_size) / (_MEGAPIXELS * 1e6))))
        try:
            measured.append(_sharpness_and_exposure(source.read(reduction)))
            read.append(source)
        except InputError as error:
            unreadable.append(str(error))
        progress("examining", done, len(sources))
    if not read:
        raise InputError(unreadable[0] if unreadable else "there is nothing to examine")
    sharpness, brightness, burnt, full = np.array(measured).T
    # A sensor of 12 or 14 bits shows how much of 16 it fills in the brightest image; any darker one is not burnt out.
    part = np.nan_to_num(full / np.nanmax(full, initial=0.0), nan=1.0)
    return read, unreadable, np.stack([sharpness, brightness * part, np.where(part < 1.0, 0.0, burnt)])


def _advice(examination: Examination, problems: Sequence[Message], *, zoomed: bool) -> tuple[str, ...]:
    """What to change, most important first."""
    known = [camera for camera, _ in examination.cameras if camera != _UNKNOWN_CAMERA]
    unreadable, overlap = examination.unreadable, examination.overlap
    advice = (
        (examination.images < 2, "stitching needs two images or more; name another one"),
        (len(known) > 1, f"the images come from {len(known)} cameras: stitch those of each on their own"),
        (zoomed, "the lens was zoomed between the images: stitch those of one zoom on their own"),
        (unreadable, f"{len(unreadable)} file{'s' * (len(unreadable) != 1)} cannot be read: {''.join(unreadable[:1])}"),
        *((True, str(problem)) for problem in problems),
        (
            overlap is not None and overlap < _MIN_OVERLAP,
            f"images overlap by about {overlap or 0.0:.0%} only: take more images, a third is the least",
        ),
        (
            examination.blurred,
            f"leave blurred images out if their neighbours overlap without them: {shortened(examination.blurred)}",
        ),
        (
            examination.dark or examination.burnt,
            "dark or burnt-out images have few features: fix the exposure if you can take them again",
        ),
    )
    return tuple(text for applies, text in advice if applies)


def _dry_run(
    frames: Sequence[Frame], progress: Progress
) -> tuple[CompositePlan | None, Registration | None, tuple[Message, ...]]:
    """The plan of a mosaic, how the images fit, and what the run says of it."""
    features = FeatureOptions(max_features=_FEATURES, work_megapixels=_MEGAPIXELS)
    try:
        result = mosaic(frames, options=StitchOptions(features=features, dry_run=True), progress=progress)
        plan, registration = result.plan, result.registration
    except RefusedError as refused:
        plan, registration = None, refused.registration
    except (RegistrationError, LimitError) as error:
        return None, None, (Message(str(error)),)
    problems = merge_by_reason((*registration.failures, *registration.warnings, *registration.left_out))
    return plan, registration, tuple(problems)


def _sharpness_and_exposure(image: DecodedImage) -> tuple[float, float, float, float]:
    """Contrast of the finest detail over that of twice as coarse detail, 0 without any; mean brightness, 0 to 1;
    fraction of burnt-out pixels; and of 16 bits the full scale of as many as its samples need, else NaN.
    """
    samples = image.pixels
    full, peak = 255.0, float(samples.max(where=np.isfinite(samples), initial=1e-12))
    if samples.dtype != np.uint8:
        full = 2.0 ** max(8, int(peak).bit_length()) - 1.0 if samples.dtype == np.uint16 else peak
    grey = samples if samples.ndim == 2 else samples[..., : min(3, samples.shape[2])].mean(axis=2)
    grey = np.ascontiguousarray(grey, dtype=np.float32) / np.float32(full)
    measured = np.isfinite(grey)
    seen = measured if image.alpha is None else measured & (image.alpha > 0)
    if not seen.any():
        return 0.0, 0.0, 0.0, math.nan
    grey[~measured] = grey[seen].mean()
    height, width = (max(1, round(side / 2)) for side in grey.shape)
    coarse = cv2.resize(grey, (width, height), interpolation=cv2.INTER_AREA)
    fine = float(np.abs(cv2.Laplacian(grey, cv2.CV_32F))[seen].mean())
    rough = float(np.abs(cv2.Laplacian(coarse, cv2.CV_32F)).mean())
    burnt = grey >= np.float32(254 / 255)
    sharpness = fine / rough if rough > 1e-6 else 0.0
    scale = full if samples.dtype == np.uint16 else math.nan
    return sharpness, float(grey[seen].mean()), float(burnt[seen].mean()), scale


def _overlap(registration: Registration) -> float | None:
    """Median over the images of the largest share that another one shows too."""
    alignment = registration.alignment
    best = np.zeros(len(registration.sources))
    for fit in (fit for fit in alignment.links if fit.used):
        for first, second in ((fit.image1, fit.image2), (fit.image2, fit.image1)):
            size, other = alignment.cameras[first].image_size, alignment.cameras[second].image_size
            with np.errstate(invalid="ignore"):
                moved = alignment.transfer(first, second, points_over(size, _GRID))
                inside = ((moved >= -0.5) & (moved < np.array(other) - 0.5)).all(axis=1)
            best[first] = max(best[first], inside.mean())
    return float(np.median(best[best > 0])) if (best > 0).any() else None


def _camera(source: Source) -> str:
    m = source.metadata
    # Many makers begin the model with their name.
    make = "" if m.make and m.model and m.model.lower().startswith(m.make.lower().split()[0]) else m.make
    return " ".join(filter(None, (make, m.model, m.serial))) or _UNKNOWN_CAMERA


def _focal(sources: Sequence[Source]) -> tuple[str, bool]:
    """Give what is known of the focal length, and whether the lens was zoomed."""
    zoomed = focal_ratio(source.metadata for source in sources)[0] > Limits.max_focal_ratio
    pixels = [source.metadata.focal_px for source in sources if source.metadata.focal_px is not None]
    if not pixels:
        return "not known from EXIF; it is guessed, which matters for trajectory only", zoomed
    text = f"{min(pixels):.0f}" + (f" to {max(pixels):.0f}" if zoomed else "")
    return f"{text} pixels by EXIF in {len(pixels)} of {len(sources)} images", zoomed
