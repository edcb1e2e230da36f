"""Robots: videos, a lens, a path, and floors."""

import json
import re
from functools import partial
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import cv2
import numpy as np
import pytest
from PIL import ExifTags, Image

import rdstitch
from examples.judging.trajectories import compare_trajectories
from examples.worlds.floor_drives import read_path, true_path
from examples.worlds.paths import drive_poses
from rdstitch.camera_files import load_camera
from rdstitch.camera_files.lens_models import RATIONAL, nearest_model
from rdstitch.geometry.camera import Camera
from rdstitch.inputs.rosbag import camera_in_bag
from rdstitch.io.read import read_image
from rdstitch.synthetic import Photometry, RenderedSequence, ground, sequence_over
from tests.cli.running import CACHED, DISTORTION, FAST, Run, finished, rows_of, start
from tests.videos import write_video


def test_frames_of_a_video_keep_their_numbers_and_times(rdstitch: Run, frames: list[Path], tmp_path: Path) -> None:
    output = tmp_path / "path.csv"
    video = write_video(tmp_path / "drive.avi", (read_image(frame).pixels for frame in frames for _ in range(2)))
    done = rdstitch("trajectory", video, "--every", "2", "-o", output, "--focal", "380", *CACHED)
    assert abs(float(done.out) - DISTORTION) < 0.01
    rows = rows_of(output)
    assert [row["source_frame"] for row in rows] == ["0", "2", "4"]
    assert [row["frame"] for row in rows] == ["0", "1", "2"]
    np.testing.assert_allclose([float(row["timestamp"]) for row in rows], [0.0, 0.4, 0.8], atol=1e-6)
    assert rows[1]["name"] == "drive_000002.png"

    (tmp_path / "times.txt").write_text("".join(f"{100 + k}\n" for k in range(6)), encoding="utf-8")
    arguments = ("--every", "2", "--timestamps", tmp_path / "times.txt", "--format", "tum", "--focal", "380")
    rdstitch("trajectory", video, *arguments, "-o", tmp_path / "path.tum", *CACHED, err="")
    assert np.loadtxt(tmp_path / "path.tum")[:, 0].tolist() == [100.0, 102.0, 104.0]


def test_exif_tells_the_time(rdstitch: Run, frames: list[Path], tmp_path: Path) -> None:
    folder = tmp_path / "flight"
    folder.mkdir()
    for number, frame in enumerate(frames):
        exif = Image.Exif()
        exif[ExifTags.IFD.Exif] = {
            ExifTags.Base.DateTimeOriginal: f"2024:05:01 12:00:0{number}",
            ExifTags.Base.SubsecTimeOriginal: "25",
            ExifTags.Base.OffsetTimeOriginal: "+02:00",
        }
        with Image.open(frame) as image:
            image.save(folder / f"{number}.jpg", exif=exif, quality=97)
    output = tmp_path / "path.tum"
    rdstitch("trajectory", folder, "-o", output, "--format", "tum", "--focal", "380", *CACHED, err="")
    # date -d '2024-05-01 12:00:00 +02:00' +%s
    np.testing.assert_allclose(np.loadtxt(output)[:, 0], 1714557600.25 + np.arange(3), atol=1e-5)


def test_without_times_numbers_stand_for_them_as_is_told(rdstitch: Run, frames: list[Path], tmp_path: Path) -> None:
    output = tmp_path / "path.tum"
    done = rdstitch("trajectory", *frames, "-o", output, "--format", "tum", "--focal", "380", *CACHED)
    assert "give --timestamps" in done.line
    assert np.loadtxt(output)[:, 0].tolist() == [0.0, 1.0, 2.0]


def test_what_cannot_be_read_keeps_its_time_and_is_counted(rdstitch: Run, frames: list[Path], tmp_path: Path) -> None:
    (folder := tmp_path / "drive").mkdir()
    good = [frame.read_bytes() for frame in frames]
    for number, content in enumerate([good[0], b"", good[1], b"broken", good[2]]):
        (folder / f"{number}.png").write_bytes(content)
    Image.fromarray(np.full((300, 400), 90, np.uint8)).save(folder / "5.png")
    (tmp_path / "times.txt").write_text("".join(f"{100 + k}\n" for k in range(6)), encoding="utf-8")
    known = ("--timestamps", tmp_path / "times.txt", "--focal", "380", *CACHED)
    done = rdstitch("trajectory", folder, "-o", tmp_path / "path.csv", *known)
    assert [row["timestamp"] for row in rows_of(tmp_path / "path.csv")] == ["100.000000", "102.000000", "104.000000"]
    assert "3 of 6 images" in done.made
    for name in ("1.png", "3.png", "5.png"):
        assert name in done.err


def _write_bag(
    folder: Path,
    frames: list[Path],
    version: int,
    kind: str,
    focal: float = 0.0,
    calibrated: str = "/camera_info",
    topic: str = "/camera",
    margin: int = 0,
) -> Path:
    """A bag with the frames on /camera at 2 Hz from 1000 s on; with a camera's calibration if it has a focal length.

    That has the division model's lens as ROS's rational polynomial. With a margin, the images are a region of larger
    ones.
    """
    typesys = pytest.importorskip("rosbags.typesys")
    store = typesys.get_typestore(typesys.Stores.ROS1_NOETIC if version == 1 else typesys.Stores.LATEST)
    time_type, header_type = store.types["builtin_interfaces/msg/Time"], store.types["std_msgs/msg/Header"]
    path = folder / ("drive.bag" if version == 1 else "drive")
    writer: Any = import_module(f"rosbags.rosbag{version}").Writer(path, **({"version": 9} if version == 2 else {}))
    name = "sensor_msgs/msg/CompressedImage" if kind == "compressed" else "sensor_msgs/msg/Image"
    with writer:
        connection = writer.add_connection(topic, name, typestore=store)
        for number, frame in enumerate(frames):
            sec, nanosec = divmod(500_000_000 * number, 10**9)
            stamp = time_type(sec=1000 + sec, nanosec=nanosec)
            header = header_type(stamp=stamp, frame_id="", **({"seq": number} if version == 1 else {}))
            message = _message(store.types[name], header, frame, kind)
            data = (store.serialize_ros1 if version == 1 else store.serialize_cdr)(message, name)
            writer.write(connection, 10**12 + number, data)
        if focal:
            message = _camera_info(store, header, Camera((400, 300), DISTORTION, focal=focal), margin)
            connection = writer.add_connection(calibrated, message.__msgtype__, typestore=store)
            writer.write(connection, 10**12, store.serialize_cdr(message, message.__msgtype__))
    return path


def _camera_info(store: Any, header: Any, camera: Camera, margin: int) -> Any:
    lens, _, _ = nearest_model(camera, {RATIONAL: ""})
    x, y = (value + margin for value in camera.center)
    k = np.array([camera.focal, 0.0, x, 0.0, camera.focal, y, 0.0, 0.0, 1.0])
    p = np.insert(k.reshape(3, 3), 3, 0.0, axis=1).ravel()
    shown = camera.image_size if margin else (0, 0)
    fields = {"x_offset": margin, "y_offset": margin, "height": shown[1], "width": shown[0], "do_rectify": False}
    region = store.types["sensor_msgs/msg/RegionOfInterest"](**fields)
    of_lens = {"distortion_model": "rational_polynomial", "d": np.array(lens.coefficients), "k": k}
    other = {"r": np.eye(3).ravel(), "p": p, "binning_x": 0, "binning_y": 0, "roi": region}
    size = {"width": camera.image_size[0] + 2 * margin, "height": camera.image_size[1] + 2 * margin}
    return store.types["sensor_msgs/msg/CameraInfo"](header=header, **size, **of_lens, **other)


def _message(message: Any, header: Any, frame: Path, kind: str) -> Any:
    if kind == "compressed":
        return message(header=header, format="png", data=np.frombuffer(frame.read_bytes(), np.uint8))
    image = cv2.imread(str(frame))
    if kind == "rgb8":
        image = image[..., ::-1]
    height, width, _ = image.shape
    padded = np.pad(image.reshape(height, -1), ((0, 0), (0, 4)))  # rows may be longer than their pixels
    return message(
        header=header,
        height=height,
        width=width,
        encoding=kind,
        is_bigendian=0,
        step=3 * width + 4,
        data=padded.ravel(),
    )


@pytest.mark.parametrize(("version", "kind"), [(1, "bgr8"), (1, "compressed"), (2, "rgb8"), (2, "compressed")])
def test_a_bag_is_like_its_frames(rdstitch: Run, frames: list[Path], tmp_path: Path, version: int, kind: str) -> None:
    bag = _write_bag(tmp_path, frames, version, kind)
    output = tmp_path / "path.csv"
    done = rdstitch("trajectory", bag, "-o", output, "--focal", "380", *CACHED, err="")
    of_files = rdstitch("trajectory", *frames, "-o", tmp_path / "files.csv", "--focal", "380", *CACHED)
    assert done.out == of_files.out
    assert abs(float(done.out) - DISTORTION) < 0.01
    assert [row["timestamp"] for row in rows_of(output)] == ["1000.000000", "1000.500000", "1001.000000"]
    rdstitch("mosaic", bag, "--topic", "/other", "-o", tmp_path / "out.png", *CACHED, status=3, told="/camera")


def test_the_calibration_in_a_bag_is_used(rdstitch: Run, frames: list[Path], tmp_path: Path) -> None:
    bag = _write_bag(tmp_path, frames, 2, "bgr8", focal=380.0)
    done = rdstitch("trajectory", bag, "-o", tmp_path / "path.csv", *CACHED)
    assert "/camera_info" in done.err
    assert float(done.out) == pytest.approx(DISTORTION, abs=0.01)
    assert "(given)" in done.made
    live = rdstitch("trajectory", bag, "-o", tmp_path / "live.csv", "--follow", *CACHED)
    assert "/camera_info" in live.err
    *_, last, _ = map(json.loads, live.out.splitlines())
    assert last["x"] == pytest.approx(float(rows_of(tmp_path / "path.csv")[-1]["x"]), rel=0.05)
    same = rdstitch("trajectory", *frames, "--camera", bag, "-o", tmp_path / "files.csv", *CACHED)
    assert same.out == done.out


@pytest.mark.parametrize(
    ("topic", "kind", "rectified"),
    [
        ("/cam/image_direct", "bgr8", False),
        ("/cam/image_rect_color", "bgr8", True),
        ("/cam/image_rect/compressed", "compressed", True),
    ],
)
@pytest.mark.parametrize("margin", [0, 50])
def test_which_images_of_a_bag_are_rectified_and_which_part_they_show(
    topic: str, kind: str, rectified: bool, margin: int, frames: list[Path], tmp_path: Path
) -> None:
    bag = _write_bag(tmp_path, frames[:1], 2, kind, 380.0, "/cam/camera_info", topic, margin)
    camera = camera_in_bag(bag)[0].camera
    assert camera.image_size == (400, 300)
    assert camera.center == pytest.approx((199.5, 149.5), abs=0.01)
    assert camera.focal == pytest.approx(380.0)
    assert camera.nearest_distortion == pytest.approx(0.0 if rectified else DISTORTION, abs=0.01)


def test_the_calibration_of_another_camera_is_not_used(rdstitch: Run, frames: list[Path], tmp_path: Path) -> None:
    bag = _write_bag(tmp_path, frames, 2, "bgr8", focal=90.0, calibrated="/depth/camera_info")
    assert "depth" not in rdstitch("trajectory", bag, "-o", tmp_path / "path.csv", "--focal", "380", *CACHED).err
    rdstitch("trajectory", *frames, "--camera", bag, "-o", tmp_path / "f.csv", status=3, told="no calibration")


def test_what_is_no_bag_is_named(rdstitch: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    bag = tmp_path / "broken.bag"
    bag.write_bytes(b"#ROSBAG V2.0\nbroken")
    rdstitch("mosaic", bag, "-o", tmp_path / "out.png", *CACHED, status=3, told="broken.bag")
    monkeypatch.setitem(__import__("sys").modules, "rosbags.highlevel", None)
    assert "pip install rosbags" in rdstitch("mosaic", bag, "-o", tmp_path / "out.png", *CACHED, status=3).line


def test_a_calibrated_focal_length_is_as_sure_as_it_was(rdstitch: Run, tmp_path: Path) -> None:
    lens = Camera((400, 300), DISTORTION, focal=320.0)
    poses = drive_poses(lens, "parking", 8, overlap=0.6, heading=0.3, tilt=(np.radians(1.5), np.radians(-1.0)))
    drive = sequence_over(partial(ground, seed=1), lens, poses, photometry=Photometry(noise=0.01), seed=1)
    (folder := tmp_path / "drive").mkdir()
    drive.write(folder)
    file = tmp_path / "camera.json"
    done = rdstitch("calibrate", folder, "-o", file, *CACHED)
    camera = Camera.load(file)
    focal, psi, theta = (
        re.search(rf"{name}([-.\d]+) ± ([.\d]+)", done.err) for name in ("focal length ", "ψ = ", "θ = ")
    )
    assert focal
    assert psi
    assert theta
    assert focal.groups() == (f"{camera.focal:.1f}", f"{camera.focal_std:.1f}")
    for found, true in ((focal, 320.0), (psi, 1.5), (theta, -1.0)):
        assert abs(float(found[1]) - true) < 3.0 * float(found[2])
    assert abs(float(psi[1]) - 1.5) < 0.3
    assert camera.focal_std > 0.02 * camera.focal

    path = tmp_path / "path.csv"
    done = rdstitch("trajectory", folder, "-o", path, "--camera", file, "--height", "0.42", *CACHED)
    stated = re.search(r"lengths ± (\S+)%", done.made)
    assert stated
    scale = compare_trajectories(read_path(path), true_path(drive)).scale
    assert float(stated[1]) > 1.0
    assert abs(scale * 0.42 - 1.0) < 3.0 * float(stated[1]) / 100.0


def test_python_gets_labels_and_a_camera_file_too(frames: list[Path], tmp_path: Path) -> None:
    options = rdstitch.StitchOptions(focal=380.0, workers=1, save_camera=tmp_path / "camera.json")
    path, registration = rdstitch.trajectory(frames, options=options)
    assert rdstitch.load_camera(tmp_path / "camera.json").distortion == registration.camera.distortion
    assert path.name == tuple(frame.name for frame in frames)
    assert path.source_frame.tolist() == [0, 1, 2]
    assert np.isnan(path.timestamp).all()


def test_csv_holds_the_path(rdstitch: Run, frames: list[Path], sequence: RenderedSequence, tmp_path: Path) -> None:
    known = ("--focal", str(sequence.lens.focal), "--plot", tmp_path / "path.svg")
    done = rdstitch("trajectory", frames[0].parent, "-o", tmp_path / "path.csv", *known, *CACHED, err="")
    assert abs(float(done.out) - DISTORTION) < 0.01
    rows = rows_of(tmp_path / "path.csv")
    place = np.array([[float(row["x"]), float(row["y"])] for row in rows])
    steps = np.linalg.norm(np.diff(place, axis=0), axis=1)
    true = np.linalg.norm(np.diff(sequence.poses.position, axis=0), axis=1)
    np.testing.assert_allclose(steps, true / sequence.poses.height[0], rtol=0.02)
    assert ElementTree.parse(tmp_path / "path.svg").getroot().tag.endswith("svg")


def test_height_scales_positions_and_tum_has_eight_columns(rdstitch: Run, frames: list[Path], tmp_path: Path) -> None:
    arguments = ("trajectory", *frames, "--format", "tum", *CACHED)
    rdstitch(*arguments, "-o", tmp_path / "one.txt", told="lengths may be off")
    rdstitch(*arguments, "-o", tmp_path / "two.txt", "--height", "2")
    first, second = (np.loadtxt(tmp_path / name) for name in ("one.txt", "two.txt"))
    assert first.shape == (3, 8)
    np.testing.assert_allclose(second[:, 1:3], 2.0 * first[:, 1:3], atol=1e-6)
    np.testing.assert_allclose(second[:, 4:], first[:, 4:], atol=1e-9)


def test_the_name_of_a_path_says_its_format(rdstitch: Run, frames: list[Path], tmp_path: Path) -> None:
    arguments = ("trajectory", *frames, "--focal", "380", *CACHED)
    of_bag = [("a.bag", b"#ROSBAG V2.0")] if find_spec("rosbags") else []
    for name, beginning in (("a.TUM", b"0.000000 0 0 1 "), ("a.txt", b"frame,name,"), *of_bag):
        rdstitch(*arguments, "-o", tmp_path / name)
        assert (tmp_path / name).read_bytes().startswith(beginning)
    rdstitch(*arguments, "-o", tmp_path / "kitti.tum", "--format", "kitti")
    assert np.loadtxt(tmp_path / "kitti.tum").shape == (3, 12)
    rdstitch(*arguments, "-o", tmp_path / "a.svg", status=6, told="--plot")


def test_writes_a_camera_that_pano_takes(rdstitch: Run, frames: list[Path], tmp_path: Path) -> None:
    file = tmp_path / "camera.json"
    done = rdstitch("calibrate", frames[0].parent, "-o", file, *CACHED)
    camera = Camera.load(file)
    first, *others = done.err.splitlines()
    assert first == f"rdstitch: λ = {camera.distortion:.6f} ± {camera.distortion_std:.6f}"
    assert "rdstitch: second coefficient not estimated" in others
    assert not re.search("warning|pixels from the lens", done.err)
    assert done.out == f"{camera.distortion:.6f}\n"
    assert abs(camera.distortion - DISTORTION) < 0.01
    assert camera.image_size == (400, 300)
    assert [path.name for path in tmp_path.iterdir()] == ["camera.json"]

    stitched = rdstitch("pano", *frames[:2], "-o", tmp_path / "pano.jpg", "--camera", file, *CACHED)
    assert (stitched.status, stitched.out) == (0, done.out)


@pytest.mark.parametrize("name", ["camera.yml", "cameras.json", "lens.pto"])
def test_camera_files_of_others(rdstitch: Run, frames: list[Path], tmp_path: Path, name: str) -> None:
    done = rdstitch("calibrate", *frames[:2], "-o", tmp_path / name, *CACHED)
    assert re.search(rf"{name}: its lens model is at most 0\.\d+ pixels from the lens", done.err)
    assert f"{load_camera(tmp_path / name).distortion:.6f}\n" == done.out
    rdstitch("undistort", frames[0], "--camera", tmp_path / name, "-o", tmp_path / "straight", err="")


def test_the_residual_of_a_foreign_lens_is_reported(rdstitch: Run, frames: list[Path], tmp_path: Path) -> None:
    entry = {"projection_type": "perspective", "width": 400, "height": 300, "focal": 0.95, "k1": -0.2, "k2": 0.02}
    file = tmp_path / "cameras.json"
    file.write_text(json.dumps({"lens": entry}), encoding="utf-8")
    arguments = ("undistort", frames[0], "--camera", file, "-o", tmp_path / "straight", "--overwrite")
    told = rdstitch(*arguments)
    assert re.search(r"OpenDroneMap.* rms \d+\.\d\d pixels", told.line)
    rdstitch(*arguments, "-q", err="")


@pytest.fixture
def clip(frames: list[Path], tmp_path: Path) -> Path:
    return write_video(tmp_path / "drive.avi", (read_image(frame).pixels for frame in frames))


@pytest.mark.parametrize("following", [(), ("--follow",)])
def test_a_video_is_never_written_over(rdstitch: Run, clip: Path, tmp_path: Path, following: tuple[str, ...]) -> None:
    before = clip.read_bytes()
    inner, outer = tmp_path / "inner.txt", tmp_path / "outer.txt"
    inner.write_text(f"{clip}\n", encoding="utf-8")
    outer.write_text(f"@{inner}\n", encoding="utf-8")
    for named, output in ((clip, clip), *([] if following else [(f"@{outer}", inner)])):
        rdstitch("trajectory", named, "-o", output, "--overwrite", *following, *FAST, status=6, told="is read as input")
    assert clip.read_bytes() == before


@pytest.mark.parametrize("follow", [(), ("--follow", "--idle", "0.1")])
@pytest.mark.parametrize("damage", ["text", "cut"])
def test_nobody_else_writes_to_stderr(frames: list[Path], tmp_path: Path, damage: str, follow: tuple[str, ...]) -> None:
    broken = tmp_path / "broken.mp4"
    broken.write_bytes(b"no video\n" * 20 if damage == "text" else b"\0\0\0\x18ftypmp42" + bytes(400))
    done = finished(start("trajectory", *follow, str(broken), "-o", str(tmp_path / "path.csv")))
    assert done.status == 3
    assert done.line.startswith(f"rdstitch: {broken}: ")
