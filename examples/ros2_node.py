"""Odometry of a camera that looks down, as a node of ROS 2.

``python -m examples.ros2_node --ros-args -p height:=0.42``

Takes images of ``image_raw`` and the calibration of ``camera_info`` (or the parameter ``camera``, a camera file), gives
``odom`` (``nav_msgs/Odometry``) and the transform ``odom`` → ``camera_footprint`` by REP 105. :func:`odometry` and
:func:`pixels` know nothing of ROS.
"""

import math
from argparse import ArgumentParser, RawDescriptionHelpFormatter
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
from numpy.typing import NDArray

import rdstitch
from rdstitch.camera_files import camera_of_content

if TYPE_CHECKING:
    from rdstitch.geometry.camera import Camera


class ImageMessage(Protocol):
    """What is used of sensor_msgs/Image."""

    height: int
    width: int
    step: int
    encoding: str
    data: Any


def pixels(message: ImageMessage) -> NDArray[np.uint8]:
    """The pixels of a message, grey or BGR."""
    rows = np.frombuffer(bytes(message.data), np.uint8).reshape(message.height, message.step)
    channels = {"mono8": 1, "bgr8": 3, "rgb8": 3}[message.encoding]
    image = rows[:, : message.width * channels].reshape(message.height, message.width, channels)
    return image[..., ::-1] if message.encoding == "rgb8" else image


def camera_of(info: Any) -> "Camera":
    """The camera of a sensor_msgs/CameraInfo."""
    fields = {"width": info.width, "height": info.height, "distortion_model": info.distortion_model}
    return camera_of_content(fields | {"k": list(info.k), "d": list(info.d)}, "camera_info").camera


def odometry(pose: rdstitch.Pose) -> dict[str, Any]:
    """A pose of a tracker with the frame "ros" as the fields of nav_msgs/Odometry, without its stamp."""
    assert pose.position is not None
    assert pose.yaw is not None
    known = pose.ros_covariance
    covariance = np.diag(np.full(6, 1e6)) if known is None else known
    # Where the track was lost a new map begins, which has no place in common with the one before.
    frame = "odom" if not pose.map else f"odom_{pose.map}"
    x, y, z = pose.position
    return {
        "header": {"frame_id": frame},
        "child_frame_id": "camera_footprint",
        "pose": {
            "pose": {
                "position": {"x": x, "y": y, "z": z},
                "orientation": {"x": 0.0, "y": 0.0, "z": math.sin(pose.yaw / 2), "w": math.cos(pose.yaw / 2)},
            },
            "covariance": covariance.ravel().tolist(),
        },
    }


def main() -> None:
    """Run the node."""
    ArgumentParser(description=__doc__, formatter_class=RawDescriptionHelpFormatter).parse_known_args()
    import rclpy  # type: ignore[import-not-found]
    from geometry_msgs.msg import TransformStamped  # type: ignore[import-not-found]
    from nav_msgs.msg import Odometry  # type: ignore[import-not-found]
    from rclpy.node import Node  # type: ignore[import-not-found]
    from rosidl_runtime_py import set_message_fields  # type: ignore[import-not-found]
    from sensor_msgs.msg import CameraInfo, Image  # type: ignore[import-not-found]
    from tf2_ros import TransformBroadcaster  # type: ignore[import-not-found]

    rclpy.init()
    node = Node("rdstitch")
    height = node.declare_parameter("height", 1.0).value
    file = node.declare_parameter("camera", "").value
    tilt = node.declare_parameter("tilt", [math.nan, math.nan]).value  # radians
    known: dict[str, Any] = {} if math.isnan(tilt[0]) else {"tilt": tuple(tilt)}
    tracker: list[rdstitch.Tracker] = []

    def begin(camera: "Camera | Path") -> None:
        options = rdstitch.StitchOptions(camera=camera, **known)
        tracker[:] = [rdstitch.Tracker(options, rdstitch.FollowedPoses(height, "ros"))]

    def on_camera_info(info: Any) -> None:
        if not tracker:
            begin(camera_of(info))

    topic, transforms = node.create_publisher(Odometry, "odom", 10), TransformBroadcaster(node)

    def on_image(message: Any) -> None:
        if not tracker:
            return
        stamp = message.header.stamp
        pose = tracker[0].add(pixels(message), stamp.sec + stamp.nanosec * 1e-9)
        for told in pose.messages:
            node.get_logger().warning(str(told))
        if not pose:
            node.get_logger().info(pose.reason, throttle_duration_sec=1.0)
            return
        odom, transform = Odometry(), TransformStamped()
        set_message_fields(odom, odometry(pose))
        odom.header.stamp = transform.header.stamp = stamp
        topic.publish(odom)
        transform.header.frame_id, transform.child_frame_id = odom.header.frame_id, odom.child_frame_id
        at, place = odom.pose.pose, transform.transform.translation
        place.x, place.y, place.z = at.position.x, at.position.y, 0.0
        transform.transform.rotation = at.orientation
        transforms.sendTransform(transform)

    if file:
        begin(Path(file))
    node.create_subscription(CameraInfo, "camera_info", on_camera_info, 1)
    node.create_subscription(Image, "image_raw", on_image, 1)
    rclpy.spin(node)


if __name__ == "__main__":
    main()
