"""What a run will meet: a look at each image, and a dry run on small versions of them."""

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import cv2
import numpy as np

from rdstitch.camera import points_over
from rdstitch.compositing import CompositePlan
from rdstitch.errors import InputError, RegistrationError
from rdstitch.features import FeatureOptions
from rdstitch.inputs.find import found_images
from rdstitch.inputs.frame import ChannelOrder, Frame, Images, as_inputs
from rdstitch.inputs.source import Source, read_sources
from rdstitch.io.read import DecodedImage
from rdstitch.messages import Message, bytes_in_words, seconds_in_words, shortened, told_once
from rdstitch.options import StitchOptions
from rdstitch.pipeline.recipes import mosaic
from rdstitch.progress import Progress, silent
from rdstitch.registration import Registration
from rdstitch.verification.verdict import RefusedError

_MEGAPIXELS, _FEATURES = 0.2, 500  # of the small versions
_BLURRED = 0.6  # of the median sharpness
_DARK, _BURNT = 0.06, 0.05  # mean brightness; share of burnt-out pixels
_MIN_OVERLAP = 0.3
_ZOOMED = 1.03  # ratio of focal lengths by EXIF
_GRID = 24  # points a side by which an overlap is measured


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
        Names of images that found no place among the others.
    overlap : float or None
        Median share of an image that its best partner shows too; None where nothing fits together.
    plan : CompositePlan or None
        Size of the mosaic, with memory and time of compositing it; None where there would be none.
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
    overlap: float | None
    plan: CompositePlan | None
    advice: tuple[str, ...]

    def as_dict(self) -> dict[str, Any]:
        """For JSON."""
        return asdict(self)

    def as_text(self) -> str:
        """For people, one line for each thing, advice at the end."""
        overlap = "none found" if self.overlap is None else f"about {self.overlap:.0%} with the best partner"
        effort = "no mosaic is to be expected"
        if (plan := self.plan) is not None:
            effort = "{} x {} pixels; about {} of memory and {} to composite them".format(
                *plan.canvas_size, bytes_in_words(plan.memory_bytes), seconds_in_words(plan.seconds)
            )
        lines = [
            ("images", f"{self.images}" + (f", and {len(self.unreadable)} unreadable" if self.unreadable else "")),
            ("sizes", _counted(self.sizes)),
            ("cameras", _counted(self.cameras)),
            ("focal", self.focal),
            ("sharpness", _few(self.blurred, "blurred", "nothing blurred")),
            (
                "exposure",
                f"{_few(self.dark, 'dark', 'nothing dark')}; {_few(self.burnt, 'burnt out', 'nothing burnt out')}",
            ),
            ("overlap", f"{overlap}; {_few(self.alone, 'without a place', 'every image has a place')}"),
            ("mosaic", effort),
            *(("advice", item) for item in self.advice or ["none: go ahead"]),
        ]
        return "".join(f"{name + ':':<12}{text}\n" for name, text in lines)


def _counted(items: tuple[tuple[str, int], ...]) -> str:
    return "; ".join(f"{name} ({count})" for name, count in items) or "none"


def _few(names: tuple[str, ...], what: str, none: str) -> str:
    """The first names of a list, and how many there are."""
    return f"{len(names)} {what}: {shortened(names)}" if names else none


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
    with found_images(as_inputs(inputs, channel_order), every=every, topic=topic) as found:
        sources, unread = read_sources(found.frames, skip_bad=True)
        unreadable = [f"{message.images[0]}: {message.text}" for message in unread]
        looks: dict[int, tuple[float, float, float]] = {}
        for index, source in enumerate(sources):
            try:
                looks[index] = _look(
                    source.read(max(1, round(np.sqrt(np.prod(source.camera.image_size) / (_MEGAPIXELS * 1e6)))))
                )
            except InputError as error:
                unreadable.append(str(error))
            progress("examining", index + 1, len(sources))
        if not looks:
            raise InputError(unreadable[0] if unreadable else "there is nothing to examine")
        plan, registration, problems = _dry_run(found.frames, progress) if len(looks) > 1 else (None, None, ())
    return _conclude([sources[k] for k in looks], np.array([*looks.values()]), unreadable, plan, registration, problems)


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
    except RegistrationError as error:
        return None, None, (Message(str(error)),)
    problems = told_once((*registration.failures, *registration.warnings, *registration.left_out))
    return plan, registration, tuple(problems)


def _look(image: DecodedImage) -> tuple[float, float, float]:
    """Sharpness, mean brightness from 0 to 1, and share of burnt-out pixels of an image.

    Sharpness is the contrast of the finest detail over that of twice as coarse detail; an image without detail has 0.
    """
    samples = image.pixels
    full = float(np.iinfo(samples.dtype).max) if samples.dtype.kind == "u" else float(max(samples.max(), 1e-12))
    grey = samples if samples.ndim == 2 else samples[..., : min(3, samples.shape[2])].mean(axis=2)
    grey = np.ascontiguousarray(grey, dtype=np.float32) / np.float32(full)
    seen = np.ones(grey.shape, dtype=bool) if image.alpha is None else image.alpha > 0
    if not seen.any():
        return 0.0, 0.0, 0.0
    coarse = cv2.resize(grey, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
    fine = float(np.abs(cv2.Laplacian(grey, cv2.CV_32F))[seen].mean())
    rough = float(np.abs(cv2.Laplacian(coarse, cv2.CV_32F)).mean())
    burnt = grey >= np.float32(254 / 255)
    return fine / rough if rough > 1e-6 else 0.0, float(grey[seen].mean()), float(burnt[seen].mean())


def _conclude(
    sources: Sequence[Source],
    looks: Any,
    unreadable: Sequence[str],
    plan: CompositePlan | None,
    registration: Registration | None,
    problems: Sequence[Message],
) -> Examination:
    sharpness, brightness, burnt = looks.T

    def named(chosen: Iterable[Any]) -> tuple[str, ...]:
        return tuple(source.name for source, is_one in zip(sources, chosen, strict=True) if is_one)

    alone = tuple(source.name for source in sources)
    if registration is not None:
        placed = zip(registration.sources, registration.alignment.used, strict=True)
        alone = tuple(source.name for source, is_used in placed if not is_used)
    focal, zoomed = _focal(sources)
    found = Examination(
        len(sources),
        tuple(unreadable),
        tuple(Counter("{} x {}".format(*source.metadata.size) for source in sources).most_common()),
        tuple(Counter(map(_camera, sources)).most_common()),
        focal,
        named(sharpness < _BLURRED * np.median(sharpness)),
        named(brightness < _DARK),
        named(burnt > _BURNT),
        alone,
        None if registration is None else _overlap(registration),
        plan,
        (),
    )
    return replace(found, advice=tuple(_advice(found, zoomed, problems)))


def _overlap(registration: Registration) -> float | None:
    """Median over the images of the largest share that another one shows too."""
    alignment = registration.alignment
    best = np.zeros(len(registration.sources))
    for fit in (fit for fit in alignment.links if fit.used):
        for first, second in ((fit.image1, fit.image2), (fit.image2, fit.image1)):
            own, other = alignment.cameras[first].image_size, alignment.cameras[second].image_size
            with np.errstate(invalid="ignore"):
                moved = alignment.transfer(first, second, points_over(own, _GRID))
                inside = ((moved >= -0.5) & (moved < np.array(other) - 0.5)).all(axis=1)
            best[first] = max(best[first], inside.mean())
    return float(np.median(best[best > 0])) if (best > 0).any() else None


def _camera(source: Source) -> str:
    m = source.metadata
    # Many makers begin the model with their name.
    make = "" if m.make and m.model and m.model.lower().startswith(m.make.lower().split()[0]) else m.make
    return " ".join(filter(None, (make, m.model, m.serial))) or "unknown"


def _focal(sources: Sequence[Source]) -> tuple[str, bool]:
    """What is known of the focal length, and whether the lens was zoomed."""
    pixels = [(s.metadata.focal_px, max(s.metadata.size)) for s in sources if s.metadata.focal_px is not None]
    if not pixels:
        return "not known from EXIF; it is guessed, which matters for trajectory only", False
    shares = [focal / side for focal, side in pixels]
    zoomed = max(shares) > _ZOOMED * min(shares)
    text = f"{min(pixels)[0]:.0f}" + (f" to {max(pixels)[0]:.0f}" if zoomed else "")
    return f"{text} pixels by EXIF in {len(pixels)} of {len(sources)} images", zoomed


def _advice(found: Examination, zoomed: bool, problems: Sequence[Message]) -> list[str]:
    """What to change, most important first."""
    advice = []
    if found.images < 2:
        advice.append("stitching needs two images or more; name another one")
    if len(found.cameras) > 1:
        advice.append(f"the images come from {len(found.cameras)} cameras: stitch those of each on their own")
    if zoomed:
        advice.append("the lens was zoomed between the images: stitch those of one zoom on their own")
    if found.unreadable:
        several = "s" * (len(found.unreadable) != 1)
        advice.append(f"{len(found.unreadable)} file{several} cannot be read: {found.unreadable[0]}")
    advice += map(str, problems)
    if found.overlap is not None and found.overlap < _MIN_OVERLAP:
        advice.append(f"images overlap by about {found.overlap:.0%} only: take more images, a third is the least")
    if found.blurred:
        advice.append(f"leave blurred images out if their neighbours overlap without them: {shortened(found.blurred)}")
    if found.dark or found.burnt:
        advice.append("dark or burnt-out images have few features: fix the exposure if you can take them again")
    return advice
