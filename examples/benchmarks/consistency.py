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

import numpy as np
from scipy.optimize import least_squares

import rdstitch
from examples.benchmarks.driver import processor_time, run
from examples.worlds.paths import drive_poses
from examples.worlds.turns import panorama_rotations, turning_sequence
from rdstitch.alignment import Alignment
from rdstitch.arrays import FloatArray
from rdstitch.errors import RdstitchError
from rdstitch.geometry.camera import Camera, points_over
from rdstitch.geometry.division_model import distort
from rdstitch.results.stitch_result import StitchResult
from rdstitch.synthetic import FisheyeLens, Photometry, RenderedSequence, bumps, grid_poses, ground, sequence_over
from rdstitch.synthetic.lenses import Lens, focal_length

SIZE = (320, 240)
HALF = 200.0
"""Half the diagonal, pixels."""

PHOTOMETRY = Photometry(noise=0.01)
OPTIONS = rdstitch.StitchOptions(workers=1, features=rdstitch.FeatureOptions(max_features=600))

KINDS = ("turn", "plane", "drive", "relief", "pair", "fisheye")


def camera(rng: np.random.Generator) -> Camera:
    """A phone or an action camera whose lens is not quite a division model with its centre in the middle."""
    distortion = rng.normal(0.0, 0.03) if rng.random() < 0.5 else rng.uniform(-0.3, -0.05)
    center = (np.array(SIZE) - 1.0) / 2.0 + rng.normal(0.0, 0.02, 2) * HALF
    return Camera(
        SIZE,
        distortion=float(distortion),
        distortion2=float(rng.normal(0.0, 0.03)),
        center=(float(center[0]), float(center[1])),
        focal=HALF * float(np.clip(rng.lognormal(math.log(1.2), 0.3), 0.7, 2.2)),
    )


def rendered(kind: str, seed: int) -> RenderedSequence:
    """Images of a kind."""
    rng = np.random.default_rng((seed, KINDS.index(kind)))
    lens: Lens = camera(rng)
    if kind == "turn":
        rotations = panorama_rotations(5, 0.55 * SIZE[0] / focal_length(lens), jitter=0.06, seed=seed)
        return turning_sequence(lens, rotations, seed=seed, photometry=PHOTOMETRY)
    if kind == "fisheye":
        focal = float(rng.uniform(150.0, 230.0))
        off = rng.normal(0.0, 0.02, 2) * HALF
        lens = FisheyeLens(SIZE, focal, offset=(float(off[0]), float(off[1])))
    if kind == "drive":
        tilt = tuple(rng.uniform(-0.12, 0.12, 2).tolist())
        poses = drive_poses(lens, "line", 7, overlap=0.7, heading=float(rng.uniform(-3.0, 3.0)), tilt=tilt)
    elif kind == "pair":
        poses = grid_poses(lens, 2, 1, overlap=0.35, yaw=0.3, seed=seed).shaken(seed=seed, height=0.1, tilt=0.05)
    else:
        poses = grid_poses(lens, 3, 2, overlap=0.5, yaw=0.2, shift=0.1, seed=seed)
        poses = poses.shaken(seed=seed, height=0.1, tilt=0.0 if kind == "relief" else 0.12)
    height = float(np.mean(poses.height)) * (0.03, 0.06)[seed % 2]
    relief = partial(bumps, seed=seed, height=height, width=80) if kind == "relief" else None
    return sequence_over(partial(ground, seed=seed), lens, poses, photometry=PHOTOMETRY, relief=relief, seed=seed)


def nearest_distortion(lens: Lens) -> float:
    """λ of the one-parameter lens nearest to another, as :attr:`Camera.nearest_distortion` is defined."""
    half = float(np.hypot(*lens.image_size)) / 2.0
    measured = (points_over(lens.image_size, 33) - lens.center) / half
    straight = (lens.undistort(measured * half + lens.center) - lens.center) / half
    seen = np.isfinite(straight).all(axis=1)

    def missed(parameters: FloatArray) -> FloatArray:
        distortion, scale = parameters
        return np.nan_to_num(distort(straight[seen] / scale, distortion) - measured[seen], nan=1.0).ravel()

    return float(least_squares(missed, (-0.1, 1.0)).x[0])


def errors(sequence: RenderedSequence, alignment: Alignment) -> dict[str, FloatArray]:
    """Errors of the numbers that were delivered, in their standard deviations."""
    result: dict[str, FloatArray] = {}
    if math.isfinite(alignment.distortion_std):
        off = alignment.distortion - nearest_distortion(sequence.lens)
        result["λ"] = np.array([abs(off) / max(alignment.distortion_std, 1e-9)])
    if alignment.focal is not None and alignment.focal_std is not None:
        true = focal_length(sequence.lens) / alignment.cameras[alignment.reference].scale
        result["focal length"] = np.array([abs(math.log(alignment.focal / true)) / alignment.length_std])
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
        variances = np.diag(poses.covariance[far])
        result["pose"] = np.abs(missed[variances > 0.0]) / np.sqrt(variances[variances > 0.0])
    return result


def main(*, sets: int = 8, first: int = 0, kind: str | None = None, verbose: bool = False) -> None:
    """Print a row for every kind and number."""
    every: dict[str, list[FloatArray]] = {}
    begun = processor_time()
    print(f"{'images':<9}{'number':<14}{'delivered':>10}{'mean':>8}{'largest':>9}")
    for name in KINDS if kind is None else (kind,):
        found: dict[str, list[FloatArray]] = {}
        for seed in range(first, first + sets):
            sequence = rendered(name, seed)
            recipe: Callable[..., StitchResult] = rdstitch.pano if name == "turn" else rdstitch.mosaic
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
                shown = ", ".join(f"{what} {value.max():.1f}" for what, value in here.items())
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


def _row(kind: str, what: str, values: list[FloatArray], sets: int) -> str:
    every = np.concatenate(values)
    return f"{kind:<9}{what:<14}{f'{len(values)} of {sets}':>10}{np.mean(every**2):>8.2f}{every.max():>9.1f}"


if __name__ == "__main__":
    run(main)
