"""Fig. 8: the pairs of a sequence vote on λ, and what they elect straightens and rectifies a chart.

The votes on a drive come from plain RANSAC with each solver, as in the paper, and from rdstitch, which weights them
by what each pair can know and then adjusts all images.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import cv2
import numpy as np

from examples.judging import fit_homography, fit_similarity
from examples.judging.fitting import apply
from examples.paper.common.drives import Drive, drive, estimated_links
from examples.paper.common.plain_ransac import all_solvers, best_of
from examples.paper.common.report import Pixels, Report, Settings, Table
from rdstitch.alignment import Alignment, Link, align
from rdstitch.arrays import FloatArray
from rdstitch.compositing import Canvas, CompositeOptions, PlacedImage, compose
from rdstitch.geometry.camera import Camera
from rdstitch.geometry.planar_motion import rotation_from_tilt
from rdstitch.geometry.radial_homography import project
from rdstitch.io.read import read_image
from rdstitch.matching.distortion_consensus import Consensus, vote
from rdstitch.robust.measurements import Measurements
from rdstitch.synthetic import ImageTexture, Poses, RenderedSequence, sequence_over

_SQUARE = 80  # texels of a rendered chart
_SQUARES = 30  # a side
_DARK, _LIGHT = 40, 225
_AS_IT_IS = CompositeOptions(exposure="none", seam="none", blend="none", background=255)


def rendered_chart(camera: Camera, tilt: tuple[float, float], yaw: float) -> RenderedSequence:
    """One image of an endless chessboard; a texel is a pixel at the image's centre."""
    dark = np.indices((_SQUARES, _SQUARES)).sum(axis=0) % 2 == 0
    chart = np.kron(np.where(dark, _DARK, _LIGHT), np.ones((_SQUARE, _SQUARE))).astype(np.uint8)
    assert camera.focal is not None
    return sequence_over(ImageTexture(chart), camera, Poses.of([(0.0, 0.0)], camera.focal, yaw, tilt))


def seen_corners(sequence: RenderedSequence) -> tuple[FloatArray, FloatArray]:
    """Corners of the rendered chart that the image shows: measured px, and grid coordinates, both (N, 2)."""
    steps = np.arange(1.0, _SQUARES)
    grid = np.stack(np.meshgrid(steps, steps), axis=-1).reshape(-1, 2)
    points = sequence.to_image(0, grid * _SQUARE - 0.5)
    limit = np.array(sequence.lens.image_size) - 1.0
    with np.errstate(invalid="ignore"):
        seen = ((points >= 0.0) & (points <= limit)).all(axis=1)
    return points[seen], grid[seen]


def off_grid(points: FloatArray, grid: FloatArray, *, metric: bool) -> float:
    """Rms distance from the grid, % of a square, after the best similarity (metric) or homography."""
    fit = fit_similarity if metric else fit_homography
    residual = apply(fit(points, grid), points) - grid
    return 100.0 * float(np.sqrt((residual**2).sum(axis=1).mean()))


def undistorted(camera: Camera, points: FloatArray) -> FloatArray:
    """Measured px to undistorted coordinates in half diagonals."""
    return camera.normalize(camera.undistort(points))


def before_and_after(file: Path, camera: Camera, to_grid: FloatArray, size: tuple[float, float], px: float) -> Pixels:
    """An image beside itself, undistorted and rectified.

    ``camera``: with the λ that undistorts it. ``to_grid``: undistorted half diagonals to grid coordinates, of which the
    square from (0, 0) to ``size`` is drawn; shape (3, 3). ``px``: size of a square.
    """
    width, height = (round(px * extent) for extent in size)
    frame = np.array([(0.0, 0.0), (width - 1.0, 0.0), (width - 1.0, height - 1.0), (0.0, height - 1.0)])
    canvas = Canvas((width, height), np.diag([px, px, 1.0]), (frame,))
    after = compose([PlacedImage(partial(read_image, file), camera, to_grid)], canvas, _AS_IT_IS)
    pixels = np.where(after.alpha[..., None] > 0, _as_rgb(after.pixels), np.uint8(255))
    measured = _as_rgb(np.asarray(read_image(file).pixels))
    shape = (round(measured.shape[1] * height / measured.shape[0]), height)
    before = cv2.resize(measured, shape, interpolation=cv2.INTER_AREA)
    gap = np.full((height, 8, 3), 255, np.uint8)
    both: Pixels = np.concatenate([before, gap, pixels], axis=1)
    return both


def _as_rgb(pixels: Pixels) -> Pixels:
    return pixels if pixels.ndim == 3 else np.repeat(pixels[:, :, None], 3, axis=2)


OWN, WEIGHTED, ADJUSTED = "rdstitch, pairs", "rdstitch, weighted votes", "rdstitch, adjusted"

_ITERATIONS = 60  # of plain RANSAC, for each pair
_LEFT_OUT = ("3 points, tilt given, height free", "4 points, no distortion (DLT)")
_DRAWN = ("2 points, tilt given", "5 points", "5 points, Fitzgibbon (homlib)", OWN)
_BIN = 0.01  # of λ
_NEAR = 0.02
_YAW = 0.25  # of the chart


@dataclass(frozen=True)
class _Election:
    """Votes of pairs and what they elect."""

    votes: dict[str, FloatArray]
    consensus: Consensus
    alignment: Alignment


def run(settings: Settings) -> Report:
    """λ by votes, and how far the corners of charts are from a grid."""
    d = drive("parallel parking", settings.count(8, 24, 107), seed=80)
    election = _drive_election(d)
    table, chart = _rectified_chart(d, election.alignment)

    def draw(figure: Any) -> None:
        drawn = {name: votes for name, votes in election.votes.items() if name in _DRAWN}
        _draw_votes(figure.subplots(), drawn, d.camera.distortion, "parallel parking")

    return Report((_votes_table(d, election), table), draw, {"figure8_chart.png": chart})


def _drive_election(d: Drive) -> _Election:
    """Votes of all pairs of frames of a drive."""
    cameras = d.blank_cameras
    votes: dict[str, FloatArray] = {}
    for solver in all_solvers(d.camera, d.tilt):
        if solver.name in _LEFT_OUT:
            continue
        found = []
        for seed, pair in enumerate(d.pairs):
            data = Measurements.from_pixels(pair.points1, pair.points2, cameras[0], cameras[0])
            found.append(best_of(solver, data, _ITERATIONS, seed))
        votes[solver.name] = np.array([model[1] for model in found if model is not None])
    links = estimated_links(d.pairs, cameras[0])
    votes[OWN], std = _votes(links)
    return _Election(votes, vote(votes[OWN], std), align(cameras, links))


def _votes(links: Sequence[Link]) -> tuple[FloatArray, FloatArray]:
    """λ of each pair, and its standard deviation."""
    relations = [link.relation for link in links]
    return np.array([r.distortion for r in relations]), np.array([r.distortion_std for r in relations])


def _votes_table(d: Drive, election: _Election) -> Table:
    truth = d.camera.distortion
    rows: list[tuple[object, ...]] = []
    for name, votes in election.votes.items():
        low, middle, high = np.quantile(votes, [0.25, 0.5, 0.75])
        near = 100.0 * float(np.mean(np.abs(votes - truth) < _NEAR))
        rows.append((name, len(votes), abs(float(middle) - truth), high - low, near))
    rows.append((WEIGHTED, election.consensus.votes, abs(election.consensus.distortion - truth), None, None))
    rows.append((ADJUSTED, election.consensus.votes, abs(election.alignment.distortion - truth), None, None))
    header = ("solver", "votes", "λ error", "interquartile range", f"within {_NEAR:g}, %")
    title = f"Fig. 8: votes on λ = {truth:g}, parallel parking, {len(d.poses)} frames, pairs 1, 2 and 4 frames apart"
    return Table(title, header, tuple(rows))


def _rectified_chart(d: Drive, alignment: Alignment) -> tuple[Table, Pixels]:
    """A chart that the drive's camera sees, by the λ, tilt and focal length that the drive's images gave."""
    sequence = rendered_chart(d.camera, d.tilt, _YAW)
    points, grid = seen_corners(sequence)
    assert alignment.tilt is not None
    assert alignment.focal is not None
    camera = alignment.cameras[alignment.reference]
    straight = undistorted(camera, points)
    level = rotation_from_tilt(alignment.tilt).T @ np.diag([1.0, 1.0, alignment.focal])
    from_above = project(np.column_stack([straight, np.ones(len(straight))]) @ level.T)
    stages = {"as measured": points, "undistorted": straight, "undistorted and rectified": from_above}
    rows = tuple(
        (name, off_grid(place, grid, metric=False), off_grid(place, grid, metric=True))
        for name, place in stages.items()
    )
    header = ("image", "off by a homography, %", "off by a similarity, %")
    title = f"Fig. 8: {len(grid)} corners of a rendered chart, rms distance from a square grid, % of a square"
    to_grid = fit_similarity(from_above, grid - grid.min(axis=0)) @ level
    extent = np.ptp(grid, axis=0)
    with TemporaryDirectory(prefix="rdstitch-paper-") as folder:
        file = sequence.write(folder)[0]
        image = before_and_after(file, camera, to_grid, (float(extent[0]), float(extent[1])), 40.0)
    return Table(title, header, rows), image


def _draw_votes(axes: Any, votes: Mapping[str, FloatArray], truth: float, title: str) -> None:
    bins = np.arange(truth - 0.2, truth + 0.2 + _BIN, _BIN)
    for name, values in votes.items():
        axes.hist(np.clip(values, bins[0], bins[-1]), bins=bins, histtype="step", label=name)
    axes.axvline(truth, color="black", linewidth=0.8, linestyle=":")
    axes.set_xlabel("λ")
    axes.set_ylabel("votes")
    axes.set_title(title, fontsize=8)
    axes.legend(fontsize=6, loc="upper center", bbox_to_anchor=(0.5, -0.18))
