"""Homography and distortion of pairs of images from their matches: the public functions."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from rdstitch.arrays import FloatArray, IntArray, as_numbers
from rdstitch.choices import FocalSource, SolverName
from rdstitch.errors import ArgumentError
from rdstitch.geometry.camera import Camera
from rdstitch.geometry.radial_homography import RadialHomography, are_homographies
from rdstitch.options.estimation_options import EstimationOptions
from rdstitch.robust.chance import MIN_OCCUPIED_CELLS, occupied_cells, rejection_reason
from rdstitch.robust.measurements import Measurements, checked_matches, padded_length
from rdstitch.robust.minimal import MinimalSolver, minimal_solvers
from rdstitch.robust.model_selection import ModelSelection, PairFit, StartedPairs, rms_of
from rdstitch.robust.pair_models import PlanarPairModel
from rdstitch.robust.priors import Prior, focal_prior, known_focal
from rdstitch.robust.ransac import Hypotheses, ransac

_NOT_IN_AUTO = "four_point"  # finds what three points find, from more samples
# matches, with padding, of the pairs in one batch: enough to hide Python's overhead, few enough for the caches
_MATCHES_AT_ONCE = 1 << 14


@dataclass(frozen=True, eq=False)
class PairMatches:
    """Matches of one pair of images, and what is known of the cameras.

    Of these, sizes, distortion centres and focal lengths are used: one lens took both images, so λ and the focal length
    in half diagonals are shared. Where cameras differ in what is shared, it is less certain; where none has a focal
    length, it is guessed. What lens they have is not used.
    """

    points1: FloatArray  # points1, points2: (N, 2): measured points of image 1 and image 2, pixels
    points2: FloatArray
    camera1: Camera  # camera1, camera2: of one lens, whatever was given
    camera2: Camera
    quality: FloatArray | None = None  # (N,): how much each match can be trusted, the higher the better
    tilts: FloatArray | None = None  # (2, 2): known (ψ, θ) of both images, radians

    def __post_init__(self) -> None:
        checked_matches(self.points1, self.points2)
        log_focal, log_std, source = known_focal((self.camera1, self.camera2))
        first = self.camera1.without_lens()
        focal = math.exp(log_focal) * first.scale
        first = first.with_focal(focal, source, log_std * focal)
        second = replace(first.resized(self.camera2.image_size), center=self.camera2.center)
        object.__setattr__(self, "camera1", first)
        object.__setattr__(self, "camera2", second)
        if self.quality is not None and self.quality.shape != (len(self),):
            raise ArgumentError(f"quality must have shape ({len(self)},), not {self.quality.shape}")
        if self.quality is not None and np.isnan(self.quality).any():
            raise ArgumentError("quality has values that are NaN")
        if self.tilts is not None and self.tilts.shape != (2, 2):
            raise ArgumentError(f"tilt must be (psi, theta) or one such pair an image, not of shape {self.tilts.shape}")
        if self.tilts is not None and not (np.abs(self.tilts) < np.pi / 2.0).all():
            raise ArgumentError("tilt must be finite and below a right angle, in radians")

    def __len__(self) -> int:
        """Number of matches."""
        return len(self.points1)

    @property
    def focal(self) -> float:
        """Focal length in half diagonals."""
        assert self.camera1.focal is not None
        return self.camera1.focal / self.camera1.scale

    @property
    def focal_prior(self) -> Prior:
        """Prior on the logarithm of the focal length."""
        return focal_prior(math.log(self.focal), self.camera1.focal_log_std, self.camera1.focal_source or "guess")

    @property
    def batch_key(self) -> tuple[int, float, Prior, bool]:
        """What pairs that go on in lockstep have in common."""
        return padded_length(len(self)), self.focal, self.focal_prior, self.tilts is None

    @property
    def sizes(self) -> tuple[tuple[int, int], tuple[int, int]]:
        """Width and height of both images, pixels."""
        return self.camera1.image_size, self.camera2.image_size

    @property
    def order(self) -> IntArray:
        """The matches, best first."""
        return np.arange(len(self)) if self.quality is None else np.argsort(-self.quality, kind="stable")


def estimate_radial_homography(
    points1: ArrayLike,
    points2: ArrayLike,
    image_size: tuple[int, int],
    *,
    image_size2: tuple[int, int] | None = None,
    focal: float | None = None,
    focal_source: FocalSource | None = None,
    center: tuple[float, float] | None = None,
    solver: SolverName = "auto",
    tilt: ArrayLike | None = None,
    distortion: float | None = None,
    quality: ArrayLike | None = None,
    threshold: float = 3.0,
    confidence: float = 0.999,
    max_iterations: int = 10000,
    seed: int = 0,
) -> RadialHomography:
    """Estimate homography and division-model distortion together from point matches of two images of a plane.

    Parameters
    ----------
    points1, points2 : array_like of shape (N, 2)
        Measured points of image 1 and image 2, pixels; wrong matches are expected among them.
    image_size : (int, int)
        Width and height of image 1, pixels.
    image_size2 : (int, int), optional
        Of image 2, where it differs: the same lens at another resolution or turned by a quarter.
    focal : float, optional
        Focal length, pixels of image 1; guessed if not given. Models of planar motion use it.
    focal_source : FocalSource, optional
        How much the focal length can be trusted, a key of :data:`rdstitch.geometry.camera.FOCAL_LOG_STD`;
        "option" if not given.
    center : (float, float), optional
        Distortion centre of image 1, pixels; the image centre if not given.
    solver : str
        One of :data:`rdstitch.robust.SOLVERS`. "auto" lets all solvers that the input allows compete.
    tilt : array_like of shape (2,) or (2, 2), optional
        Known tilt (ψ, θ), radians, or one an image.
    distortion : float, optional
        Known λ in the half-diagonal frame; it is then not estimated.
    quality : array_like of shape (N,), optional
        How much each match can be trusted, the higher the better: better matches are sampled first (PROSAC).
    threshold : float
        Largest error of an inlier: of its transfer, in pixels of image 2, over what one pixel in each image does to it.
    confidence : float
        Probability with which no better model was missed when sampling stops.
    max_iterations : int
        At most so many samples.
    seed : int
        The same seed gives the same result, bit for bit.

    Returns
    -------
    RadialHomography
        Falsy, with the reason, when no reliable model was found.

    Raises
    ------
    ArgumentError
        When an argument has the wrong shape, type or range.

    Examples
    --------
    >>> import numpy as np, rdstitch
    >>> points1 = np.random.default_rng(0).uniform((0, 0), (639, 479), (100, 2))
    >>> result = rdstitch.estimate_radial_homography(points1, points1 + (30.0, 5.0), (640, 480))
    >>> result.ok, result.model
    (True, 'rigid')
    """
    camera1 = Camera(image_size, focal=focal, focal_source=None if focal is None else focal_source or "option")
    size2 = image_size if image_size2 is None else image_size2
    if center is not None:
        if (image_size[0] - image_size[1]) * (size2[0] - size2[1]) < 0:
            raise ArgumentError(
                "center goes with no image_size2 that is turned by a quarter: to which side is not known"
            )
        camera1 = replace(camera1, center=center)
    options = EstimationOptions(solver, threshold, confidence, max_iterations, seed, distortion)
    p1, p2 = checked_matches(points1, points2)
    weights = None if quality is None else as_numbers("quality", quality)
    tilts = None if tilt is None else as_numbers("tilt", tilt)
    if tilts is not None and tilts.shape == (2,):
        tilts = np.broadcast_to(tilts, (2, 2))
    pair = PairMatches(p1, p2, camera1, camera1.resized(size2), weights, tilts)
    return estimate_radial_homographies([pair], options)[0]


def estimate_radial_homographies(pairs: Sequence[PairMatches], options: EstimationOptions) -> list[RadialHomography]:
    """Estimate many pairs at once: several times faster than :func:`estimate_radial_homography`, and the same."""
    if options.solver == "two_point" and any(pair.tilts is None for pair in pairs):
        raise ArgumentError("the two_point solver needs the tilt")
    result: dict[int, RadialHomography] = {}
    batches: dict[tuple[int, float, Prior, bool], list[int]] = {}
    for index, pair in enumerate(pairs):
        if (cells := occupied_cells(pair.points1, pair.points2, *pair.sizes)) < MIN_OCCUPIED_CELLS:
            reason = f"only {len(pair)} matches, in {cells} places of the image"
            result[index] = RadialHomography.failed(reason, pair.camera1, pair.camera2, len(pair))
        else:
            batches.setdefault(pair.batch_key, []).append(index)
    for (length, *_), members in batches.items():
        step = max(1, _MATCHES_AT_ONCE // length)
        for start in range(0, len(members), step):
            block = members[start : start + step]
            result.update(zip(block, _estimate_batch([pairs[i] for i in block], options), strict=True))
    return [result[index] for index in range(len(pairs))]


def _estimate_batch(pairs: list[PairMatches], options: EstimationOptions) -> list[RadialHomography]:
    """Estimate pairs with the same ``batch_key``."""
    order = [pair.order for pair in pairs]
    data = Measurements.of_pairs(
        [(pair.points1[ranked], pair.points2[ranked]) for pair, ranked in zip(pairs, order, strict=True)],
        [(pair.camera1, pair.camera2) for pair in pairs],
    )
    known = [pair.tilts for pair in pairs if pair.tilts is not None]
    tilts = np.stack(known) if known else None
    solvers = _solvers(options, pairs[0].focal, pairs[0].focal_prior, tilts is not None)
    search = ransac(solvers, data, np.array([pair.quality is not None for pair in pairs]), tilts, options)
    fits = _selected(pairs[0], search.best, data, tilts, options)
    result = []
    for row, (pair, ranked) in enumerate(zip(pairs, order, strict=True)):
        iterations, count = int(search.iterations[row]), len(pair)
        if row not in fits:
            reason = f"no plausible model in {iterations} samples of {count} matches"
            result.append(RadialHomography.failed(reason, pair.camera1, pair.camera2, count, iterations))
            continue
        errors = np.empty(count)
        errors[ranked] = fits[row].errors[:count]
        solver, confident = solvers[int(search.best.solver[row])].name, bool(search.confident[row])
        result.append(_result(pair, fits[row], errors, options.threshold, solver, iterations, confident))
    return result


def _selected(
    pair: PairMatches, best: Hypotheses, data: Measurements, tilts: FloatArray | None, options: EstimationOptions
) -> dict[int, PairFit]:
    """The model of each pair, by its row, that has a hypothesis; ``pair`` is any of the batch."""
    solved = np.flatnonzero(np.isfinite(best.cost))
    # Pairs with many inliers keep a free homography, where the options say so.
    few = best.inliers[solved].sum(axis=1) < (np.inf if options.select_below is None else options.select_below)
    selection = ModelSelection(options.threshold, options.distortion is not None)
    pairs = StartedPairs(data, best.homography, best.distortion, tilts)
    prior = pair.focal_prior
    planar = [PlanarPairModel(pair.focal, prior, tilts is not None, height_free=free) for free in (False, True)]
    fits: dict[int, PairFit] = {}
    for models, rows in ((planar, few), ([], ~few)):
        if rows.any():
            selected = selection.select(models, pairs.take(solved[rows]))
            fits.update(zip(solved[rows].tolist(), selected, strict=True))
    return fits


def _solvers(options: EstimationOptions, focal: float, prior: Prior, tilts_known: bool) -> list[MinimalSolver]:
    solvers = minimal_solvers(focal, prior, tilts_known, options.distortion)
    if options.solver == "auto":
        return [solver for solver in solvers if solver.name != _NOT_IN_AUTO]
    if options.solver == "three_point":
        solvers = minimal_solvers(focal, prior, False, options.distortion)
    return [solver for solver in solvers if solver.name == options.solver]


def _result(
    pair: PairMatches, fit: PairFit, errors: FloatArray, threshold: float, solver: str, iterations: int, confident: bool
) -> RadialHomography:
    """What was found of a pair, unless that could be chance."""
    inliers = errors < threshold
    doubt = rejection_reason(pair.points1, pair.points2, inliers, pair.sizes, threshold)
    if doubt is None and not are_homographies(fit.homography[None])[0]:
        doubt = f"{int(inliers.sum())} of {len(pair)} matches agree, but on no homography that images can have"
    if doubt is not None:
        return RadialHomography.failed(doubt, pair.camera1, pair.camera2, len(pair), iterations)
    reason = fit.reason
    if not confident:
        reason += "; the search stopped at its limit of samples before it was confident"
    camera1, camera2 = (
        replace(camera, distortion=fit.distortion, distortion_std=fit.distortion_std or None)
        for camera in (pair.camera1, pair.camera2)
    )
    return RadialHomography(
        homography=fit.homography / np.cbrt(np.linalg.det(fit.homography)),
        camera=camera1,
        camera2=camera2,
        inliers=inliers,
        covariance=fit.covariance,
        parameters=("distortion", *fit.model.parameters)[-len(fit.covariance) :],
        distortion_std=fit.distortion_std,
        model=fit.model.name,
        motion=fit.model.motion(fit.state),
        rms=float(rms_of(errors[None], threshold)[0]),
        solver=solver,
        iterations=iterations,
        reason=reason,
    )
