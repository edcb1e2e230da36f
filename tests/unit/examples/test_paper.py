"""Every figure of examples/paper at tiny counts: its numbers make sense."""

import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from examples.paper import (
    end_to_end,
    figure2,
    figure3,
    figure4,
    figure5,
    figure7,
    figure8,
    figure9,
    figure10,
    homography_estimation,
    panoramas,
    runtime,
)
from examples.paper.__main__ import main
from examples.paper.common import aerial
from examples.paper.common.constraints import planar_quartics, quartic_monomials
from examples.paper.common.estimation_pairs import scene_pairs
from examples.paper.common.estimators import installed_estimators, judge
from examples.paper.common.planar_scenes import made_scenes, read_scenes
from examples.paper.common.report import Report, Table, save
from examples.paper.common.settings import Effort, Settings
from examples.paper.common.subprocesses import run_all
from rdstitch.synthetic import general_instances, planar_instances

TINY = Settings(Effort.TINY, Path("no real images"))


def test_a_table_reads_as_markdown() -> None:
    table = Table("Errors", ("solver", "px"), (("a", 0.12345), ("longer", None)))
    assert str(table).splitlines() == [
        "Errors:",
        "",
        "| solver | px    |",
        "| ------ | ----- |",
        "| a      | 0.123 |",
        "| longer | -     |",
    ]
    assert table.row("a")["px"] == 0.12345


def test_a_report_is_saved_with_its_plot_or_the_reason_why_not(tmp_path: Path) -> None:
    image = np.arange(12, dtype=np.uint8).reshape(3, 4)
    report = Report((), lambda figure: figure.subplots(), {"image.png": image}, ("nothing was measured",))
    said = save(report, "name", tmp_path)
    assert (tmp_path / "name.md").read_text() == "Note: nothing was measured.\n"
    assert (tmp_path / "image.png").stat().st_size > 0
    assert (tmp_path / "name.png").exists() or "matplotlib is not installed" in said[-1]


def test_unknown_figures_are_refused(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit, match="2"):
        main(["figure99"])
    assert "figure99" in capsys.readouterr().err


def test_figure2_solvers_are_stable() -> None:
    table = figure2.run(TINY).tables[0]
    for name in ("2 points", "3 points, height free", "4 points", "5 points"):
        row = table.row(name)
        assert row["λ median"] < -12.0, name
        assert row["λ 99 %"] < -9.0, name
        assert row["λ off by > 0.01, %"] == 0.0, name
    assert table.row("3 points")["λ off by > 0.01, %"] < 5.0


def test_quartics_vanish_for_planar_motion_only() -> None:
    planar, free = planar_instances(50, 4, seed=1), general_instances(50, 4, seed=1)
    values = [
        quartic_monomials(h / np.linalg.norm(h, axis=(1, 2), keepdims=True)) @ planar_quartics()
        for h in (planar.homography, free.homography)
    ]
    assert np.abs(values[0]).max() < 1e-12
    assert np.median(np.abs(values[1]).max(axis=1)) > 1e-3


def test_figure3_errors_grow_with_the_noise() -> None:
    tables = figure3.run(TINY).tables
    for table in tables:
        for name in table.column("solver"):
            row = table.row(name)
            assert 0.0 < row["σ = 0.05 px"] < 0.5 * row["σ = 2 px"], (table.title, name)
    assert tables[0].row("4 points, all quartics")["σ = 0.25 px"] < tables[0].row("5 points")["σ = 0.25 px"]


def test_figure4_knowing_the_tilt_helps_unless_it_is_wrong() -> None:
    table = figure4.run(TINY).tables[1]
    least = "σ = 0.05 px"
    assert table.row("2 points")[least] < 0.7 * table.row("5 points")[least]
    assert table.row("2 points, tilt wrong by 1°")[least] > 3.0 * table.row("2 points")[least]


def test_runtime_batches_are_faster_than_single_calls() -> None:
    table = runtime.run(TINY).tables[0]
    for name in ("2 points", "3 points", "4 points", "5 points"):
        row = table.row(name)
        assert 0.0 < row["batched, µs"] < row["one call each, µs"], name


def test_figure7_fewer_points_need_fewer_iterations() -> None:
    report = figure7.run(TINY)
    assert any("garfield_red" in note for note in report.notes)
    table = report.tables[0]
    for name in table.column("solver"):
        shares = list(table.row(name).values())[1:]
        assert shares == sorted(shares), name
        assert shares[-1] <= 100.0
    assert table.row("2 points, tilt given")["20 it."] > 2.0 * table.row("5 points")["20 it."]
    assert table.row("3 points")["200 it."] > table.row("4 points, no distortion (DLT)")["200 it."]


def test_figure5_stitches_through_a_lens_that_is_no_division_model() -> None:
    report = figure5.run(TINY)
    measured: dict[str, Any] = dict(zip(report.tables[0].header, report.tables[0].rows[0], strict=True))
    assert abs(measured["λ"] - measured["λ of the best division model"]) < 0.02
    assert measured["its misfit, px"] > 0.05
    assert measured["median error, px"] < 0.5
    assert measured["95 %, px"] < 1.0
    assert all(image.shape[0] > 240 and image.std() > 10.0 for image in report.images.values())
    assert [note.split(" are ")[0] for note in report.notes] == [f"the real images {n}" for n in figure5.REAL_PAIRS]


def test_figure8_the_votes_straighten_and_rectify_a_chart() -> None:
    report = figure8.run(TINY)
    votes, chart = report.tables
    errors = {name: votes.row(name)["λ error"] for name in votes.column("solver")}
    assert errors[figure8.WEIGHTED] < 2e-3
    assert errors[figure8.ADJUSTED] < 2e-3
    assert votes.row(figure8.OWN)["interquartile range"] < 0.5 * votes.row("5 points")["interquartile range"]
    straight, rectified = "off by a homography, %", "off by a similarity, %"
    measured, undistorted, final = (chart.row(name) for name in chart.column("image"))
    assert undistorted[straight] < 0.01 * measured[straight]
    assert final[rectified] < 0.1 * undistorted[rectified]
    assert len(report.notes) == len(figure8.BOARDS)


def test_a_real_board_is_straightened_without_knowing_that_it_is_one(
    shared_data: Callable[[str], Path],
) -> None:
    folder = shared_data("opencv_chess_right")
    images = Settings(Effort.TINY, folder.parent)
    corners, truth = figure8.BOARDS["opencv_chess_right"]
    found = figure8.vote_on_boards(images.real_sequence(folder.name), corners, truth, reach=1)
    assert len(found.votes) >= 10
    assert abs(found.adjusted - truth) < 0.02
    assert found.off_by_adjusted < 1.2 * found.off_by_truth < 0.3 * found.off_before
    assert found.image.std() > 20.0


def test_figure9_adjustment_brings_every_start_to_the_same_trajectory() -> None:
    uncorrected = []
    for table in figure9.run(TINY).tables:
        for name in ("2 points, tilt given", "3 points", "4 points", figure9.RECIPE):
            row = table.row(name)
            assert row["adjusted, %"] < min(1.0, row["translation, chained, %"] + 0.1), (table.title, name)
            assert row["λ error, adjusted"] < 5e-3, (table.title, name)
        uncorrected.append(table.row("4 points, no distortion (DLT)")["translation, chained, %"])
        assert uncorrected[-1] > 3.0, table.title
    # By chance, few samples may come near the truth on one of the paths.
    assert np.median(uncorrected) > 5.0


@pytest.mark.slow
def test_figure10_ignoring_the_distortion_makes_surveys_drift() -> None:
    table = figure10.run(TINY).tables[0]
    ignored = table.row(figure10.IGNORED)
    for name in (figure10.ESTIMATED, figure10.TWO_POINTS):
        row = table.row(name)
        assert row["images"] == 6
        assert abs(row["λ"] - figure10.DISTORTION) < 2e-3
        assert row["95 %, px"] < 0.1
        assert row["drift, chained, px"] < 0.5
        for error in ("95 %, px", "drift, px", "drift, chained, px", "bend of a lane, px"):
            assert row[error] < 0.2 * ignored[error], (name, error)


def test_a_bent_lane_is_measured_whatever_its_frame() -> None:
    along = np.arange(5.0)
    lane = np.column_stack([np.zeros(5), 10.0 * along])
    truth = np.concatenate([lane, lane[::-1] + np.array([7.0, 0.0])])
    sagged = truth.copy()
    sagged[2, 0] += 0.5
    turned = 3.0 * sagged @ np.array([[0.6, -0.8], [0.8, 0.6]]) + np.array([4.0, -1.0])
    assert [part.tolist() for part in aerial.lanes(truth)] == [[0, 1, 2, 3, 4], [5, 6, 7, 8, 9]]
    assert aerial.bend(truth, turned) == pytest.approx(0.5, rel=0.02)
    assert 0.4 < aerial.drift(truth, turned) < 0.5
    assert aerial.bend(truth, truth) < 1e-12


@pytest.mark.slow
def test_homography_estimation_needs_the_distortion() -> None:
    for table in homography_estimation.run(TINY).tables:
        row = table.row("rdstitch")
        assert row["median error, px"] < 0.3, table.title
        assert row["AUC at 1 px, %"] > 70.0, table.title
        assert row["median error of λ"] < 0.02, table.title
        if "no distortion" not in table.title:
            assert row["median error, px"] < 0.2 * table.row("OpenCV USAC_MAGSAC, no λ")["median error, px"]


def test_the_area_under_the_curve_is_that_of_the_shares() -> None:
    assert homography_estimation.area_under_curve([0.0, 1.0, 2.0, np.inf], 2.0) == pytest.approx((1.0 + 0.5) / 4)


def test_scenes_in_the_format_of_hpatches_are_read_and_distorted(tmp_path: Path) -> None:
    (made,) = made_scenes(None, 1, seed=3)
    folder = tmp_path / "v_ground"
    folder.mkdir()
    for number, image in enumerate(made.images, start=1):
        Image.fromarray(image()).save(folder / f"{number}.ppm")
    np.savetxt(folder / "H_1_2", made.homographies[1])
    (tmp_path / "empty").mkdir()
    (scene,) = read_scenes(tmp_path)
    assert len(scene.images) == 2
    np.testing.assert_allclose(scene.homographies[1], made.homographies[1])
    (pair,) = scene_pairs([scene], -0.4, seed=4, per_scene=5)
    assert -0.4 < pair.distortion < -0.01
    own = installed_estimators()[0][0]
    assert judge(own, pair).error < 0.5
    assert judge(own, replace(pair, grid1=pair.grid2, grid2=pair.grid1)).error > 5.0


def test_programs_are_measured_and_kept_within_limits(tmp_path: Path) -> None:
    python = [sys.executable, "-c"]
    failed = run_all([[*python, "import sys; sys.exit('no overlap')"], [*python, "never"]], tmp_path, 30.0)
    assert (failed.status, failed.said) == (1, "no overlap")
    large = run_all([[*python, "a = bytearray(300_000_000)"], [*python, "pass"]], tmp_path, 30.0)
    assert large.ok
    assert 300.0 < large.megabytes < 400.0
    runaway = run_all([[*python, "a = bytearray(9 << 30)"]], tmp_path, 30.0)
    assert (runaway.status, runaway.said) == (1, "MemoryError")
    late = run_all([[*python, "import time; time.sleep(5); open('late', 'w')"]], tmp_path, 0.5)
    assert late.status is None
    assert late.processor_seconds < late.seconds
    time.sleep(6.0)
    assert not (tmp_path / "late").exists()  # it has ended


def test_end_to_end_rdstitch_lies_on_the_true_plane() -> None:
    row = end_to_end.run(TINY).tables[0].row("rdstitch mosaic")
    assert row["exit"] == "0", row
    assert row["median error, px"] < 1.0
    assert row["95 % error, px"] < 3.0
    assert row["coverage, %"] > 95.0
    assert row["λ error"] < 0.1
    assert row["memory, MB"] > 50.0
    assert row["processor time, s"] > 0.5


@pytest.mark.slow
def test_panoramas_lie_on_the_true_sphere() -> None:
    (own, peer) = panoramas.run(TINY).tables[0].rows
    assert own[0] == "rdstitch mosaic"
    assert own[1] == peer[1] == "0"
    assert float(own[2]) < 0.2  # type: ignore[arg-type]
    assert float(own[4]) > 99.0  # type: ignore[arg-type]
    assert float(own[2]) < float(str(peer[2]).removeprefix("> "))  # type: ignore[arg-type]
