"""A robot's drives, live and offline side by side: ``python -m examples.benchmarks.robot``.

Rendered frames of 320 x 240 pixels from a tilted camera 0.4 m above a floor: as they are, with a bumper that stays in
the image, changing light, a poor floor, motion blur, a jump to a place seen before, lenses that are no division model
(given as ROS writes them), a focal length that is told 10 % too long, and an IMU whose time stamps are late. A row each
for :class:`rdstitch.Tracker` and :func:`rdstitch.trajectory`, over the drives of ``--count`` seeds: share of the frames
after the second that have a pose; root mean square error of the positions, as they are and after the best similarity
(ATE), millimetres; error of all lengths, and what was stated of that; squared error of the positions over their
variance, for a degree of freedom (NEES), and the same across the direction from the first frame, where the length that
all poses share does not matter; the largest error in standard deviations; processor time of a frame, median and 95 %.
False claims are positions or lengths more than five standard deviations off. The same frames give the same figures;
with ``--as-they-come`` ten frames come a second, and none waits for what is computed meanwhile.
"""

import json
import math
import time
from collections import defaultdict
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

import rdstitch
from examples.benchmarks.driver import run
from examples.worlds.paths import drive_poses
from rdstitch.arrays import FloatArray
from rdstitch.geometry.camera import Camera
from rdstitch.synthetic import BrownLens, FisheyeLens, Photometry, ground, sequence_over
from rdstitch.synthetic.lenses import Lens

SIZE, FOCAL, DISTORTION, HEIGHT = (320, 240), 190.0, -0.2, 0.4
TILT = (math.radians(7.0), math.radians(-4.0))
RATE = 10.0  # frames a second

Images = list[NDArray[np.uint8]]


@dataclass(frozen=True)
class Drive:
    """Frames, their truth, and what is told of the camera."""

    images: Images
    places: NDArray[np.complex128]  # (N,): m, x to the right and y to the bottom of the first image
    told: dict[str, Any]  # of StitchOptions
    files: dict[str, str] = field(default_factory=dict)  # of ``told`` that are files: their content


def drives(count: int, seed: int) -> "dict[str, Drive]":
    """All drives, by their names."""
    rng, middle = np.random.default_rng(seed), count // 2
    true = Camera(SIZE, DISTORTION, focal=FOCAL)
    # As a calibration gives it: right up to its standard deviation.
    told = FOCAL * (1.0 + 0.002 * rng.standard_normal())
    division = replace(true, focal=told, focal_source="file", focal_std=0.002 * FOCAL)
    plain = rendered(true, count, seed, {"camera": division, "tilt": TILT})
    body = np.kron(rng.integers(0, 255, (24, 32)), np.ones((10, 10))).astype(np.uint8)
    bumper = [np.where(np.arange(240)[:, None] < 190, image, body) for image in plain.images]
    light = [_lit(image, 0.6 + 0.4 * math.sin(0.9 * k), k) for k, image in enumerate(plain.images)]
    poor = [_noisy(120.0 + 0.12 * (image - 120.0), 1.0, rng) for image in plain.images]
    blurred = [
        np.asarray(cv2.blur(image, (9, 3)), np.uint8) if k % 4 == 3 else image for k, image in enumerate(plain.images)
    ]
    back = [*range(middle), *range(middle // 2, count - middle // 2)]  # the robot is put where it was before
    brown = BrownLens(SIZE, 1.15 * FOCAL, offset=(-2.5, 3.0), k1=-0.29, k2=0.09, p1=-0.0009, p2=0.0008, k3=-0.0135)
    fisheye = FisheyeLens(SIZE, 0.9 * FOCAL)
    return {
        "plain": plain,
        "no tilt told": replace(plain, told={"camera": division}),
        "no camera told": replace(plain, told={}),
        "bumper": replace(plain, images=bumper, told={"camera": division}),
        "light": replace(plain, images=light),
        "poor floor": replace(plain, images=poor),
        "blur": replace(plain, images=blurred),
        "jump": replace(plain, images=[plain.images[k] for k in back], places=plain.places[back]),
        "plumb_bob": rendered(brown, count, seed, {"tilt": TILT}, plumb_bob=(-0.29, 0.09, -0.0009, 0.0008, -0.0135)),
        "equidistant": rendered(fisheye, count, seed, {"tilt": TILT}, equidistant=(0.0, 0.0, 0.0, 0.0)),
        "focal + 10 %": replace(plain, told={"distortion": DISTORTION, "focal": 1.1 * FOCAL}),
        "late IMU": swaying(true, division, count, seed),
    }


def rendered(
    lens: Lens, count: int, seed: int, told: dict[str, Any], tilts: FloatArray | None = None, **model: tuple[float, ...]
) -> Drive:
    """A drive through a right angle; ``model``: the lens's coefficients by ROS's name of it, for a camera_info.yaml.

    That states no accuracy of the focal length, which is therefore taken for 1 %.
    """
    poses = drive_poses(lens, "turn", count, overlap=0.88, heading=0.3, tilt=TILT)
    poses = poses if tilts is None else replace(poses, tilt=tilts)
    photometry = Photometry(noise=0.008, blur=0.5)
    sequence = sequence_over(partial(ground, seed=seed), lens, poses, photometry=photometry, seed=seed)
    images = [cv2.cvtColor(sequence.frame(k), cv2.COLOR_RGB2GRAY).astype(np.uint8) for k in range(count)]
    turn = np.exp(1j * poses.yaw[0]) * HEIGHT / poses.height[0]
    places = turn * ((poses.position - poses.position[0]) @ [1.0, 1.0j])
    files = {}
    for name, d in model.items():
        assert lens.focal is not None
        f, (cx, cy) = lens.focal * (1.0 + 0.01 * np.random.default_rng(seed).standard_normal()), lens.center
        record = {"width": SIZE[0], "height": SIZE[1], "distortion_model": name, "d": d}
        files["camera"] = json.dumps(record | {"k": [f, 0.0, cx, 0.0, f, cy, 0.0, 0.0, 1.0]})
    return Drive(images, places, told, files)


def swaying(lens: Camera, told: Camera, count: int, seed: int) -> Drive:
    """A robot on soft wheels, and what its IMU measures at its own rate, 30 ms late."""
    late, exact = 0.03, math.radians(0.1)

    def tilt(time: FloatArray) -> FloatArray:
        sway = 0.03 * np.stack([np.sin(4.1 * time), np.cos(3.3 * time)], axis=-1)
        return np.asarray(np.array(TILT) + sway)

    times, rng = np.arange(-0.2, count / RATE + 0.2, 0.013), np.random.default_rng(seed)
    measured = np.degrees(tilt(times) + rng.normal(0.0, exact, (len(times), 2)))
    rows = "".join(f"{t + late:.6f},{psi:.5f},{theta:.5f}\n" for t, (psi, theta) in zip(times, measured, strict=True))
    known = {"camera": told, "tilt": (0.0, 0.0), "attitude_std": exact}
    drive = rendered(lens, count, seed, known, tilt(np.arange(count) / RATE))
    frame_times = "".join(f"{k / RATE}\n" for k in range(count))
    return replace(drive, files={"attitude": f"timestamp,psi,theta\n{rows}", "timestamps": frame_times})


def _lit(image: NDArray[np.uint8], gain: float, k: int) -> NDArray[np.uint8]:
    """Under a lamp that flickers and a light that comes from one side."""
    side = 1.0 + 0.3 * np.cos(0.5 * k) * np.linspace(-1.0, 1.0, image.shape[1])
    return np.asarray(np.clip(image * gain * side, 0, 255), dtype=np.uint8)


def _noisy(image: NDArray[np.floating[Any]], std: float, rng: np.random.Generator) -> NDArray[np.uint8]:
    return np.clip(image + rng.normal(0.0, std, image.shape), 0, 255).astype(np.uint8)


@dataclass(frozen=True)
class Outcome:
    """Positions of some frames of a drive, with what was stated of them."""

    frames: list[int]
    places: NDArray[np.complex128]  # m, as the truth has them
    covariances: FloatArray  # (N, 2, 2)
    length_std: float
    messages: list[str]
    spent: list[float] = field(default_factory=list)  # s a frame


def live(drive: Drive, options: rdstitch.StitchOptions, *, as_they_come: bool) -> Outcome:
    """What the tracker says of each frame when it has come, or last; the first as soon as it has a place."""
    tracker = rdstitch.Tracker(options, rdstitch.FollowedPoses(HEIGHT, "camera"), patient=not as_they_come)
    poses, spent, begun = dict[int, rdstitch.Pose](), list[float](), time.monotonic()
    for k, image in enumerate(drive.images):
        if as_they_come:
            time.sleep(max(begun + k / RATE - time.monotonic(), 0.0))
        start = time.thread_time()
        pose = tracker.add(image, k / RATE)
        spent.append(time.thread_time() - start)
        poses |= {known.number: known for known in (*tracker.revised, pose) if known and known.map == 0}
    poses |= {known.number: known for known in tracker.finish() if known and known.map == 0}
    frames = sorted(poses)
    given = [poses[k] for k in frames]
    places = np.array([complex(*pose.position[:2]) for pose in given if pose.position is not None])
    none = np.full((4, 4), np.nan)
    covariances = np.array([none if pose.covariance is None else pose.covariance for pose in given]).reshape(-1, 4, 4)
    stated = given[-1].length_std if given else math.nan
    return Outcome(frames, places, covariances[:, :2, :2], stated, [m.text for m in tracker.messages], spent)


def offline(drive: Drive, options: rdstitch.StitchOptions) -> Outcome:
    """What a run over all frames says."""
    try:
        path, registration = rdstitch.trajectory(drive.images, options=options, height=HEIGHT)
    except rdstitch.RdstitchError as error:
        return Outcome([], np.zeros(0, dtype=np.complex128), np.zeros((0, 2, 2)), math.nan, [str(error)])
    covariance = np.zeros((len(path), 4, 4)) if path.covariance is None else path.covariance
    places, said = path.position @ np.array([1.0, 1.0j]), [message.text for message in registration.warnings]
    return Outcome(path.frame.tolist(), places, covariance[:, :2, :2], registration.alignment.length_std, said)


@dataclass(frozen=True)
class Figures:
    """How good the poses of a drive are, and what was stated of them."""

    share: float  # of the frames after the second that have a pose
    rms: float = math.nan  # rms, ate: of the positions, m; ate after the best similarity
    ate: float = math.nan
    scale: float = math.nan  # relative error of all lengths
    length_std: float = math.nan
    nees: float = math.nan  # a degree of freedom
    across: float = math.nan  # the same across the direction from the first frame, where all lengths do not matter
    worst: float = math.nan  # standard deviations
    false: int = 0

    @classmethod
    def of(cls, drive: Drive, outcome: Outcome) -> "Figures":
        """Of the outcome of a drive."""
        share = len([k for k in outcome.frames if k > 1]) / (len(drive.images) - 2)
        if len(outcome.frames) < 3:
            return cls(share)
        truth = drive.places[outcome.frames]
        errors = outcome.places - truth
        found, true = outcome.places - outcome.places.mean(), truth - truth.mean()
        factor = np.vdot(found, true) / np.vdot(found, found)
        ate, scale = float(np.sqrt(np.mean(abs(factor * found - true) ** 2))), 1.0 / abs(factor) - 1.0
        sure = np.linalg.eigvalsh(outcome.covariances)[:, 0] > 1e-18
        known = outcome.covariances[sure]
        pairs = np.stack([errors.real, errors.imag], axis=-1)[sure]
        nees = np.einsum("ni,ni->n", pairs, np.linalg.solve(known, pairs[..., None])[..., 0]) / 2.0
        aside = 1j * outcome.places[sure] / np.maximum(abs(outcome.places[sure]), 1e-12)
        aside_pairs = np.stack([aside.real, aside.imag], axis=-1)
        across = (aside_pairs * pairs).sum(axis=-1) ** 2 / np.einsum("ni,nij,nj->n", aside_pairs, known, aside_pairs)
        false = int((np.sqrt(2.0 * nees) > 5.0).sum()) + int(abs(scale) > 5.0 * outcome.length_std)
        rms, worst = float(np.sqrt(np.mean(abs(errors) ** 2))), float(np.sqrt(2.0 * nees.max(initial=0.0)))
        means = float(np.mean(nees)), float(np.mean(across))
        return cls(share, rms, ate, scale, outcome.length_std, *means, worst, false)


def row(figures: Sequence[Figures], spent: Sequence[float]) -> str:
    """Of several drives: means of the share and of what is in standard deviations, else root mean squares."""

    def rms(name: str) -> float:
        return float(np.sqrt(np.mean([getattr(one, name) ** 2 for one in figures])))

    def mean(name: str) -> float:
        return float(np.mean([getattr(one, name) for one in figures]))

    p50, p95 = np.percentile(spent, [50, 95]) * 1e3 if spent else (math.nan, math.nan)
    lengths = f"{1e3 * rms('rms'):7.2f} {1e3 * rms('ate'):7.2f} {rms('scale'):7.2%} {rms('length_std'):7.2%}"
    sureness = f"{mean('nees'):6.2f} {mean('across'):6.2f} {max(one.worst for one in figures):6.1f}"
    return f"{mean('share'):5.0%} {lengths} {sureness} {p50:6.1f} {p95:6.1f}"


def main(
    *,
    frames: int = 40,
    seed: int = 1,
    count: int = 1,
    only: str = "",
    skip_offline: bool = False,
    as_they_come: bool = False,
) -> None:
    """Print the table, each row over the drives of so many seeds."""
    cv2.setNumThreads(1)
    recipes: dict[str, Callable[[Drive, rdstitch.StitchOptions], Outcome]]
    recipes = {"live": partial(live, as_they_come=as_they_come), "offline": offline}
    if skip_offline:
        del recipes["offline"]
    figures = defaultdict[tuple[str, str], list[Figures]](list)
    spent, messages = defaultdict[tuple[str, str], list[float]](list), defaultdict[tuple[str, str], list[str]](list)
    for number in range(seed, seed + count):
        for name, drive in drives(frames, number).items():
            if only not in name:
                continue
            with TemporaryDirectory() as folder:
                told = dict(drive.told)
                for option, content in drive.files.items():
                    told[option] = Path(folder, "camera_info.yaml" if option == "camera" else f"{option}.csv")
                    told[option].write_text(content, encoding="utf-8")
                options = rdstitch.StitchOptions(workers=1, **told)
                for kind, recipe in recipes.items():
                    outcome = recipe(drive, options)
                    figures[name, kind].append(Figures.of(drive, outcome))
                    spent[name, kind] += outcome.spent
                    messages[name, kind] += outcome.messages
    print(f"{'drive':15}{'':8} poses     rms     ATE   scale  stated   NEES across  worst    p50    p95")
    for (name, kind), some in figures.items():
        print(f"{name:15}{kind:8} {row(some, spent[name, kind])}")
        for message in dict.fromkeys(messages[name, kind]):
            print(f"    {message}")
    wrong = sum(one.false for some in figures.values() for one in some)
    print(f"false claims (beyond five standard deviations): {wrong}")


if __name__ == "__main__":
    run(main)
