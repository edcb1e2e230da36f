"""``rdstitch undistort``, run for real."""

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from rdstitch import undistort
from rdstitch.errors import LimitError
from rdstitch.geometry.camera import Camera
from rdstitch.io.metadata import read_metadata
from rdstitch.io.read import read_image
from rdstitch.synthetic import RenderedSequence
from tests.cli.running import DISTORTION, FAST, Run


def test_pixels_are_where_the_model_says(
    rdstitch: Run, frames: list[Path], sequence: RenderedSequence, tmp_path: Path
) -> None:
    rdstitch("undistort", *frames, "--lambda", str(DISTORTION), "-o", tmp_path / "new" / "folder", out="", err="")
    written = sorted((tmp_path / "new" / "folder").iterdir())
    assert [path.name for path in written] == [path.name for path in frames]
    straight, bent = read_image(written[0]).pixels, read_image(frames[0]).pixels
    assert straight.shape == bent.shape
    camera = Camera((400, 300), distortion=DISTORTION)
    # Points between the middle and the corner, where the lens moves them by many pixels.
    u, v = np.meshgrid(np.arange(230, 370), np.arange(180, 280))
    measured = camera.distort(np.stack([u, v], axis=-1))
    assert np.linalg.norm(measured - np.stack([u, v], axis=-1), axis=-1).max() > 10
    nearest = np.rint(measured).astype(int)
    a = straight[v, u].astype(float).ravel()
    b = bent[nearest[..., 1], nearest[..., 0]].astype(float).ravel()
    assert np.corrcoef(a, b)[0, 1] > 0.9
    assert np.corrcoef(a, bent[v, u].astype(float).ravel())[0, 1] < 0.5


def test_views(rdstitch: Run, frames: list[Path], tmp_path: Path) -> None:
    shown = {}
    for view in ("same", "valid", "all"):
        rdstitch("undistort", frames[0], "--lambda", "-0.2", "-o", tmp_path / view, "--view", view)
        shown[view] = read_image(tmp_path / view / frames[0].name)
    sizes = {view: np.array(image.pixels.shape[:2]) for view, image in shown.items()}
    assert sizes["same"].tolist() == [300, 400]
    # Without its barrel distortion an image is larger everywhere, and its corners reach out farthest.
    assert (sizes["same"] < sizes["valid"]).all()
    assert (sizes["valid"] < sizes["all"]).all()
    assert shown["valid"].alpha is None
    assert shown["all"].alpha is not None


def test_own_outputs_and_damaged_images_are_named(rdstitch: Run, frames: list[Path], tmp_path: Path) -> None:
    images = tmp_path / "images"
    images.mkdir()
    with Image.open(frames[0]) as image:
        image.convert("RGB").save(images / "good.jpg", quality=95)
        image.convert("RGB").save(images / "damaged.jpg", quality=95)
    data = bytearray((images / "damaged.jpg").read_bytes())
    data[len(data) // 2 : len(data) // 2 + 40] = bytes(range(100, 140))
    (images / "damaged.jpg").write_bytes(bytes(data))
    rdstitch("pano", *frames[:2], "-o", images / "mosaic.png", *FAST)
    done = rdstitch("undistort", images, "--lambda", "-0.1", "-o", tmp_path / "straight", told="mosaic.png")
    assert "damaged.jpg: is damaged" in done.err
    assert sorted(path.name for path in (tmp_path / "straight").iterdir()) == ["damaged.jpg", "good.jpg"]


def _photograph(path: Path, size: tuple[int, int] = (400, 300)) -> Path:
    """With the tags of a camera of 35 mm for 35 mm film, shrunk from four times the size, and a position."""
    exif = Image.Exif()
    exif[0x010F], exif[0x013B] = "Maker", "Somebody"
    photo = {0x920A: 4.0, 0xA20E: 4000.0, 0xA210: 3, 0xA002: 4 * size[0], 0xA405: 35}
    exif[0x8769] = {**photo, 0x9003: "2024:05:06 07:08:09", 0x829A: 0.01}
    exif[0x8825] = {1: "N", 2: (52.0, 30.0, 1.5), 3: "E", 4: (1.0, 2.0, 3.0)}
    samples = np.random.default_rng(1).integers(0, 256, (size[1] // 4, size[0] // 4, 3), dtype=np.uint8)
    Image.fromarray(samples).resize(size).save(path, exif=exif, quality=95)
    return path


def test_progress_is_told_of_arrays_too() -> None:
    steps: list[tuple[int, int]] = []
    images = [np.zeros((30, 40, 3), np.uint8)] * 3
    undistort(images, distortion=-0.1, progress=lambda _, done, total: steps.append((done, total)))
    assert steps == [(1, 3), (2, 3), (3, 3)]


def test_a_canvas_out_of_all_proportion_is_refused() -> None:
    """Where the corner is near the horizon, all of the image would be 1,111 times as large."""
    image = np.zeros((60, 80, 3), np.uint8)
    with pytest.raises(LimitError, match=r'2\.67e\+03 x 2e\+03 pixels; choose the view "same" or "valid"'):
        undistort([image], distortion=-0.97, view="all")


@pytest.mark.parametrize("direct", [True, False])
@pytest.mark.parametrize("view", ["same", "all", "valid"])
def test_focal_lengths_in_what_is_written_are_true(rdstitch: Run, tmp_path: Path, view: str, direct: bool) -> None:
    path = _photograph(tmp_path / "a.jpg")
    if not direct:
        with Image.open(path) as image:
            exif = image.getexif()
            del exif.get_ifd(0x8769)[0xA20E]
            image.save(path, exif=exif, quality=95)
    before = read_metadata(path)
    assert before.focal_px is not None
    rdstitch("undistort", path, "--lambda", "-0.3", "-o", tmp_path / view, "--view", view)
    after = read_metadata(tmp_path / view / "a.jpg")
    assert after.gps is not None
    # The scale at the centre stays, and the focal length with it.
    if direct or view == "same":
        assert after.focal_px == pytest.approx(before.focal_px, rel=1e-3)
    else:
        assert after.focal_px is None


def test_a_mosaic_has_no_lens_and_no_place_of_one_image(rdstitch: Run, frames: list[Path], tmp_path: Path) -> None:
    with Image.open(_photograph(tmp_path / "tags.jpg")) as image:
        exif = image.getexif()
    paths = []
    for frame in frames:
        paths.append(tmp_path / f"{frame.stem}.jpg")
        Image.open(frame).convert("RGB").save(paths[-1], exif=exif, quality=95)
    rdstitch("pano", *paths, "-o", tmp_path / "out.jpg", *FAST)
    found = read_metadata(tmp_path / "out.jpg")
    assert (found.focal_px, found.gps, found.exposure) == (None, None, None)
    assert (found.make, found.timestamp) == ("Maker", read_metadata(paths[0]).timestamp)
    with Image.open(tmp_path / "out.jpg") as image:
        assert image.getexif()[0x013B] == "Somebody"


def test_formats_that_cannot_be_written_become_png(rdstitch: Run, frames: list[Path], tmp_path: Path) -> None:
    suffixes = ("bmp", "gif", "ppm", "jp2", "tga", "JPEG")
    for suffix in suffixes:
        Image.open(frames[0]).convert("RGB").save(tmp_path / f"{suffix}.{suffix}")
    images = [tmp_path / f"{suffix}.{suffix}" for suffix in suffixes]
    rdstitch("undistort", *images, "--lambda", "-0.1", "-o", tmp_path / "out")
    expected = ["JPEG.JPEG", *sorted(f"{suffix}.png" for suffix in suffixes[:-1])]
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == expected
    rdstitch("undistort", *images, "--lambda", "-0.1", "-o", tmp_path / "tif", "--format", "tif")
    assert {path.suffix for path in (tmp_path / "tif").iterdir()} == {".tif"}


def test_what_fails_leaves_no_folder(rdstitch: Run, frames: list[Path], tmp_path: Path) -> None:
    broken = tmp_path / "broken.jpg"
    Image.open(frames[0]).convert("RGB").save(broken, quality=95)
    broken.write_bytes(broken.read_bytes()[:5000])
    twice = tmp_path / "twice"
    twice.mkdir()
    (twice / broken.name).write_bytes(b"x")
    for inputs in ([frames[0], broken], [frames[0], twice / broken.name]):
        rdstitch("undistort", *inputs, "--lambda", "-0.1", "-o", tmp_path / "a" / "b", status=3)
        assert not (tmp_path / "a").exists()


def test_a_camera_file_without_a_size_takes_that_of_images(rdstitch: Run, frames: list[Path], tmp_path: Path) -> None:
    camera = tmp_path / "camera.yml"
    matrix = "camera_matrix:\n   rows: 3\n   cols: 3\n   data: [380., 0., 199.5, 0., 403., 149.5, 0., 0., 1.]\n"
    values = "distortion_coefficients:\n   rows: 1\n   cols: 5\n   data: [-0.2, 0.05, 0., 0., 0.]\n"
    camera.write_text("%YAML:1.0\n---\n" + matrix + values)
    done = rdstitch("undistort", frames[0], "--camera", camera, "-o", tmp_path / "out")
    assert "OpenCV lens model, rms 3.96 pixels" in done.err
    assert "by which images are corrected" in done.err
    (tmp_path / "list").write_text(str(tmp_path / "absent.png"))
    done = rdstitch("undistort", f"@{tmp_path / 'list'}", "--camera", camera, "-o", tmp_path / "none", status=3)
    assert "has no image size; add image_width and image_height" in done.line
