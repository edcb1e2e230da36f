"""What a device did not measure is not made up between what it did."""

from pathlib import Path

import numpy as np
import pytest

from rdstitch.errors import InputError
from rdstitch.geometry.camera import Camera
from rdstitch.inputs.attitudes import with_attitudes
from rdstitch.inputs.odometry import odometry_of
from rdstitch.inputs.positions import with_positions
from rdstitch.inputs.source import Source
from rdstitch.inputs.time_gaps import in_gap
from rdstitch.io.metadata import Metadata

SECONDS = [*np.arange(30.0), *np.arange(630.0, 660.0)]  # a device that stopped for ten minutes


def _taken(*seconds: float) -> list[Source]:
    return [
        Source(Path(f"{k}.jpg"), Metadata((640, 480), timestamp=time), Camera((640, 480)))
        for k, time in enumerate(seconds)
    ]


@pytest.mark.parametrize("seed", range(5))
def test_dropped_and_thinned_rows_are_no_gap(seed: int) -> None:
    rng = np.random.default_rng(seed)
    times = np.cumsum(rng.choice([1.0, 1.0, 1.0, 4.0, 8.0], 200))  # a logger that thins what is straight
    assert not in_gap(times, rng.uniform(0.0, times[-1] + 9.0, 500)).any()
    assert not in_gap(times[:2], times).any()
    assert not in_gap(times[:1], times).any()


def test_odometry_that_stopped_has_no_pose_between() -> None:
    odometry = odometry_of([(time, time, 0.0, 0.0, np.nan, np.nan) for time in SECONDS], "odometry")
    at = {time: odometry.at(time) for time in (28.5, 29.0, 29.5, 300.0, 630.0)}
    assert [time for time, pose in at.items() if pose is not None] == [28.5, 29.0, 630.0]


def test_of_several_poses_at_one_time_the_last_counts() -> None:
    rows = [(2.0, 9.0), (1.0, 5.0), (1.0, 2.0), (0.0, 0.0)]
    odometry = odometry_of([(time, x, 0.0, 0.0, np.nan, np.nan) for time, x in rows], "odometry")
    assert odometry.poses[:, 0].tolist() == [0.0, 2.0, 9.0]


def test_an_attitude_in_a_gap_is_refused_by_name(tmp_path: Path) -> None:
    (tmp_path / "imu.csv").write_text("timestamp,psi,theta\n" + "".join(f"{time},1,2\n" for time in SECONDS))
    with_attitudes(_taken(28.5, 640.2), tmp_path / "imu.csv")
    with pytest.raises(InputError, match=r"no attitudes for a long time before and after 1\.jpg"):
        with_attitudes(_taken(28.5, 300.0), tmp_path / "imu.csv")


def test_a_receiver_without_a_fix_says_nothing_of_where_an_image_was_taken(tmp_path: Path) -> None:
    points = "".join(
        f'<trkpt lat="{46 + time / 1e5}" lon="7"><time>1970-01-01T00:{int(time) // 60:02d}:{int(time) % 60:02d}Z</time>'
        "</trkpt>"
        for time in SECONDS
    )
    (tmp_path / "track.gpx").write_text(f"<gpx><trk><trkseg>{points}</trkseg></trk></gpx>")
    inside, lost, again = with_positions(_taken(28.5, 300.0, 640.0), tmp_path / "track.gpx", None, 0.0)
    assert inside.metadata.gps is not None
    assert inside.metadata.gps.latitude == pytest.approx(46.000285)
    assert lost.metadata.gps is None
    assert again.metadata.gps is not None
