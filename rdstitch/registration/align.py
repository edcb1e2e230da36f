"""The recipe of the global adjustment: consensus, match graph, choice of the model, adjustment."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from rdstitch.camera import Camera, FloatArray
from rdstitch.errors import ArgumentError
from rdstitch.registration.alignment import Alignment, LinkFit, Poses, Relief
from rdstitch.registration.bundle_adjustment import Adjusted, Adjuster, Freedom, Parameters, Priors
from rdstitch.registration.graph import connected_components, spanning_tree
from rdstitch.registration.initialization import adjust_apart, relations_at
from rdstitch.registration.links import Link
from rdstitch.registration.models import LOG_HEIGHT, MODELS, PSI, THETA, YAW, Model, X, Y
from rdstitch.registration.observations import Observations

_FOCAL_STD = {"option": 0.01, "file": 0.01, "estimate": 0.05, "exif": 0.05, "guess": 0.3, None: 0.4}
"""Relative standard deviation of a focal length by its source."""

_USUAL_FOCAL = 1.9
"""Half diagonals: the focal length where nothing is known of it (a field of view of about 55 degrees)."""


def focal_prior(cameras: Sequence[Camera]) -> tuple[float, float]:
    """Mean and standard deviation of the logarithm of the focal length in half diagonals."""
    known = [camera for camera in cameras if camera.focal is not None]
    if not known:
        return math.log(_USUAL_FOCAL), _FOCAL_STD[None]
    ratios = [camera.focal / camera.half_diagonal for camera in known if camera.focal is not None]
    return float(np.log(np.median(ratios))), max(_FOCAL_STD.get(camera.focal_source, 0.3) for camera in known)


@dataclass(frozen=True)
class _Task:
    """One connected set of pictures to align."""

    observations: Observations
    homographies: FloatArray
    count: int
    reference: int
    lens: FloatArray
    free_lens: np.ndarray
    focal: tuple[float, float]

    def priors(self, model: Model) -> Priors:
        none = Priors.none(model, self.count)
        if not model.shared_names:
            return none
        shared = np.array([0.0, 0.0, self.focal[0]])
        return replace(none, shared=shared, shared_precision=np.array([0.0, 0.0, self.focal[1] ** -2.0]))

    def fit(self, model: Model) -> Adjusted:
        priors = self.priors(model)
        apart = adjust_apart(
            model, self.observations, self.homographies, priors.shared, self.lens, self.free_lens, priors
        )
        o = self.observations
        counts = np.diff(o.start).astype(np.float64)
        tree = spanning_tree(self.count, o.image1, o.image2, counts, self.reference)
        origin = model.origin(apart.parameters.shared)
        chained = tree.chained(apart.homographies, o.image1, origin)
        shared = apart.parameters.shared
        start = Parameters(model.poses_from(chained, shared), shared, apart.parameters.lens)
        freedom = Freedom.fixing(model, self.count, [self.reference], self.free_lens)
        return Adjuster(model, o, freedom, priors).run(start)


def align(
    cameras: Sequence[Camera],
    links: Sequence[Link],
    *,
    reference: int | None = None,
    model: str = "auto",
    distortion: float | None = None,
) -> Alignment:
    """Align all pictures over one plane.

    Parameters
    ----------
    cameras : sequence of Camera
        One per picture, of one lens.
    links : sequence of Link
        The pairs that overlap.
    reference : int, optional
        The picture that defines the plane's frame; the centre of the match graph if not given.
    model : str
        "rigid", "similarity", "tilting", "homography", or "auto": the least free one that the data allow.
    distortion : float, optional
        λ where it is known; estimated otherwise.

    Raises
    ------
    ArgumentError
        When there are no links, or an argument is out of range.
    """
    if not links:
        raise ArgumentError("nothing to align: no two pictures overlap")
    count = len(cameras)
    index1, index2 = (np.array([getattr(link, n) for link in links], dtype=np.intp) for n in ("image1", "image2"))
    components = connected_components(count, index1, index2)
    group = np.array(components[0])
    used = np.zeros(count, dtype=np.bool_)
    used[group] = True
    number = np.full(count, -1, dtype=np.intp)
    number[group] = np.arange(len(group))
    chosen = np.flatnonzero(used[index1])
    observations = Observations.from_links([links[k] for k in chosen], cameras, 250).subset(
        np.arange(len(chosen)), number
    )
    votes = [links[k].relation.distortion for k in chosen if links[k].relation.distortion_observable]
    lens = np.zeros(4)
    lens[0] = distortion if distortion is not None else (float(np.median(votes)) if votes else 0.0)
    free_lens = np.array([distortion is None, False, False, False])
    relations = relations_at(observations, [links[k].relation for k in chosen], lens)
    weights = np.diff(observations.start).astype(np.float64)
    root = spanning_tree(len(group), observations.image1, observations.image2, weights).root
    root = root if reference is None else int(number[reference])
    task = _Task(observations, relations, len(group), root, lens, free_lens, focal_prior(cameras))
    names = ("rigid", "homography") if model == "auto" else (model,)
    fits = {name: task.fit(MODELS[name]) for name in names}
    best = min(fits, key=lambda name: fits[name].sigma * (1.1 if name == "homography" else 1.0))
    fit, family = fits[best], MODELS[best]

    homographies = np.full((count, 3, 3), np.nan)
    homographies[group] = np.linalg.inv(fit.matrices.matrices)
    planar = bool(family.shared_names)
    std = np.sqrt(np.diag(fit.covariance))
    parameters = (*family.shared_names, *(("distortion",) if distortion is None else ()))
    lam = float(fit.parameters.lens[0])
    lam_std = float(std[-1]) if distortion is None else 0.0
    focal = float(np.exp(fit.parameters.shared[2])) if planar else None
    new = tuple(
        replace(
            camera,
            distortion=lam,
            distortion_std=lam_std,
            focal=camera.focal if focal is None else focal * camera.half_diagonal,
            focal_source=camera.focal_source if focal is None else "estimate",
        )
        for camera in cameras
    )
    poses = None
    if planar:
        full = np.full((count, 6), np.nan)
        full[group] = fit.parameters.poses
        poses = Poses(
            full[:, YAW],
            full[:, [X, Y]],
            np.exp(full[:, LOG_HEIGHT]),
            full[:, [PSI, THETA]] + fit.parameters.shared[:2],
        )
    fits_of_links = [
        LinkFit(link.image1, link.image2, len(link), len(link), float("nan"), False, "other group") for link in links
    ]
    inlier = fit.squared < (3.5 * fit.sigma) ** 2
    for row, k in enumerate(chosen):
        own = slice(observations.start[row], observations.start[row + 1])
        squared = fit.squared[own][inlier[own]]
        rms = float(np.sqrt(squared.mean())) if len(squared) else float("nan")
        fits_of_links[k] = replace(fits_of_links[k], inliers=int(inlier[own].sum()), rms=rms, used=True, reason="")
    return Alignment(
        cameras=new,
        homographies=homographies,
        used=used,
        reasons=tuple("" if u else "overlaps with no other picture of the largest group" for u in used),
        components=tuple(tuple(c) for c in components),
        reference=int(group[root]),
        model=best,
        model_reason="",
        poses=poses,
        tilt=(float(fit.parameters.shared[0]), float(fit.parameters.shared[1])) if planar else None,
        tilt_spread=0.0,
        focal=focal,
        focal_std=float(std[2]) * focal if focal is not None else None,
        distortion=lam,
        distortion_std=lam_std,
        parameters=parameters,
        covariance=fit.covariance,
        rms=float(np.sqrt(fit.squared[inlier].mean())),
        links=tuple(fits_of_links),
        relief=Relief(False, 0.0, 0.0, ""),
    )
