"""Rendered images show what projection says they show."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from rdstitch.arrays import FloatArray
from rdstitch.camera import Camera
from rdstitch.errors import OutputError
from rdstitch.synthetic import (
    BrownLens,
    FisheyeLens,
    ImageTexture,
    Lens,
    Photometry,
    Poses,
    Relief,
    Sequence,
    fit_to_plane,
    ground,
    pair_poses,
    sequence_over,
)

SIZE = (320, 240)
LENSES: list[Lens] = [
    Camera(SIZE, -0.4, focal=260.0),
    Camera(SIZE, -0.2, -0.08, focal=260.0),
    FisheyeLens(SIZE, 220.0),
    FisheyeLens(SIZE, 220.0, kind="equisolid"),
    FisheyeLens(SIZE, 220.0, kind="stereographic"),
    BrownLens(SIZE, 260.0, k1=-0.25, k2=0.06, p1=2e-3, p2=-1e-3),
]

IDS = ["division", "division2", "equidistant", "equisolid", "stereographic", "brown"]


def blobs(size: tuple[int, int], places: FloatArray, sigma: float) -> ImageTexture:
    """Gaussian blobs at given texels on black ground."""
    x, y = np.arange(size[0]), np.arange(size[1])
    rows = np.exp(-((y[:, None] - places[:, 1]) ** 2) / (2.0 * sigma**2))
    columns = np.exp(-((x[:, None] - places[:, 0]) ** 2) / (2.0 * sigma**2))
    return ImageTexture((rows @ columns.T).astype(np.float32))


def centroid(image: FloatArray, around: FloatArray, radius: int = 9) -> FloatArray:
    """Centre of gravity of the light near a px, weighted by its square: far pixels count little."""
    u, v = np.rint(around).astype(int)
    window = image[v - radius : v + radius + 1, u - radius : u + radius + 1] ** 2
    grid = np.arange(-radius, radius + 1)
    return np.array([u + (window.sum(axis=0) @ grid) / window.sum(), v + (window.sum(axis=1) @ grid) / window.sum()])


@pytest.mark.parametrize("lens", LENSES, ids=IDS)
@pytest.mark.parametrize("texels_per_pixel", [0.8, 1.0, 2.6])
def test_a_blob_is_seen_where_projection_puts_it(lens: Lens, texels_per_pixel: float) -> None:
    poses, size = fit_to_plane(lens, Poses.of([(0.0, 0.0)], texels_per_pixel * lens.focal, 0.4, (0.06, -0.05)))
    wanted = np.stack(np.meshgrid(np.linspace(25, 295, 7), np.linspace(25, 215, 5)), axis=-1).reshape(-1, 2)
    wanted += np.random.default_rng(1).uniform(-0.5, 0.5, wanted.shape)
    sequence = Sequence(ImageTexture(np.zeros((1, 1), np.float32)), lens, poses)
    places = sequence.to_plane(0, wanted)
    sequence = Sequence(blobs(size, places, 2.0 * texels_per_pixel), lens, poses, Photometry(bits=16))
    image = sequence.frame(0).astype(np.float64)
    found = np.array([centroid(image, place) for place in wanted])
    # A round blob on the plane is seen by a lens that bends it: its centroid is off by up to 0.03 px at the corners.
    error = np.linalg.norm(found - wanted, axis=1)
    assert np.median(error) < 0.02
    assert error.max() < 0.06
    np.testing.assert_allclose(sequence.to_image(0, places), wanted, atol=1e-6)


def test_rendering_does_not_alias() -> None:
    """A checkerboard too fine to be resolved turns grey, not into moiré."""
    lens = Camera(SIZE, 0.0, focal=260.0)
    x, y = np.meshgrid(np.arange(2400), np.arange(1800))
    board = ImageTexture((((x + y) % 2) * 255).astype(np.uint8))
    sequence = sequence_over(board, lens, Poses.of([(0.0, 0.0)], 5.0 * 260.0, 0.3))
    image = sequence.frame(0)[4:-4, 4:-4].astype(np.float64)
    assert abs(image.mean() - 127.5) < 2.0
    assert image.std() < 8.0


def test_exposure_is_what_was_requested() -> None:
    lens = Camera(SIZE, 0.0, focal=260.0)
    grey = ImageTexture(np.full((400, 500), 100, np.uint8))
    poses = Poses.of([(0.0, 0.0), (5.0, 3.0)], 260.0)
    settings = Photometry(gain=np.array([1.0, 1.5]), vignetting=0.4, noise=0.01, bits=16)
    sequence = sequence_over(grey, lens, poses, photometry=settings, seed=4)
    first, second = (frame.astype(np.float64) for frame in sequence.frames())
    assert first.shape == (240, 320)
    centre = np.s_[110:130, 150:170]
    assert first[centre].mean() / 65535 == pytest.approx(100 / 255, abs=0.002)
    assert second[centre].mean() / first[centre].mean() == pytest.approx(1.5, abs=0.01)
    assert first[:3, :3].mean() / first[centre].mean() == pytest.approx(0.6, abs=0.02)
    assert first[centre].std() / 65535 == pytest.approx(0.01, abs=0.002)
    np.testing.assert_array_equal(sequence.frame(1), second)
    assert (sequence.frame(0) != sequence_over(grey, lens, poses, photometry=settings, seed=5).frame(0)).any()


def test_a_raised_box_is_seen_in_parallax() -> None:
    """The top of a box of height z is seen where the plane point under its ray lies, ``z / (h - z)`` further out."""
    lens = Camera(SIZE, 0.0, focal=260.0)
    poses, (width, height) = fit_to_plane(lens, Poses.of([(0.0, 0.0)], 260.0))
    place = poses.position[0] + (80.0, 40.0)
    x, y = int(place[0]), int(place[1])
    relief = np.zeros((height, width), np.float32)
    relief[y - 20 : y + 21, x - 20 : x + 21] = 26.0
    sequence = Sequence(blobs((width, height), place[None], 2.0), lens, poses, relief=Relief(relief))
    expected = sequence.to_image(0, poses.position[0] + (place - poses.position[0]) * 260.0 / (260.0 - 26.0))
    found = centroid(sequence.frame(0).astype(np.float64), expected)
    np.testing.assert_allclose(found, expected, atol=0.05)


def test_reachable_is_where_images_look() -> None:
    lens = Camera(SIZE, -0.3, focal=260.0)
    sequence = sequence_over(lambda size: ground(size, 1, 1), lens, pair_poses(lens, 0.3, yaw=0.2))
    mask = sequence.reachable()
    places = np.random.default_rng(5).uniform((0, 0), np.array(mask.shape[::-1]) - 1, (2000, 2))
    seen = np.zeros(len(places), dtype=np.bool_)
    near = np.zeros(len(places), dtype=np.bool_)
    for index in range(2):
        u = sequence.to_image(index, places)
        border = np.minimum(u, np.array(SIZE) - 1 - u).min(axis=1)
        seen |= border > -0.5
        near |= np.abs(border) < 2.0
    column, row = np.rint(places).astype(int).T
    np.testing.assert_array_equal(mask[row, column][~near], seen[~near])


def test_written_images_are_the_frames(tmp_path: Path) -> None:
    lens = Camera((64, 48), -0.3, focal=60.0)
    sequence = sequence_over(lambda size: ground(size, 1), lens, pair_poses(lens), photometry=Photometry(bits=16))
    paths = sequence.write(tmp_path)
    assert [path.name for path in paths] == ["frame_0000.png", "frame_0001.png"]
    for path, frame in zip(paths, sequence.frames(), strict=True):
        bgr = np.asarray(cv2.imread(str(path), cv2.IMREAD_UNCHANGED))
        np.testing.assert_array_equal(bgr[:, :, ::-1], frame)
    with pytest.raises(OutputError, match="cannot be written"):
        sequence.write(tmp_path / "missing")
