"""Whether the ± of numbers holds: ``python -m examples.benchmarks.consistency [--sets N] [--first K] [--kind …]``.

Small images are rendered with known cameras and registered: turns on the spot, planes seen by hand, straight drives,
hills of 3 and 6 % of the height, pairs of little overlap, and equidistant fisheyes. Of λ (of the one-parameter lens
nearest to the true one), of the focal length, and of the pose of the image farthest from the reference, the squared
error over its variance is added up. Printed a row: sets, those that delivered the number, the mean a degree of
freedom, and the largest error in standard deviations. Right is a mean of 0.5 to 2, and no error beyond 5.
"""

import math
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Literal

import numpy as np
from scipy.optimize import least_squares

import rdstitch
from examples.benchmarks.driver import processor_time, run
from rdstitch.alignment import Alignment
from rdstitch.arrays import FloatArray
from rdstitch.errors import RdstitchError
from rdstitch.geometry.camera import Camera, points_over
from rdstitch.geometry.division_model import distort
from rdstitch.synthetic import (
    FisheyeLens,
    Photometry,
    Sequence,
    drive_poses,
    grid_poses,
    ground,
    hills,
    panorama_rotations,
    sequence_over,
    turning_sequence,
)
from rdstitch.synthetic.lenses import Lens

SIZE = (320, 240)
PHOTOMETRY = Photometry(noise=0.01)
OPTIONS = rdstitch.StitchOptions(workers=1, features=rdstitch.FeatureOptions(max_features=600))

Kind = Literal["turn", "plane", "drive", "relief", "pair", "fisheye"]
KINDS: tuple[Kind, ...] = ("turn", "plane", "drive", "relief", "pair", "fisheye")


def camera(rng: np.random.Generator) -> Camera:
    """A phone or an action camera."""
    distortion = rng.normal(0.0, 0.03) if rng.random() < 0.5 else rng.uniform(-0.3, -0.05)
    return Camera(SIZE, distortion=float(distortion), focal=float(rng.uniform(0.9, 1.6)) * 200.0)


def rendered(kind: Kind, seed: int) -> Sequence:
    """Images of a kind."""
    rng = np.random.default_rng((seed, KINDS.index(kind)))
    lens: Lens = camera(rng)
    if kind == "turn":
        rotations = panorama_rotations(5, 0.55 * SIZE[0] / float(lens.focal or 1.0), jitter=0.06, seed=seed)
        return turning_sequence(lens, rotations, seed=seed, photometry=PHOTOMETRY)
    if kind == "fisheye":
        lens = FisheyeLens(SIZE, float(rng.uniform(150.0, 230.0)))
    if kind == "drive":
        tilt = tuple(rng.uniform(-0.12, 0.12, 2).tolist())
        poses = drive_poses(lens, "line", 7, overlap=0.7, heading=float(rng.uniform(-3.0, 3.0)), tilt=tilt)
    elif kind == "pair":
        poses = grid_poses(lens, 2, 1, overlap=0.35, yaw=0.3, seed=seed).shaken(seed=seed, height=0.1, tilt=0.05)
    else:
        poses = grid_poses(lens, 3, 2, overlap=0.5, yaw=0.2, shift=0.1, seed=seed)
        poses = poses.shaken(seed=seed, height=0.1, tilt=0.0 if kind == "relief" else 0.12)
    height = float(np.mean(poses.height)) * (0.03, 0.06)[seed % 2]
    relief = partial(hills, seed=seed, height=height, width=80) if kind == "relief" else None
    return sequence_over(partial(ground, seed=seed), lens, poses, photometry=PHOTOMETRY, relief=relief, seed=seed)


def nearest_distortion(lens: Lens) -> float:
    """λ of the one-parameter lens nearest to another, as :attr:`Camera.nearest_distortion` is defined."""
    half = math.hypot(*lens.image_size) / 2.0
    measured = (points_over(lens.image_size, 33) - lens.center) / half
    straight = (lens.undistort(measured * half + lens.center) - lens.center) / half
    seen = np.isfinite(straight).all(axis=1)

    def missed(parameters: FloatArray) -> FloatArray:
        distortion, scale = parameters
        return np.nan_to_num(distort(straight[seen] / scale, distortion) - measured[seen], nan=1.0).ravel()

    return float(least_squares(missed, (-0.1, 1.0)).x[0])


def errors(sequence: Sequence, alignment: Alignment) -> dict[str, tuple[float, int]]:
    """Squared normalized error of each number that was delivered, and its degrees of freedom."""
    result: dict[str, tuple[float, int]] = {}
    if math.isfinite(alignment.distortion_std):
        off = alignment.distortion - nearest_distortion(sequence.lens)
        result["λ"] = (off / max(alignment.distortion_std, 1e-9)) ** 2, 1
    if alignment.focal is not None and alignment.focal_std is not None:
        true = sequence.lens.focal / alignment.cameras[alignment.reference].scale
        result["focal length"] = (math.log(alignment.focal / true) / alignment.length_std) ** 2, 1
    poses = alignment.poses
    if poses is not None and poses.covariance is not None:
        far = int(np.nanargmax(np.linalg.norm(poses.position, axis=1)))
        level = replace(sequence.poses, tilt=np.zeros_like(sequence.poses.tilt))
        motion = level.motion(alignment.reference, far)
        missed = np.array(
            [
                *(poses.position[far] - motion.translation),
                poses.height[far] - motion.height,
                np.remainder(poses.yaw[far] - motion.yaw + np.pi, 2.0 * np.pi) - np.pi,
            ]
        )
        covariance = poses.covariance[far]
        free = np.flatnonzero(np.diag(covariance) > 0.0)
        held = covariance[np.ix_(free, free)]
        result["pose"] = float(missed[free] @ np.linalg.solve(held, missed[free])), len(free)
    return result


def main(*, sets: int = 8, first: int = 0, kind: Kind | None = None, verbose: bool = False) -> None:
    """Print a row for every kind and number."""
    every: dict[str, list[tuple[float, int]]] = {}
    begun = processor_time()
    print(f"{'images':<9}{'number':<14}{'delivered':>10}{'mean':>8}{'largest':>9}")
    for name in KINDS if kind is None else (kind,):
        found: dict[str, list[tuple[float, int]]] = {}
        for seed in range(first, first + sets):
            sequence = rendered(name, seed)
            recipe: Callable[..., object] = rdstitch.pano if name == "turn" else rdstitch.mosaic
            options = replace(OPTIONS, pose_covariance=name != "turn")
            try:
                stitched = recipe([sequence.frame(k) for k in range(len(sequence))], None, options)
            except RdstitchError as error:
                if verbose:
                    print(name, seed, error)
                continue
            alignment = stitched.registration.alignment
            here = errors(sequence, alignment)
            if verbose:
                shown = ", ".join(f"{what} {math.sqrt(value / of):.1f}" for what, (value, of) in here.items())
                print(
                    f"{name} {seed}: {alignment.model}, {alignment.lens}, λ {alignment.distortion:+.4f} ± "
                    f"{alignment.distortion_std:.4f} ({nearest_distortion(sequence.lens):+.4f}); {shown}",
                    flush=True,
                )
            for what, value in here.items():
                found.setdefault(what, []).append(value)
                every.setdefault(what, []).append(value)
        for what, values in found.items():
            print(_row(name, what, values, sets), flush=True)
    for what, values in every.items():
        print(_row("all", what, values, sets * (len(KINDS) if kind is None else 1)))
    print(f"{processor_time() - begun:.0f} s of processor time")


def _row(kind: str, what: str, values: list[tuple[float, int]], sets: int) -> str:
    squared, freedom = np.array(values).T
    mean, largest = squared.sum() / freedom.sum(), math.sqrt(float((squared / freedom).max()))
    return f"{kind:<9}{what:<14}{f'{len(values)} of {sets}':>10}{mean:>8.2f}{largest:>9.1f}"


if __name__ == "__main__":
    run(main)
