"""Images taken by turning on the spot, from files to a panorama, through the command line."""

import json
import re
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from examples.worlds.drone_xmp import euler_angles, xmp_of
from examples.worlds.turns import TurningSequence, camera_rotations, panorama_rotations, turning_sequence
from rdstitch.features import FeatureOptions
from rdstitch.geometry.camera import Camera
from rdstitch.options.stitch_options import StitchOptions
from rdstitch.pipeline.outputs.viewer_pages import viewed_images
from rdstitch.pipeline.recipes import pano
from rdstitch.report.pairs import match_graph
from rdstitch.synthetic.rendering import Photometry
from rdstitch.viewer.page import viewer_page
from tests.cli.running import CACHE, Run, sidecar_of

LENS = Camera((320, 240), -0.2, focal=260.0, focal_source="option")


def _written(count: int, step: float, folder: Path) -> tuple[TurningSequence, list[Path]]:
    rotations = panorama_rotations(count, np.radians(step), seed=1)
    sequence = turning_sequence(LENS, rotations, seed=2, photometry=Photometry(noise=0.005))
    return sequence, sequence.write(folder)


@pytest.fixture(scope="module")
def around(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """Nine images that go all the way round; never written to."""
    return _written(9, 40.0, tmp_path_factory.mktemp("around"))[1]


def test_a_full_turn_becomes_a_sphere_that_viewers_turn(rdstitch: Run, around: list[Path], tmp_path: Path) -> None:
    output = tmp_path / "sphere.jpg"
    report = tmp_path / "report.html"
    rdstitch("pano", *around, "-o", output, "--report", report, *CACHE)
    record = sidecar_of(tmp_path / "sphere.jpg")
    assert record["model"] == "rotation"
    assert all(image["used"] for image in record["images"])
    assert record["lambda"] == pytest.approx(-0.2, abs=0.005)
    assert record["focal_px"] == pytest.approx(260.0, rel=0.003)
    assert record["output"]["projection"] == "sphere"
    assert record["output"]["wraps_around"]
    assert record["output"]["field_of_view_deg"][0] == pytest.approx(360.0)
    width, height = record["output"]["size"]
    assert abs(width - 2 * np.pi * 260.0) < 0.02 * width
    with Image.open(output) as written:
        xmp = written.info["xmp"].decode()
    assert f'GPano:FullPanoWidthPixels="{width}"' in xmp
    assert f'GPano:CroppedAreaImageHeightPixels="{height}"' in xmp
    again = tmp_path / "again.jpg"
    rdstitch("apply", f"{output}.json", "--images", around[0].parent, "-o", again)
    assert again.read_bytes() == output.read_bytes()
    page = report.read_text(encoding="utf-8")
    assert "<h2>Match graph</h2>" in page


def test_outlines_are_where_the_images_are_at_both_ends_of_a_full_turn(around: list[Path], tmp_path: Path) -> None:
    result = pano(around, tmp_path / "x.png", StitchOptions(features=FeatureOptions(max_features=600)))
    canvas, alignment = result.canvas, result.registration.alignment
    odd = tuple(
        replace(source, path=Path(f"<b>{source.path.name}"), frame=None) for source in result.registration.sources
    )
    assert "<title>&lt;b&gt;" in match_graph(replace(result.registration, sources=odd))
    page = viewer_page("x.dzi", canvas.size, viewed_images(result))
    data = re.search(r'<script type="application/json" id="data">(.*?)</script>', page)
    shown = cv2.imread(str(tmp_path / "x.png"), cv2.IMREAD_GRAYSCALE)
    patch = np.stack(np.meshgrid(np.arange(140, 180), np.arange(100, 140)), axis=-1).reshape(-1, 2)
    across = 0
    for k, image in enumerate(json.loads(data[1])["images"]):
        camera, homography = alignment.cameras[k], alignment.homographies[k]
        border = canvas.place(camera, homography, camera.outline(64)) + 0.5
        seen = np.zeros(canvas.size[0], dtype=bool)
        for outline in image["outlines"]:
            away = np.array(outline)[:, None] - border
            away[..., 0] -= np.rint(away[..., 0] / canvas.period) * canvas.period
            assert np.linalg.norm(away, axis=-1).min(axis=1).max() < 0.1
            left, right = np.array(outline)[:, 0].min(), np.array(outline)[:, 0].max()
            seen[max(0, int(left)) : max(0, int(right))] = True
        assert seen.sum() == pytest.approx(np.ptp(np.array(image["outlines"][0])[:, 0]), abs=3)
        across += len(image["outlines"]) == 2
        # The mosaic shows the middle of the image where the middle is said to be.
        x, y = canvas.place(camera, homography, patch).astype(np.float32).T
        there = cv2.remap(shown, x[None] % np.float32(canvas.period), y[None], cv2.INTER_LINEAR)
        own = cv2.imread(str(around[k]), cv2.IMREAD_GRAYSCALE)
        assert np.corrcoef(there[0], own[patch[:, 1], patch[:, 0]])[0, 1] > 0.97
    assert across > 0


def test_the_view_is_turned_and_turned_again(rdstitch: Run, around: list[Path], tmp_path: Path) -> None:
    """What is 40 degrees to the right comes to the middle; apply gives the same bytes, and turns from there."""
    first, second, third = (tmp_path / f"{k}.png" for k in range(3))
    how = ("--projection", "sphere", "--seam", "voronoi", "--exposure", "none")
    rdstitch("pano", *around, "-o", first, *how, "--yaw", "40", "--pitch", "-10", *CACHE)
    images = ("--images", around[0].parent)
    rdstitch("apply", f"{first}.json", *images, "-o", second)
    assert first.read_bytes() == second.read_bytes()
    rdstitch("apply", f"{first}.json", *images, "-o", third, "--pitch", "0", "--yaw", "0")
    turned, plain = (sidecar_of(file) for file in (first, third))
    assert plain["output"]["orientation"] is None
    ahead, base = (np.array(record["images"][0]["to_plane"])[:, 2] for record in (turned, plain))
    expected = camera_rotations(np.radians(40), np.radians(-10))[0] @ base
    np.testing.assert_allclose(ahead, expected, atol=1e-12)
    np.testing.assert_allclose(np.array(turned["output"]["orientation"]) @ base, ahead, atol=1e-12)


def test_a_view_of_a_plane_cannot_be_turned(rdstitch: Run, frames: list[Path], tmp_path: Path) -> None:
    how = ("-o", tmp_path / "out.png", "--yaw", "10", *CACHE)
    rdstitch("pano", *frames, *how, status=2, told="turning on the spot")


def test_a_lens_is_calibrated_by_turning(rdstitch: Run, around: list[Path], tmp_path: Path) -> None:
    camera = tmp_path / "camera.json"
    rdstitch("calibrate", around[0].parent, "-o", camera, *CACHE)
    found = Camera.load(camera)
    assert found.distortion == pytest.approx(-0.2, abs=0.005)
    assert found.focal == pytest.approx(260.0, rel=0.003)


def test_a_turning_camera_has_no_path(rdstitch: Run, around: list[Path], tmp_path: Path) -> None:
    rdstitch("trajectory", around[0].parent, "-o", tmp_path / "path.csv", *CACHE, status=2, told="turned on the spot")


# Three images through a camera that is held askew and points upwards: they alone do not tell what is level.
_HEADINGS, _PITCH, _ROLL = np.radians([-30.0, 0.0, 30.0]), 0.3, 0.35


def _down(sequence: TurningSequence, paths: list[Path]) -> float:
    """Angle between down in the scene and down in the panorama, degrees."""
    alignment = pano(paths).registration.alignment
    assert alignment.model == "rotation"
    down = alignment.homographies @ np.diag([1.0, 1.0, 1.0 / (alignment.focal or 1.0)]) @ sequence.rotations
    return float(np.degrees(np.arccos(np.clip(down[:, 1, 1], -1.0, 1.0))).max())


def test_gravity_in_the_images_levels_them(tmp_path: Path) -> None:
    rotations = camera_rotations(_HEADINGS, _PITCH, _ROLL)
    sequence = turning_sequence(LENS, rotations, seed=2, photometry=Photometry(noise=0.005))
    plain, with_xmp = [], []
    for index, rotation in enumerate(rotations):
        plain.append(tmp_path / f"plain_{index}.jpg")
        with_xmp.append(tmp_path / f"xmp_{index}.jpg")
        image = Image.fromarray(sequence.frame(index))
        image.save(plain[-1], quality=95)
        # Of level ground: X to the right, Y towards the camera's back, down below.
        xmp = xmp_of("dji-gimbal", *euler_angles("dji-gimbal", rotation @ [[1.0, 0.0], [0.0, 0.0], [0.0, -1.0]]))
        image.save(with_xmp[-1], quality=95, xmp=xmp.encode())
    assert _down(sequence, plain) > 5.0
    assert _down(sequence, with_xmp) < 0.5


def test_orientation_in_exif_says_what_is_down(tmp_path: Path) -> None:
    """A phone held upright stores its images lying on their side."""
    rotations = camera_rotations(np.radians([-20.0, 0.0, 20.0]), 0.05, np.pi / 2)
    sequence = turning_sequence(LENS, rotations, seed=2, photometry=Photometry(noise=0.005))
    paths = []
    exif = Image.Exif()
    exif[0x0112] = 8  # the first column is the bottom: turn to the left to look at it
    for index in range(len(rotations)):
        paths.append(tmp_path / f"phone_{index}.jpg")
        Image.fromarray(sequence.frame(index)).save(paths[-1], quality=95, exif=exif)
    result = pano(paths)
    assert result.registration.sources[0].camera.image_size == (240, 320)
    axes = result.registration.alignment.homographies[:, :, 1]  # what is down in the images
    assert (axes[:, 1] > 0.95).all()


def test_deep_zoom_of_a_full_turn_is_joined_at_the_edge(rdstitch: Run, around: list[Path], tmp_path: Path) -> None:
    plain, tiles = tmp_path / "around.png", tmp_path / "around.dzi"
    rdstitch("pano", *around, "-o", plain, *CACHE)
    arguments = ("--images", around[0].parent, "-o", tiles, "--max-memory", "200M")
    rdstitch("apply", f"{plain}.json", *arguments)
    with Image.open(plain) as image:
        whole = np.asarray(image.convert("RGB")).astype(float)
    height, width = whole.shape[:2]
    levels = sorted((tmp_path / "around_files").iterdir(), key=lambda folder: int(folder.name))
    last = max(int(tile.stem.split("_")[0]) for tile in levels[-1].iterdir())
    ends = []
    for column, side in ((0, 0), (last, -1)):
        with Image.open(next(iter(levels[-1].glob(f"{column}_0.*")))) as tile:
            ends.append(np.asarray(tile.convert("RGB")).astype(float)[:, side])
    rows = slice(60, 200)
    assert np.abs(ends[0] - ends[1])[rows].mean() < 1.5 * np.abs(np.diff(whole[60:200], axis=1)).mean()
    # The same image, but for the compression of the tiles.
    assert np.abs(ends[0][rows] - whole[rows, 0]).mean() < 6.0
    assert (width, height) == tuple(sidecar_of(tmp_path / "around.dzi")["output"]["size"])
