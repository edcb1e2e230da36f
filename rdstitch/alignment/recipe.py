"""The recipe of the global adjustment: consensus, match graph, choice of the model, adjustment."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from rdstitch.alignment.adjustment_problem import Fit, Problem
from rdstitch.alignment.alignment_options import FEWEST_MATCHES, AlignmentOptions, GivenImages
from rdstitch.alignment.build_result import AdjustedImages, build_alignment
from rdstitch.alignment.cycle_consistency import cycle_consistency, misfitting_links
from rdstitch.alignment.given_checks import check_attitudes, check_focal, is_strained
from rdstitch.alignment.known_model import KnownModel
from rdstitch.alignment.least_squares.bundle_adjustment import FEW_GAIN, MIN_GAIN
from rdstitch.alignment.least_squares.observations import Observations
from rdstitch.alignment.lens.lens_selection import with_third_coefficient
from rdstitch.alignment.lens.observability import choose_observable_lens
from rdstitch.alignment.map_priors import adjust_to_map
from rdstitch.alignment.noise import independent_errors
from rdstitch.alignment.relief_weights import adjust_over_relief, choose_over_relief
from rdstitch.alignment.result import Alignment
from rdstitch.alignment.select import ModelChoice, select_model
from rdstitch.alignment.sentences import REFERENCE_LEFT_OUT
from rdstitch.alignment.starts import fit_model
from rdstitch.alignment.uncertainty import covariances, weigh_lens
from rdstitch.arrays import BoolArray, IntArray
from rdstitch.errors import ArgumentError, ImpossibleCameraError, RegistrationError
from rdstitch.geometry.camera import Camera
from rdstitch.geometry.radial_homography import RadialHomography
from rdstitch.matching.links import Link, in_alternate_directions
from rdstitch.results.messages import Message
from rdstitch.robust.chance import occupied_cells

_REDUCED = 0.8  # side over that of the largest image, below which one was reduced and must not set the output's scale
_MATCHES_OF_A_TURN = 5000  # correspondences of all links that the final adjustment of a pure rotation uses at least
_MATCHES_OF_ALL = 500_000  # correspondences of all links together that are enough
_MATCHES_OF_A_LINK = 40  # correspondences of a link that are used nevertheless
_MATCHES_FOR_SELECTION = 5_000  # correspondences of all links together that a model is chosen by
# Half diagonals. Matches at random leave 0.2 (eight of them) to 0.8, whichever model is adjusted to them (72 times).
_MAX_RMS = 0.1

_ROUNDS = 3  # rounds of rejecting wrong pairs and adjusting again


def align(cameras: Sequence[Camera], links: Sequence[Link], options: AlignmentOptions | None = None) -> Alignment:
    """Align all images of one lens over one plane, or around one centre, by pairs that overlap, each once.

    Links of matches in fewer than five places, which show nothing, are left out.

    :exc:`ArgumentError` where two links are between the same images; :exc:`RegistrationError` where no two are linked,
    or no motion explains the matches.
    """
    enough = [link for link in links if occupied_cells(link.points1, link.points2, *link.sizes) >= FEWEST_MATCHES]
    return AlignmentTask(cameras, enough, options or AlignmentOptions()).result


@dataclass(frozen=True, eq=False)
class AlignmentTask(GivenImages):
    """Alignment of some images: a draft, and the result, each computed when it is wanted."""

    known: KnownModel | None = None  # of these images by fewer links, which the others agree with

    @cached_property
    def draft(self) -> Alignment:
        """Model, lens and poses by a few matches of each link; deviations are those of the normal equations."""
        return build_alignment(replace(self._selected))  # what is computed for it alone is not kept

    @cached_property
    def result(self) -> Alignment:
        """Adjusted to all matches."""
        result = _with_checked_focal(_adjusted(self._selected), self.options)
        if not result.rms <= _MAX_RMS * np.median([camera.scale for camera in self.cameras]):
            raise RegistrationError("no motion explains the matches; add images with more overlap")
        return result

    @property
    def draft_model(self) -> KnownModel | None:
        """The model of the draft, for one by more links to start from, if it can."""
        return KnownModel.of(self._selected)

    @cached_property
    def _selected(self) -> AdjustedImages:
        _check(self)
        return _lens_and_model(self, self.known)


def _with_reference(all_links: Problem, cameras: Sequence[Camera], wrong: BoolArray) -> Problem:
    """The problem with the reference that was asked for, or that of a part of it without the links that are wrong.

    Where that is a reduced image, the one of full size whose links can be relied on most.
    """
    if all_links.fixed is not None:
        return all_links
    problem, images = all_links.part(~wrong)
    size = np.sqrt([float(np.prod(cameras[k].image_size)) for k in images])
    full, reference = np.flatnonzero(size > _REDUCED * size.max()), problem.reference
    if reference not in full:
        ends = problem.observations.image1, problem.observations.image2
        trust = sum(np.bincount(of, problem.trust, len(size)) for of in ends)
        reference = int(full[np.argmax(np.asarray(trust)[full])])
    return replace(all_links, fixed=int(images[reference]))


def _lens_and_model(given: GivenImages, known: KnownModel | None = None) -> AdjustedImages:
    """The lens, the wrong pairs and the model, unless it is known, by as many matches of each link as show them."""
    priors = given.options.camera_priors(given.cameras)
    all_matches, relations = _observations(
        given.links, given.cameras, _matches_of_a_link(len(given.links), given.options)
    )
    sample = all_matches.thinned(int(np.clip(_MATCHES_FOR_SELECTION // len(given.links), 40, 150)))
    lens = choose_observable_lens(given, sample, relations, priors)
    distortion = float(lens.pairwise.parameters.lens[0])
    priors = priors.with_lens(distortion)
    wrong, confirmed = cycle_consistency(lens.pairwise, sample, len(given.cameras))
    # A tree of the links with a consistent triangle first, by their matches. Where all have as many, one of the first
    # links might pass over neighbours, and join them a whole path away: the area of the matches decides.
    ranks = np.argsort(np.lexsort((sample.areas, sample.matches, confirmed > 0))).astype(np.float64)
    homographies, start, count = lens.pairwise.homographies, lens.pairwise.parameters.lens, len(given.cameras)
    reference = given.options.reference
    reference = known.reference if reference is None and known is not None else reference
    all_links = Problem(
        sample, homographies, start, lens.free, priors, trust=ranks, count=count, fixed=reference, min_gain=FEW_GAIN
    )
    all_links = _with_reference(all_links, given.cameras, wrong)
    connected, images = all_links.part(~wrong)
    # Data weigh against priors as they will in the final adjustment.
    shared, _ = independent_errors(connected.observations, connected.homographies, connected.lens)
    all_links, connected = (replace(one, overdispersion=shared) for one in (all_links, connected))
    options, messages = check_attitudes(connected, given.options)
    if messages:
        all_links = replace(all_links, camera_priors=options.camera_priors(given.cameras).with_lens(distortion))
        connected, _ = all_links.part(~wrong)
    choice = None if known is None else known.choice(connected, images)
    choice = choice or select_model(connected, options.models, lens.refinements, options.purpose)
    aligned, choice, images, wrong = _drop_wrong_pairs(all_links, connected, images, choice, wrong)
    choice = choose_over_relief(aligned, choice, options.models, options.purpose)
    if options.reference is not None and options.reference not in images:
        messages.append(REFERENCE_LEFT_OUT)
    free = choice.fit.free_lens
    return AdjustedImages(
        replace(given, options=options),
        images,
        ~wrong,
        replace(all_links, observations=all_matches, free_lens=free, min_gain=MIN_GAIN),
        replace(aligned, free_lens=free),
        replace(choice, fit=choice.fit.bare),
        replace(lens.refined(free), pairwise=lens.pairwise.bare),
        messages=tuple(messages),
    )


def _adjusted(chosen: AdjustedImages) -> AdjustedImages:
    """Adjusted to all matches."""
    choice, options, links = chosen.choice, chosen.given.options, chosen.given.links
    all_links = chosen.all_links
    if choice.fit.model.on_sphere and most_matches_read(len(links), options) is None:
        # Few images of a turn hardly determine the focal length; all their matches are used.
        every, _ = _observations(links, chosen.given.cameras, _MATCHES_OF_A_TURN // len(links))
        all_links = replace(all_links, observations=every)
    problem = replace(chosen.problem, min_gain=all_links.min_gain)
    if all_links.observations.most > problem.observations.most:  # matches that were not looked at yet
        problem, _ = all_links.part(chosen.kept_links, chosen.images)
    # What errors share weighs the more, the more of them there are.
    shared, _ = independent_errors(problem.observations, problem.homographies, problem.lens)
    problem = replace(problem, overdispersion=max(shared, choice.fit.overdispersion))
    problem, fit = adjust_over_relief(problem, choice)
    fit = from_another_start(problem, fit)
    if options.lens == "auto":
        problem, fit = with_third_coefficient(problem, fit)
    on_map = adjust_to_map(problem, fit)
    problem, fit = on_map.problem, on_map.fit
    covariance, of_lens = covariances(problem, fit)
    fit = weigh_lens(problem, fit, covariance) if chosen.lens.observable else fit
    return replace(
        chosen,
        problem=problem,
        choice=replace(choice, fit=fit),
        lens=chosen.lens.refined(problem.free_lens),
        messages=(*filter(None, [on_map.disagreement]), *chosen.messages),
        leverage={
            key if isinstance(key, str) else int(chosen.images[key]): one for key, one in on_map.leverage.items()
        },
        covariance=covariance,
        lens_covariance=of_lens,
    )


def from_another_start(problem: Problem, fit: Fit) -> Fit:
    """A fit that converged as it is; another one from where the links lead, where that converges or fits better."""
    if fit.result.converged:
        return fit
    return min((fit, fit_model(problem, fit.model)), key=lambda one: (not one.result.converged, one.result.sigma))


def _with_checked_focal(adjusted: AdjustedImages, stated: AlignmentOptions) -> Alignment:
    """The alignment; without a given focal length that gave way where the images by themselves show another one."""
    if adjusted.covariance is None or not is_strained(adjusted.all_links.camera_priors, adjusted.choice.fit):
        return build_alignment(adjusted)
    given = adjusted.given
    cameras = [camera.without_focal().with_guessed_focal() for camera in given.cameras]
    # A tilt that was given as wrong as the focal length would speak for it, and against a right one.
    only_tilt = given.options.attitudes is None and given.options.tilt is not None
    options = replace(given.options, tilt=None) if only_tilt else given.options

    def by_themselves(options: AlignmentOptions) -> tuple[AdjustedImages, Message | None]:
        free = _adjusted(_lens_and_model(replace(given, cameras=cameras, options=options)))
        return free, check_focal(given.cameras[free.images[0]], free.choice.fit, free.covariance)

    try:
        free, contradiction = by_themselves(options)
        # What seemed to be wrong may have been so with the wrong focal length only.
        if contradiction is not None and options is not stated:
            free, contradiction = by_themselves(stated)
        if contradiction is not None:
            return build_alignment(replace(free, messages=(*free.messages, contradiction)))
    except (RegistrationError, ImpossibleCameraError, np.linalg.LinAlgError):
        pass  # by themselves the images determine nothing
    return build_alignment(adjusted)


def most_matches_read(links: int, options: AlignmentOptions) -> int | None:
    """Correspondences of each of so many links that :func:`align` reads at the most; None for all of them."""
    return None if links * options.max_matches_per_link < _MATCHES_OF_A_TURN else _matches_of_a_link(links, options)


def _matches_of_a_link(links: int, options: AlignmentOptions) -> int:
    """Thousands of links determine lens and poses many times over: memory and time are to grow with the links alone."""
    return min(options.max_matches_per_link, max(_MATCHES_OF_ALL // max(links, 1), _MATCHES_OF_A_LINK))


def _observations(
    links: Sequence[Link], cameras: Sequence[Camera], max_matches: int
) -> tuple[Observations, list[RadialHomography]]:
    """At most so many correspondences of each link, chosen before any is turned round; and how each maps them."""
    read = in_alternate_directions([link.thinned(max_matches) for link in links])
    return Observations.from_links(read, cameras), [link.relation for link in read]


def _check(given: GivenImages) -> None:
    cameras, links, options = given.cameras, given.links, given.options
    if not links:
        raise RegistrationError("nothing to align: no two images overlap")
    pairs = [(min(k.image1, k.image2), max(k.image1, k.image2)) for k in links]
    if min(pairs)[0] < 0 or max(high for _, high in pairs) >= len(cameras):
        raise ArgumentError(f"a link names an image outside of the {len(cameras)}")
    if len(set(pairs)) != len(pairs):
        raise ArgumentError("two links are between the same images")
    if options.reference is not None and not 0 <= options.reference < len(cameras):
        raise ArgumentError(f"the reference image {options.reference} is not among the {len(cameras)}")
    if options.lens_known and len({camera.coefficients for camera in cameras}) > 1:
        raise ArgumentError("the images have lenses that differ: those of one lens are aligned at a time")


def _drop_wrong_pairs(
    all_links: Problem, problem: Problem, images: IntArray, choice: ModelChoice, wrong: BoolArray
) -> tuple[Problem, ModelChoice, IntArray, BoolArray]:
    """Test all links against the adjusted poses, and adjust the problem again without those that do not fit."""
    as_given, all_links = all_links.free_lens, replace(all_links, free_lens=choice.fit.free_lens)
    o = all_links.observations
    for _ in range(_ROUNDS):
        adjusted, model = choice.fit.result, choice.fit.model
        between_images, _ = all_links.part(np.ones_like(wrong), images)
        inside = np.isin(o.image1, images) & np.isin(o.image2, images)
        squared = between_images.adjuster(model).squared(adjusted.parameters)
        judged = wrong.copy()
        judged[inside] = misfitting_links(squared, between_images.observations)
        if judged[inside].all():
            raise RegistrationError("the pairs do not agree on where the images lie; add images with more overlap")
        if (judged == wrong).all():
            break
        wrong = judged
        problem, kept = all_links.part(~wrong)
        if np.isin(kept, images).all():
            poses = adjusted.parameters.poses[np.searchsorted(images, kept)]
            fit = problem.refine(model, replace(adjusted.parameters, poses=poses), choice.fit.tilt_spread)
        else:
            fit = fit_model(problem, model)
        choice, images = replace(choice, fit=fit), kept
    return replace(problem, free_lens=as_given), choice, images, wrong
