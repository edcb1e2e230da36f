"""Fig. 10: aerial mosaics, with λ and without: what goes wrong when mild distortion is ignored.

Homographies of consecutive images, chained one after the other, add up the error that a wrong λ makes in each. The
adjustment of all images spreads it, but images that are bent cannot fit: what is left are seams, and bent lanes.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from examples.judging import fit_similarity, registration_error
from examples.judging.fitting import apply
from examples.paper.common.report import Effort, Report, Settings, Table
from examples.paper.common.stitched import register_files
from examples.worlds.paths import survey_poses
from rdstitch.arrays import FloatArray
from rdstitch.features import FeatureOptions
from rdstitch.geometry.camera import Camera
from rdstitch.geometry.radial_homography import project
from rdstitch.options.stitch_options import StitchOptions
from rdstitch.results.registration import Registration
from rdstitch.synthetic import Photometry, RenderedSequence, ground, sequence_over

_CENTRE = np.array([0.0, 0.0, 1.0])


def rendered_survey(count: int, size: tuple[int, int], distortion: float, seed: int) -> RenderedSequence:
    """Images of a drone that keeps its height and attitude, as the two-point solver asks for; a texel is a pixel."""
    lens = Camera(size, distortion, focal=1.1 * size[0], focal_source="option")
    poses = survey_poses(lens, count, forward_overlap=0.6, side_overlap=0.4, height_jitter=0.0, seed=seed)
    photometry = Photometry(vignetting=0.2, noise=0.01, blur=0.4)
    return sequence_over(lambda plane: ground(plane, seed), lens, poses, photometry=photometry, seed=seed)


def true_centres(sequence: RenderedSequence) -> FloatArray:
    """What each image's centre shows, texels, shape (N, 2)."""
    centre = np.array([sequence.lens.center])
    return np.concatenate([sequence.to_plane(index, centre) for index in range(len(sequence))])


def adjusted_centres(registration: Registration) -> FloatArray:
    """Where the adjustment puts the images' distortion centres, shape (N, 2); NaN for images left out."""
    return project(registration.alignment.homographies @ _CENTRE)


def chained_centres(registration: Registration) -> FloatArray:
    """The same by the homographies of consecutive images, one after the other, in the frame of the first image.

    NaN from the first pair on that has none.
    """
    steps = {pair.image1: pair.relation for pair in registration.pairs if pair.image2 == pair.image1 + 1}
    count = len(registration.sources)
    to_first = np.full((count, 3, 3), np.nan)
    to_first[0] = np.eye(3)
    for index in range(count - 1):
        if not steps.get(index):
            break
        to_first[index + 1] = to_first[index] @ np.linalg.inv(steps[index].homography)
    return project(to_first @ _CENTRE)


def laid_on(truth: FloatArray, centres: FloatArray) -> FloatArray:
    """Centres after the similarity that takes them nearest to the truth."""
    known = np.isfinite(centres).all(axis=1)
    return apply(fit_similarity(centres[known], truth[known]), centres)


def drift(truth: FloatArray, centres: FloatArray) -> float:
    """Largest distance of a centre from the truth, in the unit of the truth, once laid on it."""
    return float(np.nanmax(np.linalg.norm(laid_on(truth, centres) - truth, axis=1)))


def bend(truth: FloatArray, centres: FloatArray) -> float:
    """How far the middle of a lane is displaced from where its ends say that it is: the largest of all lanes."""
    displaced = laid_on(truth, centres) - truth
    largest = [0.0]
    for lane in lanes(truth):
        share = np.linspace(0.0, 1.0, len(lane))[:, None]
        chord = (1.0 - share) * displaced[lane[0]] + share * displaced[lane[-1]]
        largest.append(float(np.nanmax(np.linalg.norm(displaced[lane] - chord, axis=1), initial=0.0)))
    return max(largest)


def lanes(truth: FloatArray) -> list[FloatArray]:
    """Indices of the images of each lane: lanes run along Y, the steps between them along X."""
    step = np.abs(np.diff(truth, axis=0))
    return np.split(np.arange(len(truth)), np.flatnonzero(step[:, 0] > step[:, 1]) + 1)


DISTORTION = -0.05
"""λ of the rendered surveys: a compact camera."""

ESTIMATED, TWO_POINTS, IGNORED = "λ estimated", "λ estimated, two points", "λ ignored (0)"

_FEW = FeatureOptions(max_features=1000)
_VARIANTS = {
    ESTIMATED: StitchOptions(force=True, features=_FEW),
    TWO_POINTS: StitchOptions(force=True, features=_FEW, solver="two_point", tilt=(0.0, 0.0)),
    IGNORED: StitchOptions(force=True, features=_FEW, distortion=0.0),
}
_TOLD = ("variant", "images", "λ", "model", "rms of the matches, px")
_MEASURED = ("median error, px", "95 %, px", "drift, px", "drift, chained, px", "bend of a lane, px")
_COPR = "λ by structure from motion: -0.020 … -0.028"


@dataclass
class _Paths:
    """Centres of the images (N, 2), texels: the true ones, and the estimates laid on them."""

    truth: FloatArray
    found: dict[str, FloatArray] = field(default_factory=dict)


def run(settings: Settings) -> Report:
    """Rendered surveys of the paper's lengths, and a real one."""
    lengths = {Effort.TINY: (6,), Effort.SMALL: (24,), Effort.FULL: (117, 158)}[settings.effort]
    size = (320, 240) if settings.effort is Effort.TINY else (480, 360)
    done = [_rendered(count, size) for count in lengths]
    tables = [table for table, _ in done]
    notes = []
    files = settings.real_sequence("copr")[: settings.count(0, 6, 41)]
    if files:
        tables.append(_real(files))
    else:
        notes.append("the real images copr are not here and were left out")

    def draw(figure: Any) -> None:
        for axes, (_, paths) in zip(np.atleast_1d(figure.subplots(1, len(done))), done, strict=True):
            axes.plot(*paths.truth.T, label="truth", linewidth=3.0)
            for name, centres in paths.found.items():
                axes.plot(*centres.T, label=name, linewidth=1.0)
            axes.set_title(f"{len(paths.truth)} images", fontsize=8)
            axes.set_aspect("equal", adjustable="datalim")
            axes.legend(fontsize=6)

    return Report(tuple(tables), draw, notes=tuple(notes))


def _rendered(count: int, size: tuple[int, int]) -> tuple[Table, _Paths]:
    """How far every variant is from the truth, and the paths to be drawn."""
    sequence = rendered_survey(count, size, DISTORTION, seed=500 + count)
    paths = _Paths(true_centres(sequence))
    rows = []
    with TemporaryDirectory(prefix="rdstitch-paper-") as folder:
        files = sequence.write(folder)
        for variant, options in _VARIANTS.items():
            registration = register_files(files, replace(options, cache=Path(folder) / "cache"))
            if isinstance(registration, str):
                rows.append(_failed(variant, registration, _MEASURED))
                continue
            error = registration_error(registration.alignment, sequence)
            adjusted, chained = adjusted_centres(registration), chained_centres(registration)
            drifts = [drift(paths.truth, centres) for centres in (adjusted, chained)]
            measured = (error.median, error.percentile95, *drifts, bend(paths.truth, adjusted))
            rows.append((*_told(variant, registration), *measured))
            if variant != TWO_POINTS:
                paths.found[f"{variant}, adjusted"] = laid_on(paths.truth, adjusted)
                paths.found[f"{variant}, chained"] = laid_on(paths.truth, chained)
    title = f"Fig. 10: rendered survey of {count} images, {size[0]}x{size[1]} px, λ = {DISTORTION:g}"
    return Table(title, (*_TOLD, *_MEASURED), tuple(rows)), paths


def _real(files: Sequence[Path]) -> Table:
    """What can be said without truth: how well the matches agree."""
    rows = []
    with TemporaryDirectory(prefix="rdstitch-paper-") as folder:
        for variant in (ESTIMATED, IGNORED):
            registration = register_files(files, replace(_VARIANTS[variant], cache=Path(folder)))
            if isinstance(registration, str):
                rows.append(_failed(variant, registration, ("",)))
            else:
                agreeing = sum(registration.alignment.support.values())
                rows.append((*_told(variant, registration), agreeing))
    return Table(f"Fig. 10: copr, {len(files)} real images, {_COPR}", (*_TOLD, "matches that agree"), tuple(rows))


def _told(variant: str, registration: Registration) -> tuple[object, ...]:
    alignment = registration.alignment
    return variant, int(alignment.used.sum()), alignment.distortion, alignment.model, alignment.rms


def _failed(variant: str, reason: str, columns: Sequence[str]) -> tuple[object, ...]:
    return (variant, 0, None, f"failed: {reason}", None, *(None for _ in columns))
