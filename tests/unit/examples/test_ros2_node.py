"""The node of ROS 2, without ROS: images and calibrations of messages in, fields of odometry out."""

import math
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

import rdstitch
from examples.ros2_node import camera_of, odometry, pixels
from examples.worlds.floor_drives import DISTORTION, floor_drive, true_path


def test_images_of_messages_become_odometry_in_the_axes_of_ros() -> None:
    drive = floor_drive("turn", 6, seed=3, size=(320, 240), overlap=0.8)
    lens = {"width": 320, "height": 240, "distortion_model": "plumb_bob", "d": [0.0] * 5}
    info = SimpleNamespace(**lens, k=[256.0, 0.0, 159.5, 0.0, 256.0, 119.5, 0.0, 0.0, 1.0])
    assert camera_of(info).focal == 256.0
    camera = rdstitch.Camera((320, 240), DISTORTION, focal=256.0, focal_source="file")
    options = rdstitch.StitchOptions(camera=camera, tilt=(math.radians(3.0), math.radians(-2.0)))
    tracker = rdstitch.Tracker(options, rdstitch.FollowedPoses(0.4, "ros"))
    for index in range(6):
        rgb = np.ascontiguousarray(cv2.cvtColor(drive.frame(index), cv2.COLOR_BGR2RGB))
        padded = np.pad(rgb.reshape(240, -1), ((0, 0), (0, 8)))
        message = SimpleNamespace(height=240, width=320, step=968, encoding="rgb8", data=padded.tobytes())
        np.testing.assert_array_equal(pixels(message), drive.frame(index))
        pose = tracker.add(pixels(message), 0.1 * index)
    fields = odometry(pose)
    truth = true_path(drive)
    along = np.exp(1j * truth.yaw[0]) * 0.4 * complex(*(truth.position[5] - truth.position[0]))
    position, orientation = fields["pose"]["pose"]["position"], fields["pose"]["pose"]["orientation"]
    # The robot drives to the right of its image, which is to its right in ROS: -y.
    assert position["x"] == pytest.approx(-along.imag, abs=0.005)
    assert position["y"] == pytest.approx(-along.real, abs=0.005)
    assert position["z"] == pytest.approx(0.4, abs=0.001)
    assert 2.0 * math.atan2(orientation["z"], orientation["w"]) == pytest.approx(truth.yaw[5] - truth.yaw[0], abs=0.01)
    assert len(fields["pose"]["covariance"]) == 36
    assert fields["header"]["frame_id"] == "odom"
