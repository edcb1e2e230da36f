"""What of an image counts: masks of files, and the circle of a fisheye lens."""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

import rdstitch
from examples.judging import registration_error
from rdstitch.errors import InputError
from rdstitch.features.image_circle import find_circle
from rdstitch.geometry.camera import Camera
from rdstitch.geometry.exif_orientation import SIDEWAYS, turned, turned_size
from rdstitch.inputs.find import find_images
from rdstitch.inputs.input_guard import InputGuard
from rdstitch.inputs.masks import with_masks
from rdstitch.inputs.source import Source, read_sources
from rdstitch.io.mask import Mask, mask_frame
from rdstitch.io.metadata import Metadata
from rdstitch.io.read import DecodedImage, read_image
from rdstitch.pipeline.registration.image_circle import with_image_circle
from rdstitch.synthetic import FisheyeLens, grid_poses, ground, sequence_over
from rdstitch.system.cache import Cache

SIZE = (40, 30)


def leg() -> NDArray[np.bool_]:
    """True but for a corner."""
    counts = np.ones(SIZE[::-1], dtype=bool)
    counts[20:, 24:] = False
    return counts


def save(path: Path, pixels: NDArray[np.uint8], **options: object) -> Path:
    path.parent.mkdir(exist_ok=True)
    Image.fromarray(pixels).save(path, **options)  # type: ignore[arg-type]
    return path


def source(path: Path) -> Source:
    return Source(path, Metadata(SIZE), Camera(SIZE))


@pytest.mark.parametrize(
    ("name", "pixels"),
    [
        ("labels.png", leg().astype(np.uint8)),
        ("white.png", np.where(leg(), 255, 0).astype(np.uint8)),
        ("colour.png", np.where(leg(), 200, 0).astype(np.uint8)[..., None] * np.array([0, 1, 0], np.uint8)),
        ("lossy.jpg", np.where(leg(), 255, 0).astype(np.uint8)),
        ("transparent.png", np.dstack([np.full((30, 40, 3), 255), np.where(leg(), 255, 0)]).astype(np.uint8)),
        ("twice.png", np.where(leg(), 255, 0).astype(np.uint8).repeat(2, axis=0).repeat(2, axis=1)),
        ("half.png", np.where(leg(), 255, 0).astype(np.uint8)[::2, ::2]),
    ],
)
def test_a_mask_means_what_it_shows(tmp_path: Path, name: str, pixels: NDArray[np.uint8]) -> None:
    path = save(tmp_path / name, pixels)
    mask_frame(path, "image.png", SIZE)
    mask = Mask(path).read(SIZE)
    assert mask.dtype == np.uint8
    np.testing.assert_array_equal(mask, np.where(leg(), 255, 0))
    # A black one leaves nothing, and a white one all.
    for value in (0, 1, 255):
        mask = Mask(save(tmp_path / "plain.png", np.full((30, 40), value, np.uint8))).read(SIZE)
        assert (mask == (255 if value else 0)).all()


@pytest.mark.parametrize("shape", [(40, 30), (30, 42), (15, 22), (300, 420)])
def test_a_mask_of_another_shape_is_named(tmp_path: Path, shape: tuple[int, int]) -> None:
    path = save(tmp_path / "a.png", np.zeros(shape, np.uint8))
    with pytest.raises(InputError, match=rf"a\.png: a mask of {shape[1]} x {shape[0]} pixels does not fit on .*b\.png"):
        mask_frame(path, tmp_path / "b.png", SIZE)


@pytest.mark.parametrize("orientation", range(1, 9))
def test_what_a_camera_hides_turns_with_the_stored_image(tmp_path: Path, orientation: int) -> None:
    upright = turned_size(SIZE, orientation)
    path = save(tmp_path / "leg.png", leg().astype(np.uint8))
    expected = np.where(turned(leg(), orientation), 255, 0)
    frame = mask_frame(path, "image.png", upright, orientation, of_camera=True)
    np.testing.assert_array_equal(Mask(path, frame).read(upright), expected)
    # The mask of one image is as that looks; of one for all only its shape can say that.
    shown = save(tmp_path / "shown.png", np.ascontiguousarray(turned(leg(), orientation)).astype(np.uint8))
    frame = mask_frame(shown, "image.png", upright, orientation)
    np.testing.assert_array_equal(Mask(shown, frame).read(upright), expected)
    if orientation in SIDEWAYS:
        assert mask_frame(shown, "image.png", upright, orientation, of_camera=True) is None
        assert mask_frame(path, "image.png", upright, orientation) == orientation


def test_what_a_mask_excludes_is_transparent_with_what_was(tmp_path: Path) -> None:
    alpha = np.full((30, 40), 255, np.uint8)
    alpha[:5] = 7
    image = save(tmp_path / "a.png", np.dstack([np.full((30, 40, 3), 90, np.uint8), alpha]))
    mask = save(tmp_path / "masks" / "a.png", leg().astype(np.uint8))
    read = replace(source(image), mask=Mask(mask)).read()
    np.testing.assert_array_equal(read.alpha, np.where(leg(), alpha, 0))
    np.testing.assert_array_equal(read.pixels, np.full((30, 40, 3), 90))
    opaque = save(tmp_path / "b.png", np.full((30, 40), 90, np.uint8))
    np.testing.assert_array_equal(replace(source(opaque), mask=Mask(mask)).read().alpha, np.where(leg(), 255, 0))


def test_masks_are_found_by_the_names_of_images(tmp_path: Path) -> None:
    sources = [source(tmp_path / f"{name}.jpg") for name in ("a", "b", "c")]
    white = np.full((30, 40), 255, np.uint8)
    of_a, of_c = save(tmp_path / "masks" / "a.png", white), save(tmp_path / "masks" / "c.TIF", white)
    save(tmp_path / "masks" / "z.png", np.zeros((3, 3), np.uint8))
    (tmp_path / "masks" / "b.txt").write_text("no image")
    assert [found.mask and found.mask.path for found in with_masks(sources, tmp_path / "masks")] == [of_a, None, of_c]
    assert [found.mask and found.mask.path for found in with_masks(sources, of_a)] == [of_a] * 3
    assert with_masks(sources, None) == sources


def test_masks_of_images_of_one_name_are_in_folders_of_their_names(tmp_path: Path) -> None:
    for name in ("left/a.png", "right/a.png", "masks/left/a.png", "masks/a.png"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        save(tmp_path / name, np.full((30, 40), 255, np.uint8))
    frames = find_images([tmp_path / "left", tmp_path / "right"]).frames
    masked = with_masks(read_sources(frames, skip_bad=False)[0], tmp_path / "masks")
    found = [source.mask and source.mask.path for source in masked]
    assert found == [tmp_path / "masks" / "left" / "a.png", tmp_path / "masks" / "a.png"]


def test_masks_that_cannot_be_meant_are_refused(tmp_path: Path) -> None:
    white = np.full((30, 40), 255, np.uint8)
    image = save(tmp_path / "a.png", white)
    with pytest.raises(InputError, match=r"absent.*no such folder"):
        with_masks([source(image)], tmp_path / "absent")
    with pytest.raises(InputError, match="is the image itself"):
        with_masks([source(image)], tmp_path)
    save(tmp_path / "masks" / "b.png", white)
    with pytest.raises(InputError, match=r"none of the masks has the name of an image, such as a\.png"):
        with_masks([source(image)], tmp_path / "masks")
    save(tmp_path / "masks" / "a.png", white)
    save(tmp_path / "masks" / "a.bmp", white)
    with pytest.raises(InputError, match=r"a\.png: a\.bmp is a mask for the same image"):
        with_masks([source(image)], tmp_path / "masks")


Grey = NDArray[np.float32]


def _grey(
    shape: tuple[int, int], radius: float, center: tuple[float, float], level: float = 120.0
) -> NDArray[np.float32]:
    rng = np.random.default_rng(1)
    u, v = np.meshgrid(np.arange(shape[1]), np.arange(shape[0]))
    content = level * rng.uniform(0.3, 1.7, shape)
    dark = 4.0 + rng.normal(0.0, 2.0, shape)
    return np.where(np.hypot(u - center[0], v - center[1]) <= radius, content, dark).astype(np.float32)


@pytest.mark.parametrize(("radius", "center"), [(110.0, (160.0, 120.0)), (140.0, (150.0, 122.0))])
def test_a_circle_is_found_also_where_the_longer_sides_cut_it_off(radius: float, center: tuple[float, float]) -> None:
    found = find_circle(_grey((240, 320), radius, center))
    assert found.center == pytest.approx(center, abs=1.0)
    assert found.radius == pytest.approx(radius, abs=1.0)


def test_other_dark_borders_are_no_circle() -> None:
    u, v = np.meshgrid(np.arange(320), np.arange(240))
    bright = _grey((240, 320), 1000.0, (0.0, 0.0))
    frame = (np.abs(u - 160) < 140) & (np.abs(v - 120) < 100)
    pincushion = np.hypot(u - 160, v - 120) < 130 + 60 * np.abs(np.sin(2 * np.arctan2(v - 120, u - 160)))
    for content in (frame, pincushion, np.ones_like(frame), np.zeros_like(frame)):
        assert find_circle(np.where(content, bright, np.float32(3.0)).astype(np.float32)) is None


def test_a_circular_fisheye_is_stitched_and_calibrated(tmp_path: Path) -> None:
    """Of 150 degrees: one plus λ in the frame of the image's corners would be below zero."""
    lens = FisheyeLens((480, 360), 165.0 / np.radians(75.0), offset=(4.0, -2.0), image_circle=165.0)
    poses = grid_poses(lens, 3, 3, overlap=0.88, yaw=np.pi, tilt=(0.03, -0.02), seed=3)
    sequence = sequence_over(lambda size: ground(size, 3, channels=1), lens, poses)
    files = sequence.write(tmp_path)
    result = rdstitch.mosaic(files)
    alignment = result.registration.alignment
    assert alignment.used.all()
    camera = alignment.cameras[0]
    assert camera.image_circle == pytest.approx(0.97 * 165.0, abs=2.0)
    assert camera.center == pytest.approx(lens.center, abs=0.3)
    inner = lens.center + 155.0 * np.array([(np.cos(a), np.sin(a)) for a in np.linspace(0.0, 6.0, 9)])
    ratio = np.linalg.norm(camera.undistort(inner) - camera.center, axis=1) / np.linalg.norm(
        lens.undistort(inner) - lens.center, axis=1
    )
    assert ratio == pytest.approx(ratio.mean(), rel=0.02)
    error = registration_error(result.registration.alignment, sequence, "similarity")
    assert error.median < 0.3
    camera.save(tmp_path / "camera.json")
    again = rdstitch.Camera.load(tmp_path / "camera.json")
    assert again.image_circle == camera.image_circle
    given = rdstitch.mosaic(files, options=rdstitch.StitchOptions(camera=again)).registration.alignment
    assert given.used.all()
    assert given.cameras[0].coefficients == camera.coefficients


def test_a_second_run_decodes_nothing_to_find_the_circle(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    lens = FisheyeLens((240, 180), 83.0 / np.radians(75.0), image_circle=83.0)
    poses = grid_poses(lens, 2, 2, overlap=0.9, seed=3)
    files = sequence_over(lambda size: ground(size, 3, channels=1), lens, poses).write(tmp_path)
    decoded: list[Path] = []

    def counted(path: Path, *given: Any) -> DecodedImage:
        decoded.append(path)
        return read_image(path, *given)

    monkeypatch.setattr("rdstitch.inputs.source.read_image", counted)
    found = []
    for _ in range(2):
        sources, _ = read_sources(files, skip_bad=False)
        with ThreadPoolExecutor(1) as executor:
            found.append(with_image_circle(sources, executor, Cache.at(tmp_path / "cache"), InputGuard(), 0.6))
    assert decoded == files
    assert found[0] == found[1]
    assert found[0][0].camera.image_circle is not None
