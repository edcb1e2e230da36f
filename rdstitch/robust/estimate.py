"""Homography and distortion of one pair of pictures from its correspondences: the public function."""

from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from rdstitch.camera import Camera
from rdstitch.errors import ArgumentError
from rdstitch.radial_homography import RadialHomography
from rdstitch.robust.measurements import Measurements
from rdstitch.robust.minimal import MinimalSolver, minimal_solvers
from rdstitch.robust.model_selection import Selection, rms_of, select_model
from rdstitch.robust.pair_models import HomographyModel, PairModel, PlanarModel, Tilts
from rdstitch.robust.ransac import Hypothesis, RansacOptions, Search, ransac
from rdstitch.robust.verification import LEAST_PLACES, places, rejection_reason

SOLVERS = ("auto", "two_point", "three_point", "three_point_similarity", "four_point", "five_point")

_AUTO_LEAVES_OUT = "four_point"  # finds what three points find, from more samples


def estimate_radial_homography(
    points1: ArrayLike,
    points2: ArrayLike,
    image_size: tuple[int, int],
    *,
    image_size2: tuple[int, int] | None = None,
    focal: float | None = None,
    focal_source: str | None = None,
    center: tuple[float, float] | None = None,
    solver: str = "auto",
    tilt: ArrayLike | None = None,
    distortion: float | None = None,
    quality: ArrayLike | None = None,
    threshold: float = 3.0,
    confidence: float = 0.999,
    max_iterations: int = 10000,
    seed: int = 0,
) -> RadialHomography:
    """Estimate homography and division-model distortion together from point matches of two pictures of a plane.

    Parameters
    ----------
    points1, points2 : array_like of shape (N, 2)
        Measured points of picture 1 and picture 2, px; wrong matches are expected among them.
    image_size : (int, int)
        Width and height of picture 1, px.
    image_size2 : (int, int), optional
        Of picture 2, where it differs: the same lens at another resolution or turned by a quarter.
    focal : float, optional
        Focal length, px of picture 1; guessed if not given. Models of planar motion use it.
    focal_source : str, optional
        How much the focal length can be trusted, a key of :data:`rdstitch.camera.FOCAL_LOG_STD`; "option" if not given.
    center : (float, float), optional
        Distortion centre of picture 1, px; the image centre if not given.
    solver : str
        One of :data:`SOLVERS`. "auto" lets all solvers that the input allows compete.
    tilt : array_like of shape (2,) or (2, 2), optional
        Known tilt (ψ, θ), radians, or one a picture.
    distortion : float, optional
        Known λ in the half-diagonal frame; it is then not estimated.
    quality : array_like of shape (N,), optional
        How much each match can be trusted, the higher the better: better matches are sampled first (PROSAC).
    threshold : float
        Largest transfer error of an inlier, px of picture 2.
    confidence : float
        Wanted probability that no better model was missed.
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
    camera1 = _camera(image_size, center, focal, focal_source)
    camera2 = camera1.resized(image_size2 or image_size)
    tilts = _tilts(tilt)
    _check(solver, tilts, distortion, threshold, confidence, max_iterations)
    p1, p2 = np.asarray(points1, dtype=np.float64), np.asarray(points2, dtype=np.float64)
    weights = None if quality is None else np.asarray(quality, dtype=np.float64)
    data = Measurements.from_pixels(p1, p2, camera1, camera2, weights)

    solvers = _solvers(solver, camera1, tilts, distortion)
    if (found := places(p1, p2, camera2.image_size)) < LEAST_PLACES:
        reason = f"only {len(data)} matches, in {found} places of the picture"
        return RadialHomography.failed(reason, camera1, camera2, len(data))
    search = ransac(solvers, data, RansacOptions(threshold, confidence, max_iterations, seed, LEAST_PLACES))
    if search.best is None:
        reason = f"no plausible model in {search.iterations} samples of {len(data)} matches"
        return RadialHomography.failed(reason, camera1, camera2, len(data), search.iterations)
    chosen = select_model(
        _models(camera1, tilts), search.best.homography, search.best.distortion, data, threshold,
        fixed_distortion=distortion is not None,
    )  # fmt: skip
    doubt = rejection_reason(p1, p2, chosen.fit.errors < threshold, camera2.image_size, threshold)
    if doubt is not None:
        return RadialHomography.failed(doubt, camera1, camera2, len(data), search.iterations)
    return _result(chosen, search, search.best, camera1, camera2, threshold)


def _camera(
    image_size: tuple[int, int], center: tuple[float, float] | None, focal: float | None, source: str | None
) -> Camera:
    camera = Camera(image_size, focal=focal, focal_source=None if focal is None else source or "option")
    camera = camera if center is None else replace(camera, center=center)
    return camera.with_focal()


def _tilts(tilt: ArrayLike | None) -> Tilts | None:
    if tilt is None:
        return None
    angles = np.asarray(tilt, dtype=np.float64)
    if angles.shape not in ((2,), (2, 2)) or not np.isfinite(angles).all():
        raise ArgumentError(f"tilt must be (psi, theta) or one such pair a picture, finite, not {tilt!r}")
    (psi1, theta1), (psi2, theta2) = np.broadcast_to(angles, (2, 2)).tolist()
    return (psi1, theta1), (psi2, theta2)


def _check(
    solver: str,
    tilts: Tilts | None,
    distortion: float | None,
    threshold: float,
    confidence: float,
    iterations: int,
) -> None:
    if solver not in SOLVERS:
        raise ArgumentError(f"unknown solver {solver!r}; choose one of {', '.join(SOLVERS)}")
    if solver == "two_point" and tilts is None:
        raise ArgumentError("the two_point solver needs the tilt")
    if distortion is not None and solver != "auto":
        raise ArgumentError(f"with known distortion there is nothing to choose; leave out solver={solver!r}")
    if distortion is not None and not -1.0 < distortion < 1.0:
        raise ArgumentError(f"distortion must lie between -1 and 1, not {distortion}")
    if not threshold > 0.0 or not 0.0 < confidence < 1.0 or iterations < 1:
        raise ArgumentError("threshold and max_iterations must be positive, confidence between 0 and 1")


def _solvers(name: str, camera: Camera, tilts: Tilts | None, distortion: float | None) -> list[MinimalSolver]:
    solvers = minimal_solvers(_focal(camera), camera.focal_log_std, tilts, distortion)
    if name == "auto":
        return [s for s in solvers if s.name != _AUTO_LEAVES_OUT]
    if name == "three_point" and tilts is not None:
        solvers = minimal_solvers(_focal(camera), camera.focal_log_std, None, distortion)
    return [s for s in solvers if s.name == name]


def _models(camera: Camera, tilts: Tilts | None) -> list[PairModel]:
    focal, std = _focal(camera), camera.focal_log_std
    planar = [PlanarModel(focal, std, tilts, height_free=free) for free in (False, True)]
    return [*planar, HomographyModel()]


def _focal(camera: Camera) -> float:
    """Focal length in half diagonals."""
    assert camera.focal is not None
    return camera.focal / camera.half_diagonal


def _result(
    chosen: Selection, search: Search, found: Hypothesis, camera1: Camera, camera2: Camera, threshold: float
) -> RadialHomography:
    fit, model = chosen.fit, chosen.fit.model
    camera1 = replace(camera1, distortion=fit.distortion, distortion_std=chosen.distortion_std)
    if not search.confident:
        reason = f"{chosen.reason}; the search stopped at its limit of samples before it was confident"
    else:
        reason = chosen.reason
    return RadialHomography(
        homography=fit.homography / np.cbrt(np.linalg.det(fit.homography)),
        camera=camera1,
        camera2=camera1.resized(camera2.image_size),
        inliers=fit.errors < threshold,
        covariance=chosen.covariance,
        distortion_std=chosen.distortion_std,
        model=model.name,
        motion=model.motion(fit.state) if isinstance(model, PlanarModel) else None,
        rms=rms_of(fit.errors, threshold),
        solver=found.solver,
        iterations=search.iterations,
        reason=reason,
    )
