"""Random rendered image sets, solvable and hopeless ones, and whether what was made of them is right."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from itertools import permutations
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from examples import judging
from examples.worlds.adverse_sets import ADVERSE, AlteredSequence, adverse_set
from rdstitch.arrays import FloatArray
from rdstitch.errors import RdstitchError
from rdstitch.features import FeatureOptions
from rdstitch.geometry.camera import Camera
from rdstitch.options.stitch_options import StitchOptions
from rdstitch.pipeline.recipes import mosaic
from rdstitch.results.registration import Registration
from rdstitch.synthetic import (
    BrownLens,
    Lens,
    Photometry,
    Poses,
    RenderedSequence,
    Texture,
    gradient,
    grid_poses,
    ground,
    pair_poses,
    repeated,
    sequence_over,
)

SOLVABLE = ("pair", "chain", "grid")
ODD = ("odd lens",)
"""Solvable too, but only where asked for: the images of one lens that is no division model about their centre."""

SPOILED = ("spoiled",)
"""Ten images of which one to three show other ground or a repeated pattern, were zoomed, have a truncated file or one
with flipped bits, are blurred, noisy or taken aslant: solved from the rest. Those that are blurred, noisy or aslant are
used rightly, or named; all others are named."""

HOPELESS = (
    "apart", "textureless", "repeated", "turning", "mixed lenses", "mixed by one", "little overlap", "mixed ground"
)  # fmt: skip

OTHERS = ((1.15, 0.0), (1.4, 0.0), (1.0, 0.05), (1.0, 0.1), (1.0, 0.2))
"""Other lenses: their focal length in units of the first lens's, and how far λ differs beyond what the zoom does."""

MAX_MEDIAN, MAX_OF_AN_IMAGE = 1.5, 4.0
"""px of the images: more is a wrong registration."""


@dataclass(frozen=True)
class MixedSequence(RenderedSequence):
    """Images of one plane of which some were taken with another lens, or show other ground."""

    other: RenderedSequence | None = None  # the same poses with what else there is
    taken: frozenset[int] = frozenset()  # images that come from ``other``
    usable: bool = False  # whether these may be registered rightly with the rest
    damaged: bool = False  # whether their files are cut off or have flipped bits

    def write(self, folder: str | Path, name: str = "frame_{:04d}.png") -> list[Path]:
        paths = super().write(folder, name)
        rng = np.random.default_rng((self.seed, 78))
        for index in sorted(self.taken) if self.damaged else ():
            data = bytearray(paths[index].read_bytes())
            if rng.random() < 0.5:
                data = data[: int(rng.uniform(0.05, 0.95) * len(data))]
            else:
                for place in rng.integers(len(data) // 20, len(data) - 20, 8).tolist():
                    data[place] ^= 1 << int(rng.integers(8))
            paths[index].write_bytes(data)
        return paths

    def _of(self, index: int) -> RenderedSequence:
        own = RenderedSequence(self.texture, self.lens, self.poses, self.photometry, seed=self.seed)
        return self.other if index in self.taken and self.other is not None else own

    def to_plane(self, index: int, points: ArrayLike) -> FloatArray:
        return self._of(index).to_plane(index, points)

    def to_image(self, index: int, points: ArrayLike) -> FloatArray:
        return self._of(index).to_image(index, points)

    def frame(self, index: int) -> np.ndarray:
        return self._of(index).frame(index)


@dataclass(frozen=True)
class TrustSet:
    kind: str  # one of :data:`SOLVABLE`, :data:`ODD`, :data:`HOPELESS` or :data:`examples.worlds.adverse_sets.ADVERSE`
    sequence: RenderedSequence


@dataclass(frozen=True)
class Judged:
    """What became of a set."""

    kind: str
    status: int  # that the command line would have ended with
    right: bool  # whether the registration of all images used agrees with the truth; True without one
    complete: bool  # whether every image was used that is needed
    error: float  # median error, px
    text: str  # what the user would have read
    warned: bool = False  # whether a warning names the place, or a decision that the user has to judge
    warnings: tuple[str, ...] = ()  # codes of the warnings that are printed without ``-v``


def trust_set(seed: int, kind: str | None = None) -> TrustSet:
    """A random set of a kind; of a random one if not given, half of them solvable."""
    if kind in ADVERSE:
        return TrustSet(kind, adverse_set(kind, seed))
    rng = np.random.default_rng((seed, 77))
    if kind is None:
        kind = str(rng.choice(SOLVABLE if rng.random() < 0.5 else HOPELESS))
    size = (400, 300) if rng.random() < 0.7 else (520, 390)
    lens = Camera(size, distortion=float(rng.uniform(-0.35, 0.05)), focal=float(rng.uniform(0.8, 1.6) * size[0]))
    tilt = (float(rng.uniform(-0.12, 0.12)), float(rng.uniform(-0.12, 0.12)))
    photometry = Photometry(float(rng.uniform(0.8, 1.1)), float(rng.uniform(0.0, 0.3)), noise=0.012)
    taken_with = _odd_lens(lens, rng) if kind in ODD else lens
    poses = _poses(kind, taken_with, tilt, rng, seed)
    plane: Callable[[tuple[int, int]], Texture] = partial(ground, seed=seed)
    if kind == "textureless":
        plane = gradient
    elif kind == "repeated":
        plane = partial(repeated, seed=seed, period=int(rng.integers(48, 140)))
    sequence = sequence_over(plane, taken_with, poses, photometry=photometry, seed=seed, margin=60)
    if kind.startswith("mixed") or kind in SPOILED:
        sequence = _mixed(kind, sequence, rng, seed)
    return TrustSet(kind, sequence)


def _odd_lens(lens: Camera, rng: np.random.Generator) -> Lens:
    """Much the same lens, with its axis off the centre of the image, or with a profile of another kind."""
    kind = int(rng.integers(3))
    if kind == 0:
        x, y = np.array(lens.center) + lens.scale * rng.normal(0.0, 0.02, 2)
        return replace(lens, center=(float(x), float(y)))
    if kind == 1:
        return replace(lens, distortion2=float(rng.uniform(-0.08, 0.08)))
    square = (lens.focal / lens.scale) ** 2
    k2 = float(rng.uniform(-0.01, 0.03)) * square**2
    p1, p2 = rng.uniform(-0.002, 0.002, 2).tolist()
    return BrownLens(lens.image_size, lens.focal, k1=0.4 * lens.distortion * square, k2=k2, p1=p1, p2=p2)


def _poses(kind: str, lens: Lens, tilt: tuple[float, float], rng: np.random.Generator, seed: int) -> Poses:
    turn, direction = float(rng.uniform(-0.6, 0.6)), float(rng.uniform(0.0, 2.0 * np.pi))
    overlap = float(rng.uniform(0.35, 0.65))
    if kind in ("pair", "textureless"):
        return pair_poses(lens, overlap, yaw=turn, direction=direction, tilt=tilt)
    if kind == "apart":
        return pair_poses(lens, -0.3, yaw=turn, direction=direction, tilt=tilt)
    if kind == "little overlap":
        return pair_poses(lens, float(rng.uniform(0.02, 0.15)), yaw=turn, direction=direction, tilt=tilt)
    if kind == "turning":
        # About the optical axis nothing can be seen of λ; about the plane's normal something can.
        about_axis = rng.random() < 0.5
        yaw = float(rng.uniform(0.05, 0.5)) * np.arange(3)
        return Poses.of(np.zeros((3, 2)), lens.focal, yaw, (0.0, 0.0) if about_axis else tilt)
    columns, rows = (4, 1) if kind == "chain" else (2, 2) if kind == "grid" else (3, 1)
    if kind == "mixed lenses":
        columns, rows = 5, 1
    elif kind in SPOILED:
        columns, rows = 5, 2
    elif kind in ("mixed by one", *ODD):
        columns, rows = 2 + seed % 4, 1
    return grid_poses(lens, columns, rows, overlap=overlap, yaw=0.2, shift=0.05, tilt=tilt, seed=seed)


def _mixed(kind: str, sequence: RenderedSequence, rng: np.random.Generator, seed: int) -> MixedSequence:
    """Some images through another lens (a zoom), or over other ground."""
    lens, usable, damaged = sequence.lens, False, False
    if kind == "mixed lenses":
        assert isinstance(lens, Camera)
        zoomed = replace(lens, distortion=lens.distortion / 3 - 0.1 * (lens.distortion > -0.1), focal=1.3 * lens.focal)
        other = replace(sequence, lens=zoomed)
        # A camera that is zoomed in sees the plane from as high as before.
        taken = frozenset(range(3, 5))
    elif kind == "mixed by one":
        assert isinstance(lens, Camera)
        zoom, bend = OTHERS[int(rng.integers(len(OTHERS)))]
        bend = -bend if lens.distortion < -0.1 else bend
        changed = replace(lens, distortion=lens.distortion / zoom**2 - bend, focal=zoom * lens.focal)
        other = replace(sequence, lens=changed)
        taken = frozenset({int(rng.choice([0, len(sequence) // 2, len(sequence) - 1]))})
    elif kind in SPOILED:
        assert isinstance(lens, Camera)
        how = str(rng.choice(["zoomed", "other ground", "blurred", "noisy", "aslant", "pattern", "damaged"]))
        usable = how in ("blurred", "noisy", "aslant")
        if how == "zoomed":
            other = replace(sequence, lens=replace(lens, distortion=lens.distortion / 2, focal=1.4 * lens.focal))
        elif how == "other ground":
            other = replace(sequence, texture=ground(sequence.texture.size, seed + 1))
        elif how == "pattern":
            other = replace(sequence, texture=repeated(sequence.texture.size, seed + 1, int(rng.integers(48, 140))))
        elif how == "damaged":
            other, damaged = sequence, True
        elif how == "aslant":
            aside = rng.uniform(0.4, 0.6) * np.array([np.cos(seed), np.sin(seed)])
            other = replace(sequence, poses=replace(sequence.poses, tilt=sequence.poses.tilt + aside))
        else:
            light = sequence.photometry
            blurred = replace(light, blur=float(rng.uniform(3.0, 8.0)))
            other = replace(sequence, photometry=blurred if how == "blurred" else replace(light, noise=0.4))
        taken = frozenset(rng.choice(len(sequence), int(rng.integers(1, 4)), replace=False).tolist())
    else:
        other, taken = replace(sequence, texture=ground(sequence.texture.size, seed + 1)), frozenset({2})
    return MixedSequence(
        sequence.texture,
        lens,
        sequence.poses,
        sequence.photometry,
        seed=sequence.seed,
        other=other,
        taken=taken,
        usable=usable,
        damaged=damaged,
    )


def judge_set(item: TrustSet, folder: Path, options: StitchOptions | None = None) -> Judged:
    """Stitch a set as the command line does, and compare its registration with the truth."""
    paths = item.sequence.write(folder)
    wanted = options or StitchOptions(features=FeatureOptions(max_features=1500), workers=1)
    try:
        registration = mosaic(paths, None, wanted).registration
    except RdstitchError as refusal:
        return Judged(item.kind, refusal.exit_status, True, False, np.nan, str(refusal))
    alignment = registration.alignment
    # Who is told that λ is not observable is promised images that fit, not straight lines.
    measure = registration_error if np.isfinite(alignment.distortion_std) else overlap_error
    error, worst = measure(item.sequence, registration)
    text = "; ".join(map(str, registration.messages))
    right = error < MAX_MEDIAN and worst < MAX_OF_AN_IMAGE
    mixed = item.sequence if item.kind in SPOILED and isinstance(item.sequence, MixedSequence) else None
    missing = {_number(message.images[0]) for message in registration.left_out}
    dispensable = item.sequence.dispensable if isinstance(item.sequence, AlteredSequence) else frozenset()
    complete = (
        missing <= dispensable if mixed is None else missing == mixed.taken or (mixed.usable and missing < mixed.taken)
    )
    said = [message for message in registration.messages if message.severity == "warning"]
    warned, codes = any(message.images for message in said), tuple(message.code for message in said)
    return Judged(item.kind, 0, right, complete, error, text, warned, codes)


def registration_error(sequence: RenderedSequence, registration: Registration) -> tuple[float, float]:
    """Median error of the images used, and that of the worst of them, px, up to one homography of the plane."""
    alignment = registration.alignment
    order = [_number(source.path.name) for source in registration.sources]
    measured = judging.registration_error(alignment, sequence, "homography", order)
    return measured.median, max(measured.per_image().values())


def overlap_error(sequence: RenderedSequence, registration: Registration) -> tuple[float, float]:
    """Median error where images overlap, and that of the worst pair, px."""
    alignment = registration.alignment
    errors = []
    for (i, first), (j, second) in permutations(_used(registration).items(), 2):
        width, height = alignment.cameras[i].image_size
        points = np.stack(np.meshgrid(np.linspace(0, width - 1, 12), np.linspace(0, height - 1, 9)), -1).reshape(-1, 2)
        true = sequence.to_image(second, sequence.to_plane(first, points))
        found = alignment.transfer(i, j, points)
        width, height = alignment.cameras[j].image_size
        inside = ((true >= 0) & (true <= (width - 1, height - 1))).all(axis=1)
        if inside.any():
            errors.append(np.nan_to_num(np.linalg.norm(found - true, axis=1), nan=np.inf)[inside])
    return float(np.median(np.concatenate(errors))), max(float(np.median(own)) for own in errors)


def _number(path: str) -> int:
    return int(Path(path).stem.split("_")[-1])


def _used(registration: Registration) -> dict[int, int]:
    """The number in its sequence of every image that was used, by its position in the registration."""
    return {
        position: _number(str(source.path))
        for position, source in enumerate(registration.sources)
        if registration.alignment.used[position]
    }
