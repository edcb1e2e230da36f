"""The registration that pano, mosaic, calibrate and trajectory share: features, pairs, one alignment."""

from collections.abc import Sequence
from concurrent.futures import Executor, ThreadPoolExecutor
from dataclasses import replace
from functools import partial
from importlib import import_module

from rdstitch.alignment import Alignment
from rdstitch.alignment.sentences import explain_unaligned
from rdstitch.features import LightGlue, match
from rdstitch.inputs.positions import positions_of
from rdstitch.inputs.source import Source
from rdstitch.matching.candidate_pairs import estimate_candidates, first_pairs
from rdstitch.matching.mixed_lenses import separate_lenses
from rdstitch.matching.pair_estimator import FeatureMatching, PairEstimator
from rdstitch.matching.repeated_pattern import match_repeated_patterns
from rdstitch.matching.static_background import without_static_background
from rdstitch.options.stitch_options import StitchOptions
from rdstitch.pipeline.registration.aligner import Aligner, impossible_estimates_fail
from rdstitch.pipeline.registration.detect_features import detect_by_contrast
from rdstitch.pipeline.registration.image_circle import with_image_circle
from rdstitch.pipeline.registration.redraft import draft_with_loops
from rdstitch.pipeline.registration.repeated_patterns import match_crossings, settle_repeated_pattern
from rdstitch.pipeline.registration.working_size import at_working_size
from rdstitch.pipeline.run import Run
from rdstitch.results.messages import Message, names_of, shortened
from rdstitch.results.registration import Registration
from rdstitch.system.cache import Cache
from rdstitch.system.process_memory import return_freed_memory

_STATIC_BACKGROUND = Message(
    "a part of what the images show stays where it is in them (a vehicle's body, a background, dirt, a date); "
    "only what moves was registered",
    code="static-background",
)


@impossible_estimates_fail()
def register(sources: Sequence[Source], run: Run, executor: Executor) -> Registration:
    """Detect features, register pairs, and align all images, of two lenses those of one, in pixels of the working size.

    Once there are poses, images that these put beside each other are tried too (loop closures), and every pair of an
    image that found no place.
    """
    options, purpose, progress = run.options.for_images(len(sources)), run.purpose, run.progress
    cache = Cache.at(run.cache)
    if options.known_distortion is None:
        sources = with_image_circle(sources, executor, cache, run.guard, options.features.limits[1])
    aligner = Aligner.of(sources, options, cache, purpose)
    store = cache if run.cache is not None else Cache.for_this_run()
    matching = _matching(options)  # a network that cannot be read is told before the work
    with ThreadPoolExecutor(1) as thread:
        thread.submit(import_module, "scipy.sparse.csgraph")  # 0.15 s, which alignments would wait for
        detected = detect_by_contrast(sources, options.features, run, executor, store)
    cameras = [at_working_size(source.camera, options.features.limits[1]) for source in sources]
    features = detected.features.at_sizes([camera.image_size for camera in cameras])
    candidates = first_pairs(features, options.seed, positions_of(sources))
    return_freed_memory()
    known, tilts = options.estimation, aligner.exact_tilts
    estimator = PairEstimator(
        features, cameras, matching, known, progress, executor, cache=cache, store=store, tilts=tilts
    )
    pairs = estimate_candidates(estimator, candidates)
    moving = without_static_background(estimator, pairs, candidates)
    estimator, pairs = moving or (estimator, pairs)
    pairs = match_repeated_patterns(estimator, pairs) if purpose.lens_only else pairs
    threshold, distortion = options.threshold, options.known_distortion
    mixed, other_lens = separate_lenses(aligner.cameras, pairs, threshold, distortion, executor)
    progress("aligning", 0, 1)
    pairs = [pair for pair in pairs if not {*pair.images} & other_lens.keys()]
    candidates = [pair for pair in candidates if not {*pair} & other_lens.keys()]
    draft = draft_with_loops(aligner, estimator, pairs, candidates)
    if purpose.poses:
        aligner = replace(aligner, needs_poses=True)
        draft = aligner.metric(draft)
    progress("aligning", 0, 1)
    aligned = aligner.completed(draft)
    settle = match_crossings if purpose.lens_only else settle_repeated_pattern
    aligned, undecided = settle(aligner, estimator, aligned, sources, detected.stretch, options.threads)
    unplaced = {**other_lens, **detected.unreadable, **undecided}
    alignment, keypoints = aligned.alignment, tuple(features.counts.tolist())
    messages = [
        *alignment.messages,
        *([_STATIC_BACKGROUND] if moving else []),
        *_low_contrast(detected.equalized, alignment, aligner.paths),
        *explain_unaligned(alignment, aligner.paths, keypoints, unplaced),
    ]
    return Registration(
        tuple(sources),
        keypoints,
        tuple(aligner.used(aligned)),
        alignment,
        tuple(messages),
        static_background=moving is not None,
        stretch=detected.stretch,
        mixed=mixed,
    )


def _matching(options: StitchOptions) -> FeatureMatching:
    """Matching by the user's network, or by distances of descriptors."""
    network = options.lightglue_model
    matcher = partial(match, ratio=options.ratio) if network is None else LightGlue(network).match
    return FeatureMatching(matcher, options.ratio, network)


def _low_contrast(equalized: Sequence[int], alignment: Alignment, paths: Sequence[str]) -> list[Message]:
    """A message on the aligned images whose local contrast was equalized."""
    everywhere = len(equalized) == len(paths)
    images = () if everywhere else tuple(paths[k] for k in equalized if alignment.used[k])
    if not (everywhere or images):
        return []
    several = f"{len(images)} of the images ({shortened(names_of(images))})" if images else "the images"
    who = "shows" if len(images) == 1 else f"{several} show"
    text = f"{who} little contrast: features were found after equalizing it locally"
    return [Message(text, images, "detail", code="low-contrast")]
