"""Links synthesised from known poses, for the tests of the global adjustment."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.spatial import KDTree

from rdstitch.alignment import Alignment, AlignmentOptions, align
from rdstitch.alignment.adjustment_problem import Fit, Problem
from rdstitch.alignment.least_squares.observations import Observations
from rdstitch.alignment.motion_models import LOG_HEIGHT, PSI, SIMILARITY, THETA, TILTING, YAW, X, Y
from rdstitch.alignment.starts import fit_model
from rdstitch.arrays import FloatArray
from rdstitch.choices import FocalSource
from rdstitch.geometry.camera import Camera
from rdstitch.geometry.radial_homography import RadialHomography
from rdstitch.matching.links import Link


@dataclass(frozen=True)
class Scene:
    """What the adjustment is given, and the truth."""

    cameras: list[Camera]  # without λ
    links: list[Link]
    truth: FloatArray  # true plane-to-image homographies; shape (N, 3, 3)
    poses: FloatArray  # true poses in the columns of the planar models; shape (N, 6)
    distortion: float


def grid(columns: int, rows: int, step: tuple[float, float], yaw: float, rng: np.random.Generator) -> FloatArray:
    """Poses (N, 6) over a grid, with jitter of the position and any yaw up to ``yaw``, radians."""
    poses = np.zeros((columns * rows, 6))
    x, y = np.meshgrid(np.arange(columns), np.arange(rows))
    poses[:, X] = x.ravel() * step[0] + rng.uniform(-0.1, 0.1, len(poses)) * step[0]
    poses[:, Y] = y.ravel() * step[1] + rng.uniform(-0.1, 0.1, len(poses)) * step[1]
    poses[:, YAW] = rng.uniform(-yaw, yaw, len(poses))
    return poses


def robot_path(count: int, step: float) -> FloatArray:
    """Poses (N, 6) along a line, a turn and a parallel-parking path, ``step`` heights apart."""
    s = np.linspace(0.0, 1.0, count)
    heading = np.where(s < 0.4, 0.0, np.where(s < 0.6, (s - 0.4) / 0.2 * np.pi / 2, np.pi / 2))
    heading = heading + np.where(s > 0.6, 0.5 * np.sin((s - 0.6) / 0.4 * 2 * np.pi), 0.0)
    poses = np.zeros((count, 6))
    poses[:, YAW] = -heading
    poses[1:, X] = np.cumsum(np.cos(heading[:-1]) * step)
    poses[1:, Y] = np.cumsum(np.sin(heading[:-1]) * step)
    return poses


def scene(
    poses: FloatArray,
    *,
    size: tuple[int, int] = (640, 480),
    focal: float = 520.0,
    distortion: float = -0.25,
    lens: Camera | None = None,
    tilt: tuple[float, float] = (0.0, 0.0),
    noise: float = 0.3,
    outliers: float = 0.05,
    per_link: int = 200,
    overlap: float = 0.2,
    guess: float | None = None,
    focal_source: FocalSource | None = "option",
    rng: np.random.Generator,
    reach: int | None = None,
    relief: float = 0.0,
) -> Scene:
    """Links between all images whose overlap is at least ``overlap``, at most ``reach`` frames apart.

    Outliers are what a pairwise estimation lets pass: off by up to 4 px. ``relief`` is the amplitude of smooth hills,
    in heights above the plane. ``lens`` is taken instead of ``size`` and ``distortion``.
    """
    lens = lens or Camera(size, distortion=distortion)
    size, distortion = lens.image_size, lens.nearest_distortion
    ratio = focal / lens.scale
    shared = TILTING.shared_from_physical(np.array([*tilt, np.log(ratio)]))
    truth = TILTING.matrices(poses * [1, ratio, ratio, 1, 1 / ratio, 1 / ratio], shared).matrices
    cameras = [Camera(size, focal=guess or focal, focal_source=focal_source) for _ in poses]
    inverse = np.linalg.inv(truth)
    links = []
    near = KDTree(poses[:, [X, Y]]).query_pairs(3.0 * float(np.hypot(*size)) / focal)
    for i, j in sorted(near):
        if reach is not None and reach < j - i:
            continue
        h = truth[j] @ inverse[i]
        pixels = rng.uniform((0, 0), (size[0] - 1, size[1] - 1), (3 * per_link, 2))
        plane = _seen(inverse[i], lens, pixels)
        height = 1.0 + relief * np.sin(6 * plane[:, 0]) * np.cos(5 * plane[:, 1])
        p1, p2 = (_measured(truth[k], poses[k], lens, plane, height) for k in (i, j))
        inside = np.isfinite(p1).all(axis=1) & np.isfinite(p2).all(axis=1)
        inside &= (p1 >= 0).all(axis=1) & (p1 <= np.array(size) - 1).all(axis=1)
        inside &= (p2 >= 0).all(axis=1) & (p2 <= np.array(size) - 1).all(axis=1)
        if inside.mean() < overlap:
            continue
        p1, p2 = p1[inside][:per_link], p2[inside][:per_link]
        p1, p2 = p1 + rng.normal(0, noise, p1.shape), p2 + rng.normal(0, noise, p2.shape)
        wrong = rng.random(len(p1)) < outliers
        p2[wrong] += rng.uniform(-4, 4, (int(wrong.sum()), 2))
        links.append(Link(i, j, p1, p2, _relation(h, lens, distortion, len(p1), rng)))
    return Scene(cameras, links, truth, poses, distortion)


def grid_scene(
    columns: int,
    rows: int,
    step: tuple[float, float] = (0.4, 0.3),
    yaw: float = 0.2,
    *,
    wind: tuple[float, float] = (0.0, 0.0),
    seed: int,
    **options: Any,
) -> Scene:
    """A :func:`scene` over a :func:`grid`, by ``wind`` :func:`jittered`, by one generator of random numbers."""
    rng = np.random.default_rng(seed)
    poses = grid(columns, rows, step, yaw, rng)
    return scene(jittered(poses, *wind, rng) if any(wind) else poses, rng=rng, **options)


def _seen(inverse: FloatArray, lens: Camera, pixels: FloatArray) -> FloatArray:
    """Points of the plane (n, 2) at some measured pixels."""
    undistorted = lens.normalize(lens.undistort(pixels))
    lifted = np.column_stack([undistorted, np.ones(len(pixels))]) @ inverse.T
    seen: FloatArray = lifted[:, :2] / lifted[:, 2:]
    return seen


def _measured(matrix: FloatArray, pose: FloatArray, lens: Camera, plane: FloatArray, height: FloatArray) -> FloatArray:
    """Measured pixels (n, 2) of points over the plane; a point nearer to the camera moves away from its nadir."""
    shift = plane - pose[[X, Y]]
    raised = pose[[X, Y]] + shift * height[:, None]
    lifted = np.column_stack([raised, np.ones(len(plane))]) @ matrix.T
    projected = np.where(lifted[:, 2:] > 0, lifted[:, :2] / lifted[:, 2:], np.nan)
    return lens.distort(lens.denormalize(projected))


def _relation(
    homography: FloatArray, lens: Camera, distortion: float, count: int, rng: np.random.Generator
) -> RadialHomography:
    """What a pairwise estimate would say: near the truth, with its own error of λ."""
    std = 0.01
    camera = Camera(lens.image_size, distortion=distortion + std * rng.normal(), distortion_std=std)
    h = homography * (1.0 + 1e-3 * rng.normal(size=(3, 3)))
    return RadialHomography(
        h, camera, camera, np.ones(count, dtype=np.bool_), distortion_std=std, model="homography", rms=0.5
    )


def turn_links(
    lens: Camera, rotations: FloatArray, rng: np.random.Generator, noise: float = 0.2, count: int = 120
) -> list[Link]:
    """Links, with their true homographies, between all images that overlap of a camera that turns on the spot."""
    k = np.diag([(lens.focal or lens.scale) / lens.scale] * 2 + [1.0])
    links = []
    for i in range(len(rotations)):
        for j in range(i + 1, len(rotations)):
            h = k @ rotations[j] @ rotations[i].T @ np.linalg.inv(k)
            points = rng.uniform((0, 0), np.array(lens.image_size) - 1.0, (count, 2))
            flat = lens.normalize(lens.undistort(points))
            moved = np.column_stack([flat, np.ones(count)]) @ h.T
            moved[moved[:, 2] <= 0.05] = np.nan
            seen = lens.distort(lens.denormalize(moved[:, :2] / moved[:, 2:]))
            inside = ((seen >= 0) & (seen < lens.image_size)).all(axis=1)
            if inside.sum() < 20:
                continue
            noisy = [p[inside] + noise * rng.standard_normal((int(inside.sum()), 2)) for p in (points, seen)]
            relation = RadialHomography(h, lens, lens, np.ones(len(noisy[0]), dtype=np.bool_), distortion_std=0.01)
            links.append(Link(i, j, noisy[0], noisy[1], relation))
    return links


def jittered(poses: FloatArray, height: float, tilt: float, rng: np.random.Generator) -> FloatArray:
    """Poses of a drone in wind: heights by up to ±``height`` and normal tilts of ``tilt``, radians."""
    result = poses.copy()
    result[:, LOG_HEIGHT] = np.log1p(rng.uniform(-height, height, len(poses)))
    result[:, [PSI, THETA]] = rng.normal(0, tilt, (len(poses), 2))
    return result


def aligned(given: Scene, **options: object) -> Alignment:
    return align(given.cameras, given.links, AlignmentOptions(**options))  # type: ignore[arg-type]


def fitted(given: Scene) -> tuple[Problem, Fit]:
    """A scene as a problem, and the similarities that fit it."""
    observations = Observations.from_links(given.links, given.cameras)
    count = len(given.cameras)
    known = AlignmentOptions().camera_priors(given.cameras)
    homographies = np.stack([link.relation.homography for link in given.links])
    free = np.arange(5) == 0
    trust = np.ones(len(given.links))
    lens = np.array([given.distortion, 0.0, 0.0, 0.0, 0.0])
    problem = Problem(observations, homographies, lens, free, known, trust=trust, count=count, fixed=0)
    return problem, fit_model(problem, SIMILARITY)
