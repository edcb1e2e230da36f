"""Fig. 9: trajectories *line*, *turn* and *parallel parking*, with and without adjustment, from each solver.

Each solver's plain RANSAC gives a motion for every pair of consecutive frames. Chained, they are the trajectory
without adjustment, and where the adjustment starts. Beside them stands what rdstitch does of its own.
"""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from examples.judging.trajectories import compare_trajectories
from examples.paper.common.drives import PATHS, Drive, drive, estimated_links
from examples.paper.common.plain_ransac import all_solvers, best_of
from examples.paper.common.report import Report, Settings, Table
from rdstitch.alignment import align
from rdstitch.alignment.least_squares.bundle_adjustment import (
    BundleAdjuster,
    BundleAdjustmentResult,
    FreeParameters,
    Parameters,
)
from rdstitch.alignment.least_squares.observations import Observations
from rdstitch.alignment.least_squares.priors import Priors
from rdstitch.alignment.motion_models import RIGID, YAW, X, Y
from rdstitch.alignment.result import PlanarPoses
from rdstitch.arrays import FloatArray
from rdstitch.geometry.camera import LENS_PARAMETERS
from rdstitch.geometry.planar_motion import PlanarMotion, rotation_from_tilt
from rdstitch.geometry.radial_homography import RadialHomography
from rdstitch.matching.links import Link
from rdstitch.robust.measurements import Measurements
from rdstitch.robust.minimal import MinimalSolver
from rdstitch.robust.priors import Prior
from rdstitch.trajectories.trajectory import Trajectory

RECIPE = "rdstitch as it is"

_ITERATIONS = 60  # of RANSAC, for each pair
_FOCAL_STD = 0.01
_LEFT_OUT = ("3 points, tilt given, height free", "5 points, Fitzgibbon (homlib)", "5 points, Wadenbäck (homlib)")


@dataclass(frozen=True)
class _Path:
    """A trajectory before and after adjustment, and what the adjustment took."""

    solver: str
    before: Trajectory
    after: Trajectory
    distortion_before: float
    distortion_after: float
    iterations: int | None


def run(settings: Settings) -> Report:
    """Errors of the trajectories and number of adjustment iterations."""
    frames = settings.count(6, 24, 107)
    drives = {name: drive(name, frames, seed=90 + k) for k, name in enumerate(PATHS)}
    paths = {name: _paths(d) for name, d in drives.items()}
    tables = tuple(_table(name, drives[name], paths[name]) for name in PATHS)

    def draw(figure: Any) -> None:
        for axes, (name, d) in zip(figure.subplots(1, len(drives)), drives.items(), strict=True):
            shown = {"truth": d.truth}
            for path in paths[name]:
                if path.solver in ("2 points, tilt given", "5 points"):
                    shown[f"{path.solver}, chained"] = path.before
                if path.solver == RECIPE:
                    shown["rdstitch, adjusted"] = path.after
            for k, (label, trajectory) in enumerate(shown.items()):
                x, y = trajectory.position.T
                axes.plot(x, y, label=label, linewidth=3.0 if k == 0 else 1.0)
            axes.set_title(name, fontsize=8)
            axes.set_aspect("equal", adjustable="datalim")
            axes.legend(fontsize=6)

    return Report(tables, draw)


def _paths(d: Drive) -> list[_Path]:
    """From each solver, and from the recipe."""
    solvers = [s for s in all_solvers(d.camera, d.tilt) if s.name not in _LEFT_OUT]
    return [*(_from_solver(d, s) for s in solvers), _recipe(d)]


def _from_solver(d: Drive, solver: MinimalSolver) -> _Path:
    cameras, found = d.blank_cameras, []
    for pair in d.pairs:
        if pair.image2 - pair.image1 == 1:
            data = Measurements.from_pixels(pair.points1, pair.points2, cameras[0], cameras[0])
            found.append(best_of(solver, data, _ITERATIONS, seed=pair.image1))
    lam = float(np.median([model[1] for model in found if model is not None]))
    identity = np.eye(3)
    homographies = np.array([identity if model is None else _focal_normalized(d, model[0]) for model in found])
    tilt = d.tilt if "tilt given" in solver.name else _median_tilt(homographies)
    before = _chained(homographies, tilt)
    adjusted = _adjusted(d, before, tilt, lam)
    after = Trajectory.from_poses(_plane_poses(adjusted.parameters.poses, float(adjusted.parameters.shared[2])))
    return _Path(solver.name, before, after, lam, float(adjusted.parameters.lens[0]), adjusted.iterations)


def _focal_normalized(d: Drive, homography: FloatArray) -> FloatArray:
    """From half diagonals to focal lengths."""
    assert d.camera.focal is not None
    k = np.array([d.camera.focal, d.camera.focal, d.camera.scale])
    normalized: FloatArray = homography * (k / k[:, None])
    return normalized


def _median_tilt(homographies: FloatArray) -> tuple[float, float]:
    psi, theta = np.median([PlanarMotion.from_homography(h).tilt for h in homographies], axis=0)
    return float(psi), float(theta)


def _chained(homographies: FloatArray, tilt: tuple[float, float]) -> Trajectory:
    """The pairs' motions, each taken as planar, one after the other."""
    normal = rotation_from_tilt(tilt)[:, 2]
    yaw, position = [0.0], [np.zeros(2)]
    for h in homographies:
        motion = PlanarMotion.from_homography(h, normal)
        c, s = np.cos(yaw[-1]), np.sin(yaw[-1])
        position.append(position[-1] + np.array([[c, s], [-s, c]]) @ motion.translation)
        yaw.append(yaw[-1] + motion.yaw)
    count = len(yaw)
    return Trajectory(np.arange(count), np.array(position), np.array(yaw), np.ones(count))


def _adjusted(d: Drive, start: Trajectory, tilt: tuple[float, float], distortion: float) -> BundleAdjustmentResult:
    """All frames adjusted with the rigid model from a trajectory, a tilt and a λ."""
    cameras, count = d.blank_cameras, len(start)
    assert d.camera.focal is not None
    focal = d.camera.focal / d.camera.scale
    natural = np.array([*tilt, np.log(focal)])
    poses = np.zeros((count, 6))
    poses[:, YAW], poses[:, [X, Y]] = start.yaw, start.position * focal
    links = [Link(p.image1, p.image2, p.points1, p.points2, _any_relation(d)) for p in d.pairs]
    focal_prior = Prior(((1.0, float(natural[2]), _FOCAL_STD),))
    known = replace(Priors.none(RIGID, count), shared=(Prior(), Prior(), focal_prior))
    free = FreeParameters.fixing(RIGID, count, [0], np.array([name == "distortion" for name in LENS_PARAMETERS]))
    adjuster = BundleAdjuster(RIGID, Observations.from_links(links, cameras), free, known)
    lens = np.zeros(len(LENS_PARAMETERS))
    lens[0] = distortion
    return adjuster.run(Parameters(poses, RIGID.shared_from_physical(natural), lens))


def _any_relation(d: Drive) -> RadialHomography:
    """What a link must carry; the adjustment looks at its points only."""
    return RadialHomography(np.eye(3), d.camera, d.camera, np.ones(0, dtype=np.bool_))


def _plane_poses(poses: FloatArray, log_focal: float) -> PlanarPoses:
    count = len(poses)
    return PlanarPoses(poses[:, YAW], poses[:, [X, Y]] / np.exp(log_focal), np.ones(count), np.zeros((count, 2)))


def _recipe(d: Drive) -> _Path:
    """Pairs by :func:`rdstitch.estimate_radial_homography`, all frames by :func:`rdstitch.alignment.align`."""
    links = estimated_links(d.pairs, d.blank_cameras[0])
    consecutive = [link.relation for link in links if link.image2 - link.image1 == 1]
    alignment = align(d.blank_cameras, links)
    homographies = np.array([_focal_normalized(d, relation.homography) for relation in consecutive])
    lam = float(np.median([relation.distortion for relation in consecutive]))
    before = _chained(homographies, _median_tilt(homographies))
    return _Path(RECIPE, before, Trajectory.from_alignment(alignment), lam, alignment.distortion, None)


def _table(name: str, d: Drive, paths: list[_Path]) -> Table:
    rows = []
    for path in paths:
        before, after = compare_trajectories(path.before, d.truth), compare_trajectories(path.after, d.truth)
        shares = [100.0 * error for error in (before.translation, after.translation)]
        turns = [float(np.degrees(error)) for error in (before.rotation, after.rotation)]
        drifts = [100.0 * error for error in (before.drift, after.drift)]
        off = [abs(lam - d.camera.distortion) for lam in (path.distortion_before, path.distortion_after)]
        rows.append((path.solver, *shares, *turns, *drifts, *off, path.iterations))
    header = (
        "solver", "translation, chained, %", "adjusted, %", "rotation, chained, °", "adjusted, °",
        "drift, chained, % of path", "adjusted, % of path", "λ error, median of pairs", "λ error, adjusted",
        "adjustment iterations",
    )  # fmt: skip
    return Table(
        f"Fig. 9: {name}, {len(d.poses)} frames, 0.5 px of noise, λ = {d.camera.distortion:g}", header, tuple(rows)
    )
