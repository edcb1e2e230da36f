"""Ground truth: poses, relief, and rendered images."""

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from rdstitch.arrays import FloatArray
from rdstitch.errors import ArgumentError, OutputError
from rdstitch.geometry.camera import Camera
from rdstitch.synthetic import (
    RELIEFS,
    BrownLens,
    EndlessTexture,
    FisheyeLens,
    ImageTexture,
    Lens,
    Photometry,
    Poses,
    Relief,
    RenderedSequence,
    blank,
    bumps,
    fit_to_plane,
    grid_poses,
    ground,
    pair_poses,
    sequence_over,
)
from rdstitch.synthetic.textures import LAYER_PERIODS

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
    sequence = RenderedSequence(ImageTexture(np.zeros((1, 1), np.float32)), lens, poses)
    places = sequence.to_plane(0, wanted)
    sequence = RenderedSequence(blobs(size, places, 2.0 * texels_per_pixel), lens, poses, Photometry(bits=16))
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
    sequence = RenderedSequence(blobs((width, height), place[None], 2.0), lens, poses, relief=Relief(relief))
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
    for name in ("{}.jpg", "{}.unknown"):
        with pytest.raises(OutputError, match="cannot hold images of 16 bits"):
            sequence.write(tmp_path, name)


LENS = Camera((320, 240), -0.25, focal=260.0)


@pytest.mark.parametrize("direction", [0.0, 0.5 * np.pi])
@pytest.mark.parametrize("tilt", [(0.0, 0.0), (0.1, -0.08)])
def test_pairs_overlap_as_requested(direction: float, tilt: tuple[float, float]) -> None:
    """Along the middle row (or column), 70 % of the first image is not in the second."""
    poses, _ = fit_to_plane(LENS, pair_poses(LENS, 0.3, direction=direction, tilt=tilt))
    sequence = sequence_over(blank, LENS, poses)
    ends = [(-0.5, 119.5), (319.5, 119.5)] if direction == 0.0 else [(159.5, -0.5), (159.5, 239.5)]
    axis = 0 if direction == 0.0 else 1
    first, second = (sequence.to_plane(index, ends)[:, axis] for index in range(2))
    assert (first[1] - second[0]) / (first[1] - first[0]) == pytest.approx(0.3, abs=0.01)


def test_all_that_images_see_lies_on_the_plane() -> None:
    poses, (width, height) = fit_to_plane(LENS, grid_poses(LENS, 4, 3, yaw=0.3, shift=0.1, tilt=(0.05, 0.1)), margin=5)
    sequence = sequence_over(ImageTexture(np.zeros((height, width), np.uint8)), LENS, poses, margin=5)
    corners = np.array([(-0.5, -0.5), (319.5, -0.5), (319.5, 239.5), (-0.5, 239.5)])
    seen = np.concatenate([sequence.to_plane(index, corners) for index in range(12)])
    assert seen.min() > 4.0
    assert (seen < (width - 5, height - 5)).all()
    with pytest.raises(ArgumentError, match="texels"):
        sequence_over(blank((width - 1, height)), LENS, poses, margin=5)


def test_an_image_of_the_horizon_is_refused() -> None:
    with pytest.raises(ArgumentError, match="horizon"):
        fit_to_plane(LENS, Poses.of([(0.0, 0.0)], 260.0, 0.0, (1.3, 0.0)))


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize(
    "make",
    [
        lambda: grid_poses(LENS, 2, 2, overlap=np.nan),
        lambda: Poses.of([(0.0, 0.0)], 260.0, np.inf),
        lambda: Photometry(noise=-1.0),
        lambda: Photometry(gain=np.array([1.0, np.nan])),
        lambda: Photometry(gamma=0.0),
        lambda: ground((0, 0), 1),
    ],
)
def test_what_cannot_be_rendered_is_refused_by_what_it_is(make: Callable[[], object]) -> None:
    with pytest.raises(ArgumentError, match=r"finite|texel"):
        make()


@pytest.mark.parametrize("gain", [np.ones(3), np.ones((1, 2))])
def test_a_gain_is_one_for_all_images_or_one_an_image(gain: FloatArray) -> None:
    with pytest.raises(ArgumentError, match="gain"):
        RenderedSequence(blank((50, 50)), LENS, grid_poses(LENS, 2, 1), Photometry(gain=gain))


def test_motion_between_poses_is_the_homography_between_images() -> None:
    poses = grid_poses(LENS, 3, 2, yaw=3.0, tilt=(0.1, -0.2)).shaken(seed=1, height=0.2)
    from_plane = poses.from_plane()
    for i, j in ((0, 1), (4, 2), (5, 0)):
        h = from_plane[j] @ np.linalg.inv(from_plane[i])
        expected = poses.motion(i, j).homography()
        np.testing.assert_allclose(h / np.cbrt(np.linalg.det(h) / np.linalg.det(expected)), expected, atol=1e-12)
    with pytest.raises(ArgumentError, match="tilt"):
        poses.shaken(seed=1, tilt=0.1).motion(0, 1)


def test_endless_ground_is_the_same_wherever_it_is_cut() -> None:
    texture = EndlessTexture((100_000, 50_000), seed=5, channels=1)
    whole = texture.region(70_000, 30_000, 70_300, 30_200)
    np.testing.assert_array_equal(texture.region(70_100, 30_050, 70_200, 30_150), whole[50:150, 100:200])
    assert 0.05 < whole.std() < 0.4
    for period in LAYER_PERIODS:
        moved = texture.region(70_000 + period, 30_000, 70_300 + period, 30_200)
        assert abs(np.corrcoef(whole.ravel(), moved.ravel())[0, 1]) < 0.75
    seam = texture.region(LAYER_PERIODS[0] - 8, 0, LAYER_PERIODS[0] + 8, 2000).mean(axis=2)
    steps = np.abs(np.diff(seam, axis=1)).mean(axis=0)
    assert steps[7] < 2.0 * np.median(steps)


def test_layers_of_endless_ground_do_not_nearly_coincide_elsewhere() -> None:
    shift = np.arange(min(LAYER_PERIODS) // 2, 100_000)
    apart = np.max([np.minimum(shift % period, -shift % period) for period in LAYER_PERIODS], axis=0)
    assert apart.min() > 100


DOWNWARDS = Camera((320, 240), -0.2, focal=260.0)


def over(kind: str, height: float, seed: int = 1) -> RenderedSequence:
    poses = pair_poses(DOWNWARDS, 0.5)
    return sequence_over(
        lambda size: ground(size, 1, 1),
        DOWNWARDS,
        poses,
        relief=lambda size: RELIEFS[kind](size, seed, height=height * 260.0),
    )


def met_by_walking(relief: Relief, position: FloatArray, height: float, foot: FloatArray) -> FloatArray:
    """Walk down the ray in steps of a hundredth of a texel's height."""
    ground_height = relief.height.astype(np.float64)
    z = np.linspace(ground_height.max(), ground_height.min(), 20000)
    x, y = (position + (foot - position) * (1.0 - z[:, None] / height)).T
    i, j = np.floor(y).astype(int), np.floor(x).astype(int)
    a, b = y - i, x - j
    below = (1 - b) * ground_height[i, j] + b * ground_height[i, j + 1]
    beneath = (1 - b) * ground_height[i + 1, j] + b * ground_height[i + 1, j + 1]
    first = int(np.argmax((1 - a) * below + a * beneath >= z))
    return np.array([x[first], y[first]])


@pytest.mark.parametrize("kind", sorted(RELIEFS))
def test_a_ray_ends_where_it_first_meets_the_ground(kind: str) -> None:
    sequence = over(kind, 0.1)
    points = np.random.default_rng(2).uniform((5, 5), (314, 234), (60, 2))
    feet, found = sequence.to_plane(1, points), sequence.to_ground(1, points)
    position, height = sequence.poses.position[1], float(sequence.poses.height[1])
    expected = np.array([met_by_walking(sequence.relief, position, height, foot) for foot in feet])
    error = np.linalg.norm(found - expected, axis=1)
    # A ray that only grazes an edge may pass it between two levels.
    assert (error < 0.1).mean() > 0.95
    assert np.median(error) < 0.02
    assert np.linalg.norm(found - feet, axis=1).max() > 3.0


def test_a_wall_hides_what_is_behind_it_from_one_side_only() -> None:
    heights = np.zeros((400, 600), dtype=np.float32)
    heights[:, 280:300] = 60.0
    behind = np.array([[310.0, 200.0]])
    lens = Camera((640, 480), 0.0, focal=400.0)
    poses = Poses.of([(200.0, 200.0), (400.0, 200.0)], 400.0)
    sequence = RenderedSequence(blank((600, 400)), lens, poses, relief=Relief(heights))
    from_left, from_right = (sequence.to_ground(k, sequence.to_image(k, behind)) for k in (0, 1))
    assert 280.0 <= from_left[0, 0] <= 300.0
    np.testing.assert_allclose(from_right, behind, atol=1e-6)


@pytest.mark.parametrize("kind", sorted(RELIEFS))
def test_points_of_the_ground_are_seen_where_rays_meet_them(kind: str) -> None:
    sequence = over(kind, 0.1)
    points = np.random.default_rng(7).uniform((5, 5), (314, 234), (200, 2))
    seen = sequence.ground_to_image(1, sequence.to_ground(1, points))
    error = np.linalg.norm(seen - points, axis=1)
    # Walls have one texel of ground for all their height.
    assert np.isfinite(error).mean() > 0.8
    assert np.nanmedian(error) < 0.05


def test_ground_as_high_as_the_camera_is_refused() -> None:
    relief = bumps((100, 100), 1, height=50.0)
    with pytest.raises(ArgumentError, match="the camera only 40"):
        relief.seen_from(np.array([50.0, 50.0]), 40.0, np.zeros((3, 2)))
