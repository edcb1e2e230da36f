"""From the adjusted parameters to the :class:`Alignment`: frames, poses, uncertainties, and what was left out."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Self

import numpy as np

from rdstitch.alignment.adjustment_problem import Problem
from rdstitch.alignment.alignment_options import GivenImages
from rdstitch.alignment.frames.level_frame import levelled
from rdstitch.alignment.least_squares.bundle_adjustment import BundleAdjuster, FreeParameters
from rdstitch.alignment.least_squares.link_equations import squared_lengths, whitened_errors
from rdstitch.alignment.least_squares.observations import Observations
from rdstitch.alignment.least_squares.priors import Priors
from rdstitch.alignment.lens.lens_description import radius_std
from rdstitch.alignment.lens.lens_selection import CENTER, ENOUGH_IMAGES, LensChoice
from rdstitch.alignment.motion_models import LOG_HEIGHT, PSI, THETA, YAW, X, Y
from rdstitch.alignment.noise import coherence
from rdstitch.alignment.result import Alignment, LinkFit, PlanarPoses, ReliefTest, Unused
from rdstitch.alignment.select import ModelChoice
from rdstitch.alignment.sentences import (
    few_images,
    focal_overruled,
    lens_not_observable,
    not_converged,
    relief_test,
)
from rdstitch.alignment.uncertainty import considered_covariance, lever_std, pose_covariances
from rdstitch.arrays import BoolArray, FloatArray, IntArray
from rdstitch.errors import ImpossibleCameraError
from rdstitch.geometry.camera import LENS_PARAMETERS, Camera
from rdstitch.geometry.division_model import nearest_one_parameter
from rdstitch.geometry.planar_motion import rigid_in_plane
from rdstitch.geometry.radial_homography import inverses
from rdstitch.matching.match_graph import connected_components
from rdstitch.results.messages import Message
from rdstitch.robust.loss import ALIGNMENT_WIDTH
from rdstitch.robust.posterior import MODEL_ERROR, exact

_STEP = 1e-5  # of differences of λ, μ and ν
_RADII = np.linspace(0.05, 1.0, 20)  # half diagonals: where the lens is looked at, out to the corner
_OVERRULED = 1.5  # ratio from which on EXIF was wrong, not rounded or of another focus
_WORTH_SAYING = 1.0  # pixels that the corners of too few images may lie elsewhere, from which on that is said
_CONFIDENT = 2.0  # standard deviations within which the lens is taken to be known: 95 %


@dataclass(frozen=True, eq=False)
class AdjustedImages:
    """What the adjustment found, and what it was made from."""

    given: GivenImages
    images: IntArray  # (N,): the images aligned, ascending; the problem numbers them 0 … N-1
    kept_links: BoolArray  # (L,): links not taken for wrong
    all_links: Problem  # of all links and images, with the matches that they are adjusted by in the end
    problem: Problem  # of those aligned, with the matches that they were adjusted by
    choice: ModelChoice
    lens: LensChoice  # the lens, with the distortion centre if the motion model freed it
    positions_disagree: str = ""  # why the positions were not used; empty where they were, or where there are none
    leverage: Mapping[int | str, float] = field(default_factory=dict)  # see Alignment
    messages: tuple[Message, ...] = ()  # on what was given
    # covariance, lens_covariance: of what was estimated, and of all parameters of a lens; none of a draft
    covariance: FloatArray | None = None
    lens_covariance: FloatArray | None = None


def build_alignment(adjustment: AdjustedImages) -> Alignment:
    """The alignment, in the frame of the reference image.

    A draft, which has no covariances, has the deviations of the normal equations.
    """
    problem, fit, given = adjustment.problem, adjustment.choice.fit, adjustment.given
    agreement = _Agreement.of(adjustment)
    uncertainty = _Uncertainty.of(adjustment, over_relief=agreement.relief.found)
    cameras = _adjusted_cameras(adjustment, uncertainty)
    reference = int(adjustment.images[problem.reference])
    used = np.zeros(len(given.cameras), dtype=np.bool_)
    used[adjustment.images] = True
    homographies, poses = _in_frame_of_reference(adjustment)
    has_lever = agreement.relief.found and fit.model.has_metric_poses and adjustment.covariance is not None
    alignment = Alignment(
        cameras=cameras,
        homographies=homographies,
        used=used,
        components=_groups(adjustment),
        reference=reference,
        model=fit.model.name,
        model_reason=adjustment.choice.reason,
        poses=poses,
        tilt_spread=fit.tilt_spread or 0.0,
        lens=adjustment.lens.name,
        lens_reason=adjustment.lens.reason,
        parameters=uncertainty.names,
        covariance=uncertainty.covariance,
        rms=agreement.rms,
        links=_link_fits(adjustment, agreement),
        relief=agreement.relief,
        leverage=adjustment.leverage,
        lever_std=lever_std(problem, fit) if has_lever else 0.0,
        messages=_messages(adjustment, cameras[reference], uncertainty.considered),
    )
    return _with_near_copies(alignment, adjustment) if given.near_copies else alignment


def _with_near_copies(alignment: Alignment, adjustment: AdjustedImages) -> Alignment:
    """The alignment with near copies of its images, placed by their links to it; they change nothing else."""
    given, problem, fit = adjustment.given, adjustment.problem, adjustment.choice.fit
    original = {k: k for k in adjustment.images.tolist()}
    original |= {copy: first for copy, first in given.near_copies.items() if first in original}
    images = np.array(sorted(original), dtype=np.intp)
    number = np.full(len(given.cameras), -1, dtype=np.intp)
    number[images] = np.arange(len(images))
    links = [link for link in given.links_of_copies if link.image1 in original and link.image2 in original]
    model, start = fit.model, fit.adjusted.parameters
    firsts = np.searchsorted(adjustment.images, [original[k] for k in images.tolist()])
    start = replace(start, poses=start.poses[firsts])
    free = np.repeat(~np.isin(images, adjustment.images)[:, None], model.pose_size, axis=1)
    held = tuple(map(exact, model.physical_parameters(start.shared)[0].tolist()))
    adjuster = BundleAdjuster(
        model,
        Observations.from_links(links, given.cameras).subset(np.arange(len(links)), number),
        FreeParameters(free, np.zeros_like(problem.free_lens)),
        replace(Priors.none(model, len(images)), shared=held),
    )
    every = replace(
        adjustment,
        given=replace(given, options=replace(given.options, pose_covariance=False)),
        images=images,
        problem=replace(problem, fixed=int(number[alignment.reference])),
        choice=replace(adjustment.choice, fit=replace(fit, adjusted=adjuster.run(start))),
    )
    homographies, poses = _in_frame_of_reference(every)
    result = alignment.with_copies(given.near_copies, [link.images for link in alignment.links])
    if poses is not None and result.poses is not None:
        known = result.poses  # how well a copy is known is how well its image is
        poses = replace(poses, covariance=known.covariance, with_first=known.with_first)
    return replace(result, homographies=homographies, poses=poses)


@dataclass(frozen=True, eq=False)
class _Agreement:
    """How well the matches agree with the adjustment."""

    squared: FloatArray  # (M,): squared errors, px²
    agreeing: BoolArray  # (M,)
    relief: ReliefTest

    @classmethod
    def of(cls, adjustment: AdjustedImages) -> Self:
        fit = adjustment.choice.fit
        # What is reported is how far points are off, whatever moved them.
        observations = replace(adjustment.problem.observations, relief=None)
        errors = whitened_errors(observations, fit.adjusted.homographies, fit.adjusted.parameters.lens)
        squared = squared_lengths(errors)
        # No lens or plane is exact enough for matches that are off by less to disagree.
        agreeing = squared < (ALIGNMENT_WIDTH * math.hypot(observations.sigma(squared), MODEL_ERROR)) ** 2
        left = coherence(observations, errors, observations.inliers(squared))
        return cls(squared, agreeing, relief_test(left, fit.model, len(observations)))

    @property
    def rms(self) -> float:
        """Root mean square of the errors that agree, pixels."""
        return float(np.sqrt(self.squared[self.agreeing].mean())) if self.agreeing.any() else math.nan


@dataclass(frozen=True, eq=False)
class _Uncertainty:
    """How well the parameters that all images share are known."""

    names: tuple[str, ...]  # of the P parameters that were estimated
    covariance: FloatArray  # (P, P)
    lens: FloatArray  # (5, 5): of the lens by what was estimated, zero for the rest
    considered: FloatArray  # (5, 5): of all parameters of the lens, with what was not estimated

    @classmethod
    def of(cls, adjustment: AdjustedImages, *, over_relief: bool) -> Self:
        """Over relief or not."""
        problem, fit = adjustment.problem, adjustment.choice.fit
        covariance = fit.adjusted.covariance if adjustment.covariance is None else adjustment.covariance
        estimated = [name for name, free in zip(LENS_PARAMETERS, problem.free_lens, strict=True) if free]
        names = (*fit.model.shared_names, *estimated)
        lens = considered = _lens_covariance(names, covariance)
        if adjustment.lens_covariance is not None and adjustment.lens.observable and problem.free_lens[0]:
            considered = considered_covariance(problem, fit, adjustment.lens_covariance, over_relief=over_relief)
        return cls(names, covariance, lens, considered)

    @property
    def std(self) -> FloatArray:
        """Standard deviations (P,)."""
        return np.sqrt(np.maximum(np.diag(self.covariance), 0.0))


def _adjusted_cameras(adjustment: AdjustedImages, uncertainty: _Uncertainty) -> tuple[Camera, ...]:
    """The camera of each image, with the lens, the focal length and the tilt that were found."""
    fit, std = adjustment.choice.fit, uncertainty.std
    model, shared = fit.model, fit.adjusted.parameters.shared
    tilt = tilt_std = None
    if model.has_metric_poses:
        physical = model.physical_parameters(shared)[0]
        tilt, tilt_std = ((float(values[0]), float(values[1])) for values in (physical, std))

    def adjusted_camera(camera: Camera) -> Camera:
        result = _with_lens(adjustment, camera, uncertainty)
        if model.one_camera:
            focal = model.focal(shared) * camera.scale
            focal_std = float(std[uncertainty.names.index("log_focal")]) * focal
            result = result.with_focal(focal, "estimate", focal_std)
        return replace(result, tilt=tilt, tilt_std=tilt_std)

    # Most images are of one camera.
    adjusted = {camera: adjusted_camera(camera) for camera in dict.fromkeys(adjustment.given.cameras)}
    return tuple(adjusted[camera] for camera in adjustment.given.cameras)


def _lens_covariance(names: Sequence[str], covariance: FloatArray) -> FloatArray:
    """Covariance (5, 5) of :data:`LENS_PARAMETERS`, zero for those that were not estimated."""
    result = np.zeros((len(LENS_PARAMETERS), len(LENS_PARAMETERS)))
    free = [index for index, name in enumerate(LENS_PARAMETERS) if name in names]
    rows = [names.index(LENS_PARAMETERS[index]) for index in free]
    result[np.ix_(free, free)] = covariance[np.ix_(rows, rows)]
    return result


def _with_lens(adjustment: AdjustedImages, camera: Camera, uncertainty: _Uncertainty) -> Camera:
    """The camera of an image with the lens that was found."""
    lens, covariance = adjustment.choice.fit.adjusted.parameters.lens, uncertainty.lens
    center = np.asarray(camera.center) + lens[CENTER] * camera.scale
    estimated = bool(covariance.any())
    result = replace(
        camera,
        distortion=float(lens[0]),
        distortion2=float(lens[1]),
        distortion3=float(lens[2]),
        center=(float(center[0]), float(center[1])),
        lens_covariance=tuple(map(tuple, covariance.tolist())) if estimated else None,
    )
    if estimated and result.sees_beyond_horizon:
        raise ImpossibleCameraError(f"with λ = {result.distortion:.3g} the corners would see behind the camera")
    lens_free = bool(adjustment.problem.free_lens.any())
    shown = adjustment.lens.observable and (adjustment.choice.fit.adjusted.converged or not lens_free)
    std = _nearest_distortion_std(result, uncertainty.considered) if shown else math.inf
    return replace(result, distortion_std=std)


def _nearest_distortion_std(camera: Camera, covariance: FloatArray) -> float:
    """Standard deviation of the λ of the nearest one-parameter lens."""
    gradient = np.zeros(len(covariance))
    for index, step in enumerate(_STEP * np.eye(3)):  # without cameras, which may fold at one end
        lenses = camera.coefficients + np.stack([-step, step])
        ends = [nearest_one_parameter(camera.squared_radii(), lens[0], lens[1:])[0] for lens in lenses]
        gradient[index] = (ends[1] - ends[0]) / (2.0 * _STEP)
    return math.sqrt(max(float(gradient @ covariance @ gradient), 0.0))


def _in_frame_of_reference(adjustment: AdjustedImages) -> tuple[FloatArray, PlanarPoses | None]:
    """Image-to-plane homographies of all images, and their poses where the model has them.

    The adjustment may have held the reference image anywhere; here it comes to the origin, with yaw zero and, as
    the unit of length, height one.
    """
    fit, reference = adjustment.choice.fit, adjustment.problem.reference
    parameters = fit.adjusted.parameters
    matrices = fit.adjusted.matrices.matrices

    def of_all(values: FloatArray) -> FloatArray:
        """Of all images, NaN for those that are not aligned."""
        result = np.full((len(adjustment.given.cameras), *values.shape[1:]), np.nan)
        result[adjustment.images] = values
        return result

    if fit.model.on_sphere:
        given = adjustment.given.options.gravity
        gravity = None if given is None else np.asarray(given, dtype=np.float64)[adjustment.images]
        return of_all(levelled(matrices, reference, gravity)), None
    if not fit.model.has_metric_poses:
        return of_all(matrices[reference] @ inverses(matrices)), None
    metric = fit.model.metric_poses(parameters.poses, parameters.shared)
    yaw, position = metric[:, YAW], metric[:, [X, Y]]
    height, tilt = np.exp(metric[:, LOG_HEIGHT]), metric[:, [PSI, THETA]]
    frame = rigid_in_plane(yaw[reference], position[reference], height[reference])
    poses = PlanarPoses(yaw, position, height, tilt).relative_to(reference)
    wanted = adjustment.given.options.pose_covariance and adjustment.covariance is not None
    covariances = pose_covariances(adjustment.problem, fit) if wanted else ()
    aligned_poses = (poses.yaw, poses.position, poses.height, poses.tilt, *covariances)
    return of_all(frame @ inverses(matrices)), PlanarPoses(*map(of_all, aligned_poses))


def _groups(adjustment: AdjustedImages) -> tuple[tuple[int, ...], ...]:
    """Connected groups of images by the links not taken for wrong, the aligned one first."""
    links = [link for link, kept in zip(adjustment.given.links, adjustment.kept_links, strict=True) if kept]
    groups = connected_components(len(adjustment.given.cameras), [k.image1 for k in links], [k.image2 for k in links])
    aligned = set(adjustment.images.tolist())
    ordered = sorted(groups, key=lambda group: group[0] not in aligned)
    return tuple(tuple(group) for group in ordered)


def _link_fits(adjustment: AdjustedImages, agreement: _Agreement) -> tuple[LinkFit, ...]:
    """How well each link agrees, in the order of the links given."""
    squared, agreeing = agreement.squared, agreement.agreeing
    observations = adjustment.problem.observations
    medians = observations.medians(np.sqrt(squared))
    images = adjustment.images
    rows = {
        frozenset((int(images[i]), int(images[j]))): row
        for row, (i, j) in enumerate(zip(observations.image1, observations.image2, strict=True))
    }
    result = []
    for link, kept in zip(adjustment.given.links, adjustment.kept_links, strict=True):
        row = rows.get(frozenset((link.image1, link.image2)))
        if row is None or not kept:
            why = Unused.ELSEWHERE if kept else Unused.CONTRADICTS
            result.append(LinkFit(link.image1, link.image2, len(link), 0, math.nan, False, why))
            continue
        rows_of_link = slice(observations.start[row], observations.start[row + 1])
        good = squared[rows_of_link][agreeing[rows_of_link]]
        fraction = len(good) / max(len(agreeing[rows_of_link]), 1)
        rms = float(np.sqrt(good.mean())) if len(good) else float(medians[row])
        result.append(LinkFit(link.image1, link.image2, len(link), round(fraction * len(link)), rms, True))
    return tuple(result)


def _messages(adjustment: AdjustedImages, camera: Camera, considered: FloatArray) -> tuple[Message, ...]:
    """What the user should know of the whole, with the covariance (5, 5) of all parameters of a lens."""
    result, lens, known = list[Message](), adjustment.lens, adjustment.problem.camera_priors
    purpose, fit = adjustment.given.options.purpose, adjustment.choice.fit
    if lens.depth or not lens.observable:
        result.append(lens_not_observable(purpose, depth=lens.depth))
    elif (count := len(adjustment.images)) < ENOUGH_IMAGES and adjustment.problem.free_lens.any():
        every = replace(camera, lens_covariance=tuple(map(tuple, considered.tolist())))
        off = _CONFIDENT * float(radius_std(every, _RADII)[-1])
        if off > _WORTH_SAYING:
            result.append(few_images(count, ENOUGH_IMAGES, off, purpose))
    if known.focal_source == "exif" and fit.model.one_camera and camera.focal is not None:
        ratio = camera.focal / camera.scale / math.exp(known.log_focal)
        if abs(math.log(ratio)) >= math.log(_OVERRULED):
            result.append(focal_overruled(ratio))
    if not fit.adjusted.converged:
        result.append(not_converged(purpose))
    if adjustment.positions_disagree:
        result.append(Message(adjustment.positions_disagree))
    return (*result, *adjustment.messages)
