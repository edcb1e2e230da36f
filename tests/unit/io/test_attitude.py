"""Attitudes in XMP: every maker's convention against a camera whose rotation is known; what is none."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from PIL.PngImagePlugin import PngInfo

from examples.worlds.drone_xmp import DIALECTS, euler_angles, xmp_of
from rdstitch.geometry.exif_orientation import turned, turning_matrix
from rdstitch.geometry.planar_motion import tilt_from_normal
from rdstitch.io.attitude import CONVENTIONS, Attitude, read_attitude
from rdstitch.io.metadata import Metadata, read_metadata
from rdstitch.synthetic import Poses

DJI, PARROT, PIX4D = CONVENTIONS.values()


@pytest.mark.parametrize("source", DIALECTS)
@pytest.mark.parametrize("element", [False, True])
def test_the_tilt_of_a_known_camera(source: str, element: bool) -> None:
    rng = np.random.default_rng(1)
    poses = Poses.of(np.zeros((40, 2)), 100.0).shaken(seed=2, yaw=np.pi, tilt=0.6)
    for rotation, tilt in zip(poses.from_plane()[:, :, :2], poses.tilt, strict=True):
        yaw, pitch, roll = euler_angles(source, rotation, north=rng.uniform(-np.pi, np.pi))
        found = read_attitude(xmp_of(source, yaw, pitch, roll, element=element))
        assert found == Attitude(found.yaw, found.pitch, found.roll, CONVENTIONS[source])
        np.testing.assert_allclose(tilt_from_normal(found.nadir), tilt, atol=1e-6)


def test_signs_and_what_points_straight_down_or_past_it() -> None:
    """Who looks a little ahead has the ground below him towards the bottom of the image."""
    for yaw, roll in ((0.0, 0.0), (77.0, 0.0), (-120.0, 35.0), (10.0, 180.0)):
        np.testing.assert_allclose(Attitude(yaw, -90.0, roll, DJI).nadir, (0.0, 0.0, 1.0), atol=1e-12)
    # DJI writes pitch -90.1 as -89.9, turned about: yaw and roll half a turn on.
    past, written = (
        Attitude(14.4, -90.1, 0.0, DJI),
        Attitude(-165.6, -89.9, 180.0, DJI),
    )
    np.testing.assert_allclose(written.nadir, past.nadir, atol=1e-12)
    assert written.nadir[1] < 0.0
    c, s = np.cos(np.radians(10.0)), np.sin(np.radians(10.0))
    for ahead in (
        Attitude(50.0, -80.0, 0.0, DJI),
        Attitude(50.0, 10.0, 0.0, PIX4D),
    ):
        np.testing.assert_allclose(ahead.nadir, (0.0, s, c), atol=1e-12)
    # The drone's right side hangs down, and the ground below lies towards the image's right.
    np.testing.assert_allclose(Attitude(50.0, 0.0, 10.0, PIX4D).nadir, (s, 0.0, c), atol=1e-12)


@pytest.mark.parametrize("orientation", range(1, 9))
def test_directions_turn_with_the_image(orientation: int) -> None:
    attitude = Attitude(0.0, 10.0, 20.0, PIX4D)
    x, y, ahead = attitude.nadir
    rows, columns = np.mgrid[0:3, 0:4]
    slope = np.gradient(turned(x * columns + y * rows, orientation))
    assert turning_matrix(orientation) @ (x, y) == pytest.approx((slope[1][0, 0], slope[0][0, 0]))
    metadata = Metadata((4, 3), orientation=orientation, attitude=attitude)
    assert metadata.nadir == pytest.approx((slope[1][0, 0], slope[0][0, 0], ahead))


@pytest.mark.parametrize(
    "xmp",
    [
        "",
        "no XML at all",
        '<rdf:Description drone-dji:GimbalYawDegree="1" drone-dji:GimbalPitchDegree="-90"/>',
        '<rdf:Description Camera:Yaw="1" Camera:Pitch="much" Camera:Roll="0"/>',
        '<rdf:Description Camera:Yaw="1" Camera:Pitch="nan" Camera:Roll="0"/>',
        "<Camera:Yaw>1</Camera:Yaw><Camera:Pitch>2</Camera:Pitch><Camera:Roll>3",
        # Of the light sensor, in radians, and of the drone: neither is the camera's.
        "<DLS:Yaw>0.1</DLS:Yaw><DLS:Pitch>0.2</DLS:Pitch><DLS:Roll>0.3</DLS:Roll>",
        '<x drone-dji:FlightYawDegree="1" drone-dji:FlightPitchDegree="2" drone-dji:FlightRollDegree="3"/>',
        '<!DOCTYPE x [<!ENTITY a "1">]><Camera:Yaw>&a;</Camera:Yaw><Camera:Pitch>&a;</Camera:Pitch>'
        "<Camera:Roll>&a;</Camera:Roll>",
    ],
)
def test_what_is_no_attitude_of_the_camera(xmp: str) -> None:
    assert read_attitude(xmp) is None


def test_broken_xmp_with_whole_numbers_is_read() -> None:
    found = read_attitude("\x00<rdf:RDF" + xmp_of("dji-gimbal", 1.5, -88.0, 0.25) + "</nothing>")
    assert found == Attitude(1.5, -88.0, 0.25, DJI)


def test_every_format_that_carries_it(tmp_path: Path) -> None:
    xmp = xmp_of("parrot-camera", 1.5, -88.0, 0.25)
    text = PngInfo()
    text.add_itxt("XML:com.adobe.xmp", xmp)
    carriers: dict[str, dict[str, Any]] = {
        "a.jpg": {"xmp": xmp.encode()},
        "a.webp": {"xmp": xmp.encode()},
        "a.png": {"pnginfo": text},
        "a.tif": {"tiffinfo": {700: xmp.encode()}},
    }
    for name, options in carriers.items():
        Image.new("L", (8, 8)).save(tmp_path / name, **options)
        assert read_metadata(tmp_path / name).attitude == Attitude(1.5, -88.0, 0.25, PARROT), name
