"""From the adjusted parameters to the :class:`Alignment`: frames, poses, uncertainties, and what was left out."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from rdstitch.alignment import sentences
from rdstitch.alignment.adjustment_problem import Fit, Problem
from rdstitch.alignment.alignment_options import GivenImages
from rdstitch.alignment.frames.level_frame import levelled
from rdstitch.alignment.least_squares.link_equations import squared_lengths, whitened_errors
from rdstitch.alignment.lens.lens_description import radius_std
from rdstitch.alignment.lens.lens_selection import CENTER, ENOUGH_IMAGES, LensChoice
from rdstitch.alignment.near_copies import with_near_copies
from rdstitch.alignment.noise import coherence, shows_relief
from rdstitch.alignment.result import Alignment, LinkFit, PlanarPoses, ReliefTest, Unused
from rdstitch.alignment.select import ModelChoice
from rdstitch.alignment.uncertainty import considered_covariance, lever_std, pose_covariances
from rdstitch.arrays import BoolArray, FloatArray, IntArray
from rdstitch.errors import ImpossibleCameraError
from rdstitch.geometry.camera import LENS_PARAMETERS, Camera
from rdstitch.geometry.division_model import nearest_one_parameter
from rdstitch.geometry.planar_motion import rigid_in_plane
from rdstitch.geometry.radial_homography import inverses
from rdstitch.matching.match_graph import connected_components
from rdstitch.numerics.robust_loss import ALIGNMENT_WIDTH
from rdstitch.results.messages import Message
from rdstitch.robust.posterior import MODEL_ERROR

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
    leverage: Mapping[int | str, float] = field(default_factory=dict)  # see Alignment
    messages: tuple[Message, ...] = ()  # on what was given
    # covariance, lens_covariance: of what was estimated, and of all parameters of a lens; none of a draft
    covariance: FloatArray | None = None
    lens_covariance: FloatArray | None = None

    @property
    def fit(self) -> Fit:
        """The chosen model, adjusted."""
        return self.choice.fit

    @property
    def parameters(self) -> tuple[str, ...]:
        """Names of the P parameters that were estimated of what all images share."""
        free = zip(LENS_PARAMETERS, self.problem.free_lens, strict=True)
        return (*self.fit.model.shared_names, *(name for name, estimated in free if estimated))

    @property
    def covariance_of_parameters(self) -> FloatArray:
        """(P, P)."""
        return self.fit.result.covariance if self.covariance is None else self.covariance

    @cached_property
    def estimated_lens_covariance(self) -> FloatArray:
        """(5, 5): of the lens by what was estimated, zero for the rest."""
        free, shared = np.flatnonzero(self.problem.free_lens), len(self.fit.model.shared_names)
        result = np.zeros((len(LENS_PARAMETERS), len(LENS_PARAMETERS)))
        result[np.ix_(free, free)] = self.covariance_of_parameters[shared:, shared:]
        return result

    @cached_property
    def considered_lens_covariance(self) -> FloatArray:
        """(5, 5): of all parameters of the lens, with what was not estimated."""
        if self.lens_covariance is None or not (self.lens.observable and self.problem.free_lens[0]):
            return self.estimated_lens_covariance
        return considered_covariance(self.problem, self.fit, self.lens_covariance, over_relief=self.relief.found)

    @cached_property
    def errors(self) -> FloatArray:
        """Errors of all correspondences (M, 2), pixels, whitened: how far points are off, whatever moved them."""
        observations, adjusted = replace(self.problem.observations, relief=None), self.fit.result
        return whitened_errors(observations, adjusted.homographies, adjusted.parameters.lens)

    @cached_property
    def squared(self) -> FloatArray:
        """``|r|²`` of these (M,)."""
        return squared_lengths(self.errors)

    @cached_property
    def agreeing(self) -> BoolArray:
        """Correspondences (M,) that agree: no lens or plane is exact enough for those off by less to disagree."""
        sigma = self.problem.observations.sigma(self.squared)
        return self.squared < (ALIGNMENT_WIDTH * math.hypot(sigma, MODEL_ERROR)) ** 2

    @cached_property
    def relief(self) -> ReliefTest:
        """Whether the scene is the plane that it is taken for."""
        seen = self.problem.observations
        left = coherence(seen, self.errors, seen.inliers(self.squared))
        explanation = sentences.relief_explained(left, self.fit.model, len(seen))
        return ReliefTest(shows_relief(left), left.correlation, left.size, explanation)

    def of_all(self, values: FloatArray) -> FloatArray:
        """Values of the images aligned (N, ...) as those of all images, NaN for the rest."""
        result = np.full((len(self.given.cameras), *values.shape[1:]), np.nan)
        result[self.images] = values
        return result


def build_alignment(adjusted: AdjustedImages) -> Alignment:
    """The alignment, in the frame of the reference image.

    A draft, which has no covariances, has the deviations of the normal equations.
    """
    fit, agreeing = adjusted.fit, adjusted.squared[adjusted.agreeing]
    cameras = _adjusted_cameras(adjusted)
    reference = int(adjusted.images[adjusted.problem.reference])
    homographies, poses = _in_frame_of_reference(adjusted)
    has_lever = adjusted.relief.found and fit.model.has_metric_poses and adjusted.covariance is not None
    alignment = Alignment(
        cameras=cameras,
        homographies=homographies,
        used=np.isin(np.arange(len(cameras)), adjusted.images),
        components=_groups(adjusted),
        reference=reference,
        model=fit.model.name,
        model_reason=adjusted.choice.reason,
        poses=poses,
        tilt_spread=fit.tilt_spread or 0.0,
        lens=adjusted.lens.name,
        lens_reason=adjusted.lens.reason,
        parameters=adjusted.parameters,
        covariance=adjusted.covariance_of_parameters,
        rms=float(np.sqrt(agreeing.mean())) if len(agreeing) else math.nan,
        links=_link_fits(adjusted),
        relief=adjusted.relief,
        leverage=adjusted.leverage,
        lever_std=lever_std(adjusted.problem, fit) if has_lever else 0.0,
        messages=_messages(adjusted, cameras[reference]),
    )
    if not adjusted.given.near_copies:
        return alignment
    return with_near_copies(alignment, adjusted.given, adjusted.images, adjusted.all_links, fit)


def _adjusted_cameras(adjusted: AdjustedImages) -> tuple[Camera, ...]:
    """The camera of each image, with the lens, the focal length and the tilt that were found."""
    model, shared = adjusted.fit.model, adjusted.fit.result.parameters.shared
    std = np.sqrt(np.maximum(np.diag(adjusted.covariance_of_parameters), 0.0))
    tilt = tilt_std = None
    if model.has_metric_poses:
        physical = model.physical_parameters(shared)[0]
        tilt, tilt_std = ((float(values[0]), float(values[1])) for values in (physical, std))

    def adjusted_camera(camera: Camera) -> Camera:
        result = _with_lens(adjusted, camera)
        if model.one_camera:
            focal = model.focal(shared) * camera.scale
            focal_std = float(std[adjusted.parameters.index("log_focal")]) * focal
            result = result.with_focal(focal, "estimate", focal_std)
        return replace(result, tilt=tilt, tilt_std=tilt_std)

    # Most images are of one camera.
    of_each = {camera: adjusted_camera(camera) for camera in dict.fromkeys(adjusted.given.cameras)}
    return tuple(of_each[camera] for camera in adjusted.given.cameras)


def _with_lens(adjusted: AdjustedImages, camera: Camera) -> Camera:
    """The camera of an image with the lens that was found."""
    lens, covariance = adjusted.fit.result.parameters.lens, adjusted.estimated_lens_covariance
    x, y = (np.asarray(camera.center) + lens[CENTER] * camera.scale).tolist()
    estimated = bool(covariance.any())
    result = replace(
        camera.with_coefficients(*lens[:3].tolist()),
        center=(x, y),
        lens_covariance=tuple(map(tuple, covariance.tolist())) if estimated else None,
    )
    if estimated and result.sees_beyond_horizon:
        raise ImpossibleCameraError(f"with λ = {result.distortion:.3g} the corners would see behind the camera")
    converged = adjusted.fit.result.converged or not adjusted.problem.free_lens.any()
    shown = adjusted.lens.observable and converged
    std = _nearest_distortion_std(result, adjusted.considered_lens_covariance) if shown else math.inf
    return replace(result, distortion_std=std or None)


def _nearest_distortion_std(camera: Camera, covariance: FloatArray) -> float:
    """Standard deviation of the λ of the nearest one-parameter lens."""
    gradient = np.zeros(len(covariance))
    for index, step in enumerate(_STEP * np.eye(3)):  # without cameras, which may fold at one end
        lenses = camera.coefficients + np.stack([-step, step])
        ends = [nearest_one_parameter(camera.squared_radii(), lens[0], lens[1:])[0] for lens in lenses]
        gradient[index] = (ends[1] - ends[0]) / (2.0 * _STEP)
    return math.sqrt(max(float(gradient @ covariance @ gradient), 0.0))


def _in_frame_of_reference(adjusted: AdjustedImages) -> tuple[FloatArray, PlanarPoses | None]:
    """Image-to-plane homographies of all images, and their poses where the model has them.

    The adjustment may have held the reference image anywhere; here it comes to the origin, with yaw zero and, as
    the unit of length, height one.
    """
    model, parameters, of_all = adjusted.fit.model, adjusted.fit.result.parameters, adjusted.of_all
    reference, matrices = adjusted.problem.reference, adjusted.fit.result.matrices.matrices
    if model.on_sphere:
        given = adjusted.given.options.gravity
        gravity = None if given is None else np.asarray(given, dtype=np.float64)[adjusted.images]
        return of_all(levelled(matrices, reference, gravity)), None
    if not model.has_metric_poses:
        return of_all(matrices[reference] @ inverses(matrices)), None
    metric = model.metric_poses(parameters.poses, parameters.shared)
    poses = PlanarPoses.of(metric)
    frame = rigid_in_plane(poses.yaw[reference], poses.position[reference], poses.height[reference])
    poses = poses.relative_to(reference)
    wanted = adjusted.given.options.pose_covariance and adjusted.covariance is not None
    covariances = pose_covariances(adjusted.problem, adjusted.fit) if wanted else ()
    aligned_poses = (poses.yaw, poses.position, poses.height, poses.tilt, *covariances)
    return of_all(frame @ inverses(matrices)), PlanarPoses(*map(of_all, aligned_poses))


def _groups(adjusted: AdjustedImages) -> tuple[tuple[int, ...], ...]:
    """Connected groups of images by the links not taken for wrong, the aligned one first."""
    links = [link for link, kept in zip(adjusted.given.links, adjusted.kept_links, strict=True) if kept]
    groups = connected_components(len(adjusted.given.cameras), [k.image1 for k in links], [k.image2 for k in links])
    aligned = set(adjusted.images.tolist())
    return tuple(map(tuple, sorted(groups, key=lambda group: group[0] not in aligned)))


def _link_fits(adjusted: AdjustedImages) -> tuple[LinkFit, ...]:
    """How well each link agrees, in the order of the links given."""
    observations, images = adjusted.problem.observations, adjusted.images
    medians = observations.medians(np.sqrt(adjusted.squared))
    rows = {
        frozenset((int(images[i]), int(images[j]))): row
        for row, (i, j) in enumerate(zip(observations.image1, observations.image2, strict=True))
    }
    result = []
    for link, kept in zip(adjusted.given.links, adjusted.kept_links, strict=True):
        row = rows.get(frozenset((link.image1, link.image2)))
        if row is None or not kept:
            why = Unused.ELSEWHERE if kept else Unused.CONTRADICTS
            result.append(LinkFit(link.image1, link.image2, len(link), 0, math.nan, why))
            continue
        rows_of_link = slice(observations.start[row], observations.start[row + 1])
        agreeing = adjusted.agreeing[rows_of_link]
        good = adjusted.squared[rows_of_link][agreeing]
        inliers = round(len(good) / max(len(agreeing), 1) * len(link))
        rms = float(np.sqrt(good.mean())) if len(good) else float(medians[row])
        result.append(LinkFit(link.image1, link.image2, len(link), inliers, rms))
    return tuple(result)


def _messages(adjusted: AdjustedImages, camera: Camera) -> tuple[Message, ...]:
    """What the user should know of the whole."""
    result, lens, known = list[Message](), adjusted.lens, adjusted.problem.camera_priors
    purpose, fit = adjusted.given.options.purpose, adjusted.fit
    if not lens.observable:
        result.append(sentences.lens_not_observable(purpose, lens.evidence))
    elif (count := len(adjusted.images)) < ENOUGH_IMAGES and adjusted.problem.free_lens.any():
        every = replace(camera, lens_covariance=tuple(map(tuple, adjusted.considered_lens_covariance.tolist())))
        off = _CONFIDENT * float(radius_std(every, _RADII)[-1])
        if off > _WORTH_SAYING:
            result.append(sentences.few_images(count, ENOUGH_IMAGES, off, purpose))
    if known.focal_source == "exif" and fit.model.one_camera and camera.focal is not None:
        ratio = camera.focal / camera.scale / math.exp(known.log_focal)
        if abs(math.log(ratio)) >= math.log(_OVERRULED):
            result.append(sentences.focal_overruled(ratio))
    if not fit.result.converged:
        result.append(sentences.not_converged(purpose))
    return (*result, *adjusted.messages)
