"""A façade that a tilted camera takes, upright by edges, lines, a rectangle or gravity: against the truth."""

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from PIL import Image

from examples.worlds.drone_xmp import euler_angles, xmp_of
from rdstitch.compositing import CompositeOptions
from rdstitch.errors import ArgumentError
from rdstitch.geometry.camera import Camera
from rdstitch.geometry.planar_motion import rotation_from_tilt
from rdstitch.geometry.radial_homography import to_plane
from rdstitch.options.stitch_options import StitchOptions
from rdstitch.synthetic import ImageTexture, Photometry, RenderedSequence, ground, sequence_over
from rdstitch.synthetic.poses import Poses
from rdstitch.synthetic.textures import Texture
from tests.cli.running import CACHED, Run, sidecar_of

LENS = Camera((400, 300), -0.1, focal=420.0, focal_source="option")
TILT, ROLL = (0.4, 0.25), 0.08
KNOWN = ("--lambda", "-0.1", "--focal", "420", "--reference", "frame_0000.png")


def _lined(size: tuple[int, int]) -> Texture:
    """Joints 70 texels apart, each third of the vertical ones left out."""
    (width, height), white = size, (255.0, 255.0, 255.0)
    plane = np.rint(255.0 * ground(size, 4).region(0, 0, width, height)).astype(np.uint8)
    for y in range(20, height, 70):
        cv2.line(plane, (0, y), (width, y), white, 4, cv2.LINE_AA)
    for k, x in enumerate(range(30, width, 70)):
        if k % 3:
            cv2.line(plane, (x, 0), (x, height), white, 4, cv2.LINE_AA)
    return ImageTexture(plane)


def _taken(plane: Any, folder: Path) -> tuple[RenderedSequence, list[Path]]:
    poses = Poses.of([(0.0, 0.0), (110.0, 0.0), (220.0, 0.0)], 420.0, ROLL, TILT)
    sequence = sequence_over(plane, LENS, poses, photometry=Photometry(noise=0.005), seed=2)
    return sequence, sequence.write(folder)


@pytest.fixture(scope="module")
def facade(tmp_path_factory: pytest.TempPathFactory) -> tuple[RenderedSequence, list[Path]]:
    return _taken(_lined, tmp_path_factory.mktemp("facade"))


@pytest.fixture(scope="module")
def registered(facade: tuple[RenderedSequence, list[Path]], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The sidecar of its panorama, with nothing turned."""
    from rdstitch_cli.main import run

    output = tmp_path_factory.mktemp("registered") / "plain.png"
    assert run([str(word) for word in ("pano", *facade[1], "-o", output, *KNOWN, "-q", *CACHED)]) == 0
    return Path(f"{output}.json")


def _placed(sidecar: Path, sequence: RenderedSequence) -> tuple[float, float, float]:
    """Of texels in the output: angle of verticals, degrees; aspect ratio over the true one; error, pixels, in shape."""
    record = json.loads(sidecar.read_text("utf-8"))
    pixels = np.stack(np.meshgrid(np.linspace(60, 340, 8), np.linspace(50, 250, 6)), axis=-1).reshape(-1, 2)
    image = record["images"][0]
    lens = Camera(LENS.image_size, image["lambda"], center=tuple(image["center_px"]))
    there = to_plane(lens, np.array(image["to_output"]), pixels)
    texels = np.column_stack([sequence.to_plane(0, pixels), np.ones(len(pixels))])
    affine, *_ = np.linalg.lstsq(texels, there, rcond=None)
    (ax, ay), (bx, by) = affine[:2]
    error = float(np.linalg.norm(texels @ affine - there, axis=1).max())
    angle = max(abs(np.degrees(np.arctan2(bx, by))), abs(np.degrees(np.arctan2(ay, ax))))
    return float(angle), float(np.hypot(ax, ay) / np.hypot(bx, by)), error


def _check_upright(output: Path, sequence: RenderedSequence, of_aspect: float = 0.01) -> None:
    angle, aspect, error = _placed(Path(f"{output}.json"), sequence)
    assert angle < 0.2
    assert aspect == pytest.approx(1.0, abs=of_aspect)
    assert error < 1.0 or of_aspect > 0.01


def _corners(sequence: RenderedSequence) -> str:
    middle = sequence.to_plane(0, [(199.5, 149.5)])[0]
    corners = sequence.to_image(0, middle + np.array([(-120, -80), (120, -80), (120, 80), (-120, 80)]))
    return ",".join(f"{value:.1f}" for value in corners.ravel())


def _lines(sequence: RenderedSequence) -> str:
    values = np.array(_corners(sequence).split(",")).reshape(4, 2)
    return ";".join(",".join([*values[a], *values[b]]) for a, b in ((0, 1), (3, 2), (0, 3), (1, 2)))


@pytest.mark.parametrize("way", ["auto", "lines", "rectangle"])
def test_a_facade_becomes_upright(
    way: str, facade: tuple[RenderedSequence, list[Path]], registered: Path, rdstitch: Run, tmp_path: Path
) -> None:
    sequence, paths = facade
    assert _placed(registered, sequence)[0] > 4.0
    how = {
        "auto": ("--straighten", "auto"),
        "lines": ("--straighten", _lines(sequence)),
        "rectangle": ("--rectangle", _corners(sequence)),
    }[way]
    images, output, again = ("--images", paths[0].parent), tmp_path / "up.png", tmp_path / "again.png"
    done = rdstitch("apply", registered, *images, "-o", output, *how)
    assert ("1.5 times as wide as high" in done.err) == (way == "rectangle")
    _check_upright(output, sequence)
    # The sidecar of that does the same, without looking for anything.
    rdstitch("apply", f"{output}.json", *images, "-o", again)
    assert output.read_bytes() == again.read_bytes()
    assert np.linalg.matrix_rank(sidecar_of(output)["output"]["orientation"]) == 3


def test_the_output_is_cropped_to_the_rectangle(
    facade: tuple[RenderedSequence, list[Path]], registered: Path, rdstitch: Run, tmp_path: Path
) -> None:
    sequence, paths = facade
    how = ("--images", paths[0].parent, "-o", tmp_path / "up.png", "--rectangle", _corners(sequence))
    rdstitch("apply", registered, *how, "--crop")
    record = sidecar_of(tmp_path / "up.png")
    width, height = record["output"]["size"]
    image = record["images"][0]
    lens = Camera(LENS.image_size, image["lambda"], center=tuple(image["center_px"]))
    corners = np.array(_corners(sequence).split(","), dtype=np.float64).reshape(4, 2)
    ends = [(0, 0), (width - 1, 0), (width - 1, height - 1), (0, height - 1)]
    np.testing.assert_allclose(to_plane(lens, np.array(image["to_output"]), corners), ends, atol=1.0)


def test_a_mosaic_becomes_upright_at_once(
    facade: tuple[RenderedSequence, list[Path]], rdstitch: Run, tmp_path: Path
) -> None:
    output = tmp_path / "up.png"
    rdstitch("mosaic", *facade[1], "-o", output, *KNOWN, "--straighten", "auto", *CACHED)
    _check_upright(output, facade[0])


def test_where_nothing_is_straight_nothing_is_turned(rdstitch: Run, tmp_path: Path) -> None:
    (tmp_path / "in").mkdir()
    _, paths = _taken(lambda size: ground(size, 7), tmp_path / "in")
    plain, output = tmp_path / "plain.png", tmp_path / "up.png"
    rdstitch("pano", *paths, "-o", plain, *KNOWN, *CACHED)
    done = rdstitch("pano", *paths, "-o", output, *KNOWN, "--straighten", "auto", *CACHED)
    assert "no straight edges" in done.line
    assert "[not-straightened]" in done.line
    assert plain.read_bytes() == output.read_bytes()


def test_the_rectangle_tells_a_focal_length(
    facade: tuple[RenderedSequence, list[Path]], rdstitch: Run, tmp_path: Path
) -> None:
    sequence, paths = facade
    output = tmp_path / "up.png"
    how = ("--lambda", "-0.1", "--reference", paths[0].name, "--model", "homography")
    done = rdstitch("pano", *paths, "-o", output, *how, "--rectangle", _corners(sequence), *CACHED)
    assert "times as wide as high" in done.err  # it is not sure, and says so
    _check_upright(output, sequence, 0.03)


def test_gravity_makes_a_wall_level(facade: tuple[RenderedSequence, list[Path]], rdstitch: Run, tmp_path: Path) -> None:
    """By the attitude in XMP roll and pitch go; a wall that is seen obliquely stays so."""
    sequence, paths = facade
    c, s = np.cos(ROLL), np.sin(ROLL)
    rotation = rotation_from_tilt(TILT) @ np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    for path in paths:
        # Of level ground: X to the right along the wall, Y away from it.
        xmp = xmp_of("dji-gimbal", *euler_angles("dji-gimbal", rotation @ [[1.0, 0.0], [0.0, 0.0], [0.0, -1.0]]))
        Image.open(path).save(tmp_path / f"{path.stem}.jpg", quality=95, xmp=xmp.encode())
    output = tmp_path / "up.png"
    images = sorted(tmp_path.glob("*.jpg"))
    how = ("--lambda", "-0.1", "--focal", "420", "--reference", images[0].name)
    rdstitch("pano", *images, "-o", output, *how, "--level", *CACHED)
    image = sidecar_of(output)["images"][0]
    x = sequence.to_plane(0, [(100.5, 149.5), (299.5, 149.5)])[:, 0].mean()
    pixels = sequence.to_image(0, np.column_stack([np.full(5, x), np.linspace(60, 160, 5) + 100]))
    down = np.diff(to_plane(LENS, np.array(image["to_output"]), pixels), axis=0)
    assert np.degrees(np.arctan2(down[:, 0], down[:, 1])) == pytest.approx(0.0, abs=0.2)


def test_without_gravity_what_is_vertical_in_most_images_is_level(
    facade: tuple[RenderedSequence, list[Path]], registered: Path, rdstitch: Run, tmp_path: Path
) -> None:
    """The output is turned about its axis alone, until the images stand as upright as they can."""
    output = tmp_path / "up.png"
    rdstitch("apply", registered, "--images", facade[1][0].parent, "-o", output, "--level")
    record = sidecar_of(output)
    turn = np.array(record["output"]["orientation"])
    np.testing.assert_allclose(turn[2] / turn[2, 2], (0.0, 0.0, 1.0), atol=1e-9)
    matrices = [np.array(image["to_plane"]) for image in record["images"]]
    down = np.sum([m[:2, 1] - m[:2, 2] * m[2, 1] / m[2, 2] for m in matrices], axis=0)
    assert np.degrees(np.arctan2(*down)) == pytest.approx(0.0, abs=1.5)


def test_places_need_an_image_that_they_are_in() -> None:
    with pytest.raises(ArgumentError, match="reference"):
        StitchOptions(composite=CompositeOptions(rectangle=(0, 0, 9, 0, 9, 9, 0, 9)))
    with pytest.raises(ArgumentError, match="one of them"):
        CompositeOptions(level=True, straighten="auto")
    with pytest.raises(ArgumentError, match="two different ends"):
        CompositeOptions(straighten=((1.0, 2.0, 1.0, 2.0),))


@pytest.mark.parametrize("corners", ["0,0,9,0,9,9", "a,b", "10,10,10,200,300,200,300,10", "9,9,300,9,20,20,9,200"])
def test_corners_that_are_none_are_refused(
    corners: str, facade: tuple[RenderedSequence, list[Path]], registered: Path, rdstitch: Run, tmp_path: Path
) -> None:
    how = ("--images", facade[1][0].parent, "-o", tmp_path / "x.png", "--rectangle", corners)
    rdstitch("apply", registered, *how, status=2, told="rectangle")


def test_scans_keep_the_axes_of_the_reference_image(rdstitch: Run, tmp_path: Path) -> None:
    poses = Poses.of([(0, 0), (180, 5), (0, 140), (183, 144)], [420, 424, 418, 420], [0.0, 0.03, -0.02, 0.04])
    sequence = sequence_over(lambda size: ground(size, 5), Camera((400, 300), 0.0, focal=420.0), poses, seed=3)
    for model in ("rigid", "similarity"):
        output = tmp_path / f"{model}.png"
        paths = sequence.write(tmp_path)
        rdstitch("mosaic", *paths, "-o", output, "--model", model, "--reference", paths[1].name, *CACHED)
        image = sidecar_of(output)["images"][1]
        there = to_plane(Camera((400, 300)), np.array(image["to_output"]), [(50, 150), (350, 150)])
        across, down = there[1] - there[0]
        assert np.degrees(np.arctan2(down, across)) == pytest.approx(0.0, abs=0.02)
