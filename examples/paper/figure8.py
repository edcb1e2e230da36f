"""Fig. 8: the pairs of a sequence vote on λ, and what they elect straightens and rectifies a chart.

The votes on a drive come from plain RANSAC with each solver, as in the paper, and from rdstitch, which weights them
by what each pair can know and then adjusts all images. Real chessboards, which move freely, vote by five points.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from examples.judging import fit_homography, fit_similarity
from examples.paper.common.charts import (
    before_and_after,
    board_grid,
    find_boards,
    off_grid,
    rendered_chart,
    seen_corners,
    undistorted,
)
from examples.paper.common.drives import Drive, FramePair, drive, estimated_links
from examples.paper.common.plain_ransac import all_solvers, best_of
from examples.paper.common.report import Pixels, Report, Table
from examples.paper.common.settings import Settings
from rdstitch.alignment import Alignment, AlignmentOptions, Link, align
from rdstitch.arrays import FloatArray
from rdstitch.matching.distortion_consensus import Consensus, vote
from rdstitch.planar_motion import rotation_from_tilt
from rdstitch.radial_homography import project
from rdstitch.robust.measurements import Measurements

OWN, WEIGHTED, ADJUSTED = "rdstitch, pairs", "rdstitch, weighted votes", "rdstitch, adjusted"

BOARDS = {
    "carnd_wide_gopro_chess": ((8, 6), -0.555),
    "opencv_chess_left": ((9, 6), -0.169),
    "opencv_chess_right": ((9, 6), -0.181),
}
"""Real chessboards: inner corners, and λ of a direct fit to the corners, with the distortion centre in the middle."""

_ITERATIONS = 60  # of plain RANSAC, for each pair
_LEFT_OUT = ("3 points, tilt given, height free", "4 points, no distortion (DLT)")
_DRAWN = ("2 points, tilt given", "5 points", "5 points, Fitzgibbon (homlib)", OWN)
_BIN = 0.01  # of λ
_NEAR = 0.02
_YAW = 0.25  # of the chart
_MARGIN = 1.0  # squares about a real board


@dataclass(frozen=True)
class _Election:
    """Votes of pairs and what they elect."""

    votes: dict[str, FloatArray]
    consensus: Consensus
    alignment: Alignment


@dataclass(frozen=True)
class BoardVotes:
    """What images of a chessboard vote for.

    ``elected``, ``adjusted``: λ by the weighted votes, and by the adjustment of all images. ``off_before``,
    ``off_by_truth``, ``off_by_adjusted``: rms distance of the corners from the grid after a homography, % of a square,
    mean over the images: as measured, undistorted with the given λ, and with the adjusted one.
    """

    votes: FloatArray  # λ of each pair; shape (pairs,)
    elected: float
    adjusted: float
    off_before: float
    off_by_truth: float
    off_by_adjusted: float
    image: Pixels  # the image with the largest board, beside itself undistorted and rectified; shape (h, w, 3)


def run(settings: Settings) -> Report:
    """λ by votes, and how far the corners of charts are from a grid."""
    d = drive("parallel parking", settings.count(8, 24, 107), seed=80)
    election = _drive_election(d)
    boards, notes, images, shown = [], [], {}, {}
    tables = [_votes_table(d, election)]
    table, images["figure8_chart.png"] = _rectified_chart(d, election.alignment)
    tables.append(table)
    for name, (corners, truth) in BOARDS.items():
        files = settings.real_sequence(name)
        if not files:
            notes.append(f"the real images {name} are not here and were left out")
            continue
        found = vote_on_boards(files, corners, truth, reach=settings.count(1, 2, len(files)))
        lambdas = (truth, float(np.median(found.votes)), found.elected, found.adjusted)
        boards.append((name, len(found.votes), *lambdas, found.off_before, found.off_by_truth, found.off_by_adjusted))
        shown[name] = (found.votes, truth)
        images[f"figure8_{name}.png"] = found.image
    if boards:
        header = (
            "boards", "pairs", "λ of the fit to corners", "median of the votes", "weighted votes", "adjusted",
            "corners off a grid before, %", "by the fit, %", "by the adjusted camera, %",
        )  # fmt: skip
        title = (
            "Fig. 8: real chessboards, voting by five points; corners off the grid in % of a square, after a homography"
        )
        tables.append(Table(title, header, tuple(boards)))

    def draw(figure: Any) -> None:
        all_axes = figure.subplots(1, 1 + len(shown), squeeze=False)[0]
        drawn = {name: votes for name, votes in election.votes.items() if name in _DRAWN}
        _draw_votes(all_axes[0], drawn, d.camera.distortion, "parallel parking")
        for axes, (name, (votes, truth)) in zip(all_axes[1:], shown.items(), strict=True):
            _draw_votes(axes, {"5 points, rdstitch": votes}, truth, name)

    return Report(tuple(tables), draw, images, tuple(notes))


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


def vote_on_boards(files: list[Path], corners: tuple[int, int], truth: float, reach: int) -> BoardVotes:
    """λ of a camera from the corners of a board, by pairs of images that are told nothing of the board.

    ``corners``: inner corners across and down. ``truth``: λ that the corners are undistorted with for comparison.
    ``reach``: images are paired with so many that follow.
    """
    camera, boards = find_boards(files, corners)
    grid, seen = board_grid(corners), list(boards.values())
    near = [(i, j) for i, j in combinations(range(len(seen)), 2) if j - i <= reach]
    links = estimated_links((FramePair(i, j, seen[i], seen[j]) for i, j in near), camera, solver="five_point")
    own, std = _votes(links)
    alignment = align([camera.with_focal()] * len(seen), links, AlignmentOptions(model="homography"))
    adjusted = alignment.cameras[alignment.reference]
    before, by_truth, by_adjusted = (
        float(np.mean([off_grid(undistorted(lens, points), grid, metric=False) for points in seen]))
        for lens in (camera, replace(camera, distortion=truth), adjusted)
    )
    largest = max(boards, key=lambda file: float(np.ptp(boards[file], axis=0).prod()))
    to_grid = fit_homography(undistorted(adjusted, boards[largest]), grid + _MARGIN)
    extent = (corners[0] - 1 + 2 * _MARGIN, corners[1] - 1 + 2 * _MARGIN)
    return BoardVotes(
        votes=own,
        elected=vote(own, std).distortion,
        adjusted=alignment.distortion,
        off_before=before,
        off_by_truth=by_truth,
        off_by_adjusted=by_adjusted,
        image=before_and_after(largest, adjusted, to_grid, extent, 50.0),
    )


def _draw_votes(axes: Any, votes: Mapping[str, FloatArray], truth: float, title: str) -> None:
    bins = np.arange(truth - 0.2, truth + 0.2 + _BIN, _BIN)
    for name, values in votes.items():
        axes.hist(np.clip(values, bins[0], bins[-1]), bins=bins, histtype="step", label=name)
    axes.axvline(truth, color="black", linewidth=0.8, linestyle=":")
    axes.set_xlabel("λ")
    axes.set_ylabel("votes")
    axes.set_title(title, fontsize=8)
    axes.legend(fontsize=6, loc="upper center", bbox_to_anchor=(0.5, -0.18))
