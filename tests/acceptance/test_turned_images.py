"""Images with EXIF orientations: the lens, whose centre is off the middle, belongs to the stored frame."""

from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import rdstitch
from examples.judging import AlignmentError, alignment_error
from rdstitch.arrays import FloatArray
from rdstitch.geometry.camera import Camera
from rdstitch.geometry.exif_orientation import turned, turning_matrix
from rdstitch.geometry.radial_homography import to_plane
from rdstitch.io.read import read_image
from rdstitch.synthetic import Photometry, RenderedSequence, grid_poses, ground, sequence_over
from tests.sampled import sampled

LENS = Camera((480, 360), -0.25, center=(244.5, 175.5), focal=400.0)
PROPER, MIRRORED, ALL = (1, 6, 3, 8, 6, 1, 8, 3), (2, 5, 4, 7, 5, 2, 7, 4), (1, 2, 3, 4, 5, 6, 7, 8)
MIRROR = 2


@pytest.fixture(scope="module")
def sequence() -> RenderedSequence:
    poses = grid_poses(LENS, 4, 2, overlap=0.5, tilt=(0.05, -0.03), yaw=0.2, seed=4)
    return sequence_over(partial(ground, seed=4), LENS, poses, photometry=Photometry(noise=0.005), seed=4)


def is_mirrored(orientation: int) -> bool:
    return bool(np.linalg.det(turning_matrix(orientation)) < 0.0)


def written(sequence: RenderedSequence, orientations: tuple[int, ...], folder: Path) -> list[Path]:
    """Images as a camera stores them whose lens bends the stored frame."""
    folder.mkdir()
    files = []
    mirror = replace(sequence, lens=LENS.turned(MIRROR))
    for index, orientation in enumerate(orientations):
        samples = turned(mirror.frame(index), MIRROR) if is_mirrored(orientation) else sequence.frame(index)
        exif = Image.Exif()
        exif[0x0112] = orientation
        files.append(folder / f"{index}.png")
        Image.fromarray(np.ascontiguousarray(samples)).save(files[-1], exif=exif)
    return files


def in_upright(points: FloatArray, orientation: int) -> FloatArray:
    """Pixels of the camera's view to those of the image as it is read."""
    plain = Camera(LENS.image_size)
    stored = plain.normalize(points) @ (turning_matrix(MIRROR) if is_mirrored(orientation) else np.eye(2))
    return plain.turned(orientation).denormalize(stored @ turning_matrix(orientation).T)


def errors_of(
    sequence: RenderedSequence, orientations: tuple[int, ...], result: rdstitch.StitchResult
) -> list[AlignmentError]:
    """Of the images that are not mirrored, and of those that are."""
    alignment = result.registration.alignment
    assert alignment.used.all()
    to_output = result.canvas.matrix @ alignment.homographies

    def place(index: int, points: FloatArray) -> FloatArray:
        own = in_upright(points, orientations[index])
        return to_plane(alignment.cameras[index], to_output[index], own)

    found = []
    for mirrored, seen in ((False, sequence), (True, replace(sequence, lens=LENS.turned(MIRROR)))):
        own = {k: partial(place, k) for k, value in enumerate(orientations) if is_mirrored(value) == mirrored}
        found += [alignment_error(seen, own, model="similarity")] if own else []
    return found


@pytest.mark.parametrize("orientations", [MIRRORED, pytest.param(PROPER, marks=pytest.mark.slow)])
def test_a_mosaic_finds_the_stored_lens(
    sequence: RenderedSequence, orientations: tuple[int, ...], tmp_path: Path
) -> None:
    files = written(sequence, orientations, tmp_path / "frames")
    options = rdstitch.StitchOptions(save_camera=tmp_path / "camera.json")
    result = rdstitch.mosaic(files, tmp_path / "out.png", options)
    for error in errors_of(sequence, orientations, result):
        assert error.median < 0.1
        assert error.max < 0.3
    saved = rdstitch.load_camera(tmp_path / "camera.json")
    assert saved.image_size == LENS.image_size
    assert np.abs(np.subtract(saved.center, LENS.center)).max() < 0.5


@pytest.mark.parametrize("orientations", [ALL, pytest.param(PROPER, marks=pytest.mark.slow)])
def test_a_camera_file_is_of_the_stored_frame(
    sequence: RenderedSequence, orientations: tuple[int, ...], tmp_path: Path
) -> None:
    files = written(sequence, orientations, tmp_path / "frames")
    LENS.save(tmp_path / "camera.json")
    options = rdstitch.StitchOptions(camera=rdstitch.load_camera(tmp_path / "camera.json"), dry_run=True)
    result = rdstitch.mosaic(files, options=options)
    for error in errors_of(sequence, orientations, result):
        assert error.median < 0.1
        assert error.max < 0.3


def test_undistortion_turns_the_lens(sequence: RenderedSequence, tmp_path: Path) -> None:
    files = written(sequence, ALL, tmp_path / "frames")
    stored = [np.asarray(Image.open(file)) for file in files]
    expected = rdstitch.undistort(stored, camera=LENS, channel_order="rgb")
    found = rdstitch.undistort(files, tmp_path / "out", camera=LENS)
    for index, orientation in enumerate(ALL):
        difference = read_image(found[index]).pixels.astype(float) - turned(expected[index], orientation)
        assert np.abs(difference).max() <= 2.0


@pytest.mark.parametrize("orientation", sampled([6, 3, 8]))
def test_a_mosaic_stands_as_its_reference_image_does(
    sequence: RenderedSequence, orientation: int, tmp_path: Path
) -> None:
    orientations = (1, 1, 1, orientation)
    files = written(sequence, orientations, tmp_path / "frames")
    result = rdstitch.mosaic(files, options=rdstitch.StitchOptions(reference="3.png", dry_run=True))
    direction = result.registration.alignment.homographies[3][:2, :2] @ [0.0, 1.0]
    assert abs(np.degrees(np.arctan2(direction[0], direction[1]))) < 10.0
