"""A calibration of another program is exact: images are resampled to the coefficients that stand for it."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from rdstitch.arrays import FloatArray
from rdstitch.camera_files import load_camera, read_camera_file
from rdstitch.errors import OutputError
from rdstitch.geometry.exif_orientation import turning_matrix
from rdstitch.inputs.source import read_sources
from rdstitch.io.write import write_image
from rdstitch.options.stitch_options import StitchOptions
from rdstitch.pipeline.inputs.camera_and_odometry import with_camera
from rdstitch.pipeline.recipes import mosaic

K, D = [214.0, 0.0, 156.8, 0.0, 216.0, 122.6, 0.0, 0.0, 1.0], [-0.29, 0.09, -0.0009, 0.0008, -0.0135]
EQUIDISTANT = [-0.01, 0.03, -0.02, 0.004]


def echoed(folder: Path, model: str, d: list[float]) -> Path:
    """As ``ros2 topic echo --once camera_info`` prints it."""
    lists = "".join(f"{key}:\n" + "".join(f"- {value}\n" for value in values) for key, values in (("d", d), ("k", K)))
    file = folder / "camera_info.yaml"
    file.write_text(f"header:\n  frame_id: floor\nheight: 240\nwidth: 320\ndistortion_model: {model}\n{lists}---\n")
    return file


def pattern(points: FloatArray) -> FloatArray:
    """Grey values of a smooth scene at undistorted pixels (..., 2)."""
    x, y = np.moveaxis(points, -1, 0)
    return np.asarray(127.0 + 60.0 * np.sin(x / 7.0 + 1.0) * np.cos(y / 6.0) + 40.0 * np.cos((x + 2.0 * y) / 11.0))


@pytest.mark.parametrize("reduction", [1, 2])
def test_images_with_tangential_terms_become_those_of_the_coefficients(tmp_path: Path, reduction: int) -> None:
    camera = load_camera(echoed(tmp_path, "plumb_bob", D))
    assert camera.lens_model is not None
    pixels = np.stack(np.meshgrid(np.arange(320.0), np.arange(240.0)), axis=-1)
    write_image(tmp_path / "a.png", np.round(pattern(camera.lens_model.undistort(pixels))).astype(np.uint8))
    (source,), _ = read_sources([tmp_path / "a.png"], camera=camera, skip_bad=False)
    image = source.read(reduction)
    blocks = pixels[: 240 // reduction, : 320 // reduction] * reduction + (reduction - 1) / 2
    opaque = np.full(blocks.shape[:2], 255) if image.alpha is None else image.alpha
    error = (image.pixels - pattern(camera.undistort(blocks)))[opaque > 0]
    assert (opaque > 0).mean() > 0.95
    assert np.sqrt(np.mean(error**2)) < 0.7 * reduction**2
    unlike = image.pixels - pattern(replace(camera, lens_model=None).undistort(blocks))
    np.testing.assert_array_equal(unlike[opaque > 0], error)
    uncorrected = read_sources([tmp_path / "a.png"], camera=replace(camera, lens_model=None), skip_bad=False)[0][0]
    assert np.abs(uncorrected.read(reduction).pixels - pattern(camera.undistort(blocks))).max() > 20.0


@pytest.mark.parametrize(("model", "d"), [("plumb_bob", D), ("equidistant", EQUIDISTANT)])
def test_the_lens_goes_with_its_camera_everywhere(tmp_path: Path, model: str, d: list[float]) -> None:
    file = echoed(tmp_path, model, d)
    camera = load_camera(file)
    for named in (file, str(file)):
        with pytest.raises(OutputError, match="is read as input"):
            mosaic(
                [np.zeros((60, 80, 3), np.uint8)] * 2,
                options=StitchOptions(camera=named, save_camera=Path(named), overwrite=True),
            )
        assert with_camera(StitchOptions(camera=named), of_bag=False)[0].known_camera == camera
    camera.save(tmp_path / "own.json")
    assert read_camera_file(tmp_path / "own.json").camera.lens_model == camera.lens_model
    points = np.array([[10.0, 20.0], [300.0, 200.0], [160.0, 10.0]])
    seen = camera.lens_model.distort(points)
    large = camera.resized((640, 480))
    np.testing.assert_allclose((large.lens_model.distort(points * 2 + 0.5) - 0.5) / 2, seen, atol=1e-9)
    for orientation in range(2, 9):
        turned, matrix = camera.turned(orientation), turning_matrix(orientation)
        middle, after = (np.array([319.0, 239.0]) / 2, (np.array(turned.image_size) - 1.0) / 2)
        np.testing.assert_allclose(
            turned.lens_model.distort((points - middle) @ matrix.T + after),
            (seen - middle) @ matrix.T + after,
            atol=1e-9,
        )
