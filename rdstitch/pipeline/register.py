"""The registration that pano, mosaic, calibrate and trajectory share: features, pairs, one alignment."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from rdstitch.errors import ArgumentError, InputError, RegistrationError
from rdstitch.features import Features, detect_all
from rdstitch.io.read import Pixels, read_image
from rdstitch.pipeline.options import StitchOptions
from rdstitch.pipeline.sources import LeftOut, Source
from rdstitch.registration import Alignment, AlignmentOptions, align
from rdstitch.registration.pairs import PairOptions, PairRegistration, estimate_pairs, match_pairs

Progress = Callable[[str, int, int], None]
"""Called with the name of a stage, the number of steps done, and their total."""


@dataclass(frozen=True)
class Registration:
    """Pictures registered as one.

    Attributes
    ----------
    sources : tuple of Source
    keypoints : tuple of int
        Number of features of each picture.
    pairs : tuple of PairRegistration
        Every pair that was looked at.
    alignment : Alignment
    left_out : tuple of LeftOut
        Every file that is not in the result, with the reason.
    """

    sources: tuple[Source, ...]
    keypoints: tuple[int, ...]
    pairs: tuple[PairRegistration, ...]
    alignment: Alignment
    left_out: tuple[LeftOut, ...]


def silent(stage: str, done: int, total: int) -> None:
    """A progress that nobody watches."""


def register(
    sources: Sequence[Source],
    pairs: Sequence[tuple[int, int]],
    options: StitchOptions,
    *,
    skip_bad: bool,
    progress: Progress = silent,
) -> Registration:
    """Detect, match, estimate every pair, and align all pictures as one.

    Parameters
    ----------
    sources : sequence of Source
    pairs : sequence of (int, int)
        Pairs of pictures to try.
    options : StitchOptions
    skip_bad : bool
        Leave out damaged pictures instead of raising.
    progress : callable

    Raises
    ------
    RegistrationError
        When no two pictures overlap.
    """
    reference = _reference(sources, options.reference)
    features, damaged = _detect(sources, options, skip_bad, progress)
    matched = match_pairs(features, pairs, options.ratio, partial(progress, "matching"))
    known = options.known_distortion
    registered = estimate_pairs(
        [source.camera for source in sources],
        pairs,
        matched,
        PairOptions(
            options.ratio,
            options.solver,
            known,
            options.threshold,
            options.confidence,
            options.max_iterations,
            options.seed,
        ),
        tilts=None if options.tilt is None else [options.tilt] * len(sources),
        workers=options.threads,
        progress=partial(progress, "registering pairs"),
    )
    links = [pair.link() for pair in registered if pair.relation]
    if not links:
        raise RegistrationError(_no_overlap(sources, registered))
    alignment = align(
        [source.camera.with_focal() for source in sources],
        links,
        AlignmentOptions(reference=reference, model=options.model, distortion=known, tilt=options.tilt),
    )
    left_out = [
        LeftOut(source.path, damaged.get(index, alignment.reasons[index]))
        for index, source in enumerate(sources)
        if not alignment.used[index]
    ]
    return Registration(
        tuple(sources), tuple(len(found) for found in features), tuple(registered), alignment, tuple(left_out)
    )


def _reference(sources: Sequence[Source], name: str | None) -> int | None:
    if name is None:
        return None
    for index, source in enumerate(sources):
        if name in (source.name, str(source.path)):
            return index
    raise ArgumentError(f"the reference picture {name!r} is not among the input pictures")


def _detect(
    sources: Sequence[Source], options: StitchOptions, skip_bad: bool, progress: Progress
) -> tuple[list[Features], dict[int, str]]:
    """Features of every picture, and which pictures turned out to be damaged; these have no features."""
    damaged: dict[int, str] = {}

    def load(index: int) -> tuple[Pixels, Pixels | None]:
        try:
            picture = read_image(sources[index].path)
        except InputError as error:
            if not skip_bad:
                raise
            damaged[index] = str(error)
            return np.zeros((1, 1), dtype=np.uint8), None
        return picture.pixels, picture.alpha

    loaders = [partial(load, index) for index in range(len(sources))]
    features = detect_all(loaders, options.features, options.threads, partial(progress, "detecting features"))
    return features, damaged


def _no_overlap(sources: Sequence[Source], registered: Sequence[PairRegistration]) -> str:
    """Why nothing came of any pair, told by the pair with the most matches."""
    best = max(registered, key=lambda pair: len(pair.correspondences))
    names = f"{sources[best.image1].name} and {sources[best.image2].name}"
    return f"no two pictures overlap: of the likeliest pair, {names}, {best.relation.reason}"
