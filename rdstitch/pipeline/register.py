"""The registration that pano, mosaic, calibrate and trajectory share: features, pairs, one alignment."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from rdstitch.alignment import Alignment, AlignmentOptions, Link, align
from rdstitch.alignment.result import LinkFit, Poses, Relief
from rdstitch.cache import Cache
from rdstitch.camera import Camera
from rdstitch.errors import ArgumentError, InputError, RegistrationError
from rdstitch.features import Features, LightGlue, Matcher, View, detect_all, match
from rdstitch.inputs.source import LeftOut, Source
from rdstitch.matching.candidate_pairs import first_pairs, neighbours
from rdstitch.matching.lens_votes import Votes
from rdstitch.matching.mixed_lenses import pictures_of_the_other, two_lenses
from rdstitch.matching.two_view import PairRegistration
from rdstitch.matching.two_view_rounds import Pairing
from rdstitch.options import StitchOptions
from rdstitch.progress import Progress, silent
from rdstitch.registration import Registration

_CLOSURE_ROUNDS = 2
_STATIC_BACKGROUND_WARNING = (
    "most of what the pictures show stays where it is in them (a background, dirt, a date); "
    "only what moves was registered"
)


def register(
    sources: Sequence[Source],
    options: StitchOptions,
    *,
    skip_bad: bool,
    metric: bool = False,
    progress: Progress = silent,
) -> Registration:
    """Detect features, register pairs, and align all pictures as one.

    Pairs that fail alone are tried again with the λ that the others agree on, which then takes only two or four points.
    Once there are poses, pictures that these put beside each other are tried too (loop closures), and every pair of a
    picture that found no place. Where the pictures come from two lenses, those of one are aligned.

    Parameters
    ----------
    sources : sequence of Source
    options : StitchOptions
    skip_bad : bool
        Leave out damaged pictures instead of raising.
    metric : bool
        Metric poses are needed, so that the freest model is that of planar motion with small tilts.
    progress : callable

    Raises
    ------
    RegistrationError
        When no two pictures overlap.
    """
    reference = _reference(sources, options.reference)
    matcher = _matcher(options)
    cache = Cache(options.cache)
    features, damaged = _detect(sources, options, cache, skip_bad, progress)
    aligning = _alignment_options(sources, options, reference)
    tilts = aligning.exact_tilts(len(sources))
    cameras = [source.camera.with_focal() for source in sources]
    pairing = Pairing(
        features, [source.camera for source in sources], matcher, options.matching, progress, cache, tilts
    )
    candidates = first_pairs(features, options.seed)
    prescreened = pairing.prescreen_pairs(candidates)
    pairs = pairing.estimate(prescreened, shared=prescreened)
    if not any(pair.relation for pair in pairs):
        pairs = pairing.estimate(candidates)
    pairing, pairs = pairing.remove_static_background(pairs)
    mixed = None if options.known_distortion is not None else two_lenses(cameras, Votes.of(pairs, options.threshold))
    other_lens_images = {} if mixed is None else pictures_of_the_other(mixed, pairs)
    if other_lens_images:
        pairs = [pair for pair in pairs if not {pair.image1, pair.image2} & other_lens_images.keys()]
        candidates = [pair for pair in candidates if not {*pair} & other_lens_images.keys()]
    pairs = pairing.retry_with_consensus_distortion(pairs)
    alignment = _align(cache, cameras, _links(sources, pairs), aligning)
    for _ in range(_CLOSURE_ROUNDS):
        tried = {(pair.image1, pair.image2) for pair in pairs}
        beside = neighbours(alignment.cameras, alignment.homographies, tried)
        unaligned_pairs = {(i, j) for i, j in candidates if not (alignment.used[i] and alignment.used[j])} - tried
        closures = pairing.estimate(sorted(unaligned_pairs.union(beside)), distortion=alignment.distortion)
        pairs = sorted([*pairs, *closures], key=lambda pair: (pair.image1, pair.image2))
        if not any(pair.relation for pair in closures):
            break
        alignment = _align(cache, cameras, _links(sources, pairs), aligning)
    stronger = pairing.guided_rematch(pairs, alignment.support, alignment.transfer)
    if any(new is not old for new, old in zip(stronger, pairs, strict=True)):
        pairs, alignment = stronger, _align(cache, cameras, _links(sources, stronger), aligning)
    if metric and alignment.poses is None and options.model == "auto":
        alignment = _align(cache, cameras, _links(sources, pairs), replace(aligning, model="tilting"))
    resting = pairing.features is not features
    if resting:
        alignment = replace(alignment, warnings=(*alignment.warnings, _STATIC_BACKGROUND_WARNING))
    left_out = [
        LeftOut(source.path, damaged.get(index, other_lens_images.get(index, alignment.reasons[index])))
        for index, source in enumerate(sources)
        if not alignment.used[index]
    ]
    keypoints = tuple(map(len, features))
    return Registration(tuple(sources), keypoints, tuple(pairs), alignment, tuple(left_out), resting, mixed)


def in_frame_of_reference(registration: Registration) -> Registration:
    """The same registration with the undistorted reference picture as its plane."""
    alignment = registration.alignment
    homographies = np.linalg.inv(alignment.homographies[alignment.reference]) @ alignment.homographies
    return replace(registration, alignment=replace(alignment, homographies=homographies))


def _links(sources: Sequence[Source], pairs: Sequence[PairRegistration]) -> list[Link]:
    """The pairs that were registered, at least one."""
    links = [pair.link() for pair in pairs if pair.relation]
    if not links:
        raise RegistrationError(_no_overlap(sources, pairs))
    return links


def _reference(sources: Sequence[Source], name: str | None) -> int | None:
    if name is None:
        return None
    for index, source in enumerate(sources):
        if name in (source.name, str(source.path)):
            return index
    raise ArgumentError(f"the reference picture {name!r} is not among the input pictures")


def _alignment_options(sources: Sequence[Source], options: StitchOptions, reference: int | None) -> AlignmentOptions:
    """What is decided or known beforehand; measured attitudes that are not exact leave the mount's tilt open."""
    attitudes = [source.attitude for source in sources if source.attitude is not None]
    exact = bool(attitudes) and options.attitude_std == 0.0
    return AlignmentOptions(
        reference=reference,
        model=options.model,
        distortion=options.known_distortion,
        tilt=options.tilt or ((0.0, 0.0) if exact else None),
        attitudes=np.array(attitudes) if attitudes else None,
        attitudes_std=options.attitude_std,
    )


def _align(cache: Cache, cameras: Sequence[Camera], links: Sequence[Link], options: AlignmentOptions) -> Alignment:
    """The alignment, from an earlier run where the cache has it."""
    inputs = (tuple(cameras), cache.digest(tuple(links)), options)
    return cache.recall(
        "alignment", (Alignment, Camera, LinkFit, Poses, Relief), inputs, partial(align, cameras, links, options)
    )


def _detect(
    sources: Sequence[Source], options: StitchOptions, cache: Cache, skip_bad: bool, progress: Progress
) -> tuple[list[Features], dict[int, str]]:
    """Features of every picture, and which pictures turned out to be damaged; these have no features."""
    damaged: dict[int, str] = {}

    def load(index: int, megapixels: float | None) -> View:
        source = sources[index]
        reduction = source.reduction(megapixels)
        try:
            picture = source.read(reduction, keep=True)
        except InputError as error:
            if not skip_bad:
                raise
            damaged[index] = str(error)
            return View(np.zeros((1, 1), dtype=np.uint8), image_size=source.camera.image_size)
        return View(picture.pixels, picture.alpha, reduction, source.camera.image_size)

    network = cache.file(options.features.aliked_model)
    wanted = replace(options.features, aliked_model=None) if network else options.features

    def recall(index: int, compute: Callable[[], Features]) -> Features:
        source = sources[index]
        inputs = (cache.file(source.path), cache.file(source.mask), source.camera.image_size, wanted, network)
        # A damaged picture has no features, but that must be said again the next time.
        return cache.recall("features", (Features,), inputs, compute, unless=lambda: index in damaged)

    loaders = [partial(load, index) for index in range(len(sources))]
    progress_of = partial(progress, "detecting features")
    features = detect_all(loaders, options.features, options.threads, progress_of, recall)
    return features, damaged


def _matcher(options: StitchOptions) -> Matcher:
    """What matches features: the user's network, or distances."""
    if options.lightglue_model is not None:
        return LightGlue(options.lightglue_model).match
    return partial(match, ratio=options.ratio)


def _no_overlap(sources: Sequence[Source], registered: Sequence[PairRegistration]) -> str:
    """Why nothing came of any pair, told by the pair with the most matches."""
    if not registered:
        return "no two pictures could be compared"
    best = max(registered, key=lambda pair: len(pair.correspondences))
    names = f"{sources[best.image1].name} and {sources[best.image2].name}"
    return (
        f"no two pictures overlap: of the likeliest pair, {names}, {best.relation.reason}; "
        "take pictures that overlap by a third or more"
    )
