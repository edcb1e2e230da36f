"""Odometry of a camera that looks down: frames from a camera, video or folder, as nav_msgs/Odometry of ROS 2.

    python -m examples.odometry SOURCE --height METRES [--std METRES]

With ROS 2's ``rclpy`` messages are published on ``/odom``; without it the same fields are printed as lines of JSON.
The tracker does not say how sure a position is: ``--std`` does, measured on a drive whose end is known.
"""

import argparse
import json
import math
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np

import rdstitch


def odometry(pose: rdstitch.Pose, std: float) -> dict[str, Any]:
    """A pose as the fields of nav_msgs/Odometry, by REP 103: x to the right and y to the top of the first frame."""
    assert pose.position is not None
    assert pose.yaw is not None
    assert pose.tracked is not None
    # Where the track was lost a new map begins, which has neither place nor unit in common with the one before.
    frame = f"odom_{pose.tracked.map_number}"
    covariance = np.diag([std**2] * 3 + [1e6, 1e6, std**2])  # roll and pitch are not tracked
    return {
        "header": {"stamp": pose.timestamp, "frame_id": frame},
        "child_frame_id": "camera",
        "pose": {
            "pose": {
                "position": dict(zip("xyz", pose.position, strict=True)),
                "orientation": {"x": 0.0, "y": 0.0, "z": math.sin(pose.yaw / 2), "w": math.cos(pose.yaw / 2)},
            },
            "covariance": covariance.ravel().tolist(),
        },
    }


def publisher() -> Callable[[dict[str, Any]], None]:
    """What takes the fields of a message: ROS 2 where it is installed, else standard output."""
    try:
        import rclpy  # type: ignore[import-not-found]
        from nav_msgs.msg import Odometry  # type: ignore[import-not-found]
        from rosidl_runtime_py import set_message_fields  # type: ignore[import-not-found]
    except ImportError:
        return lambda fields: print(json.dumps(fields), flush=True)
    rclpy.init()
    topic = rclpy.create_node("rdstitch").create_publisher(Odometry, "odom", 10)

    def publish(fields: dict[str, Any]) -> None:
        message = Odometry()
        seconds = fields["header"].pop("stamp")
        set_message_fields(message, fields)
        message.header.stamp.sec, message.header.stamp.nanosec = int(seconds), int(seconds % 1 * 1e9)
        topic.publish(message)

    return publish


def frames(source: str) -> Iterator[tuple[Any, float]]:
    """Images and their times, s, of a folder (ten a second), a video, or a camera by its index."""
    if Path(source).is_dir():
        yield from ((path, 0.1 * k) for k, path in enumerate(sorted(Path(source).iterdir())))
        return
    video = cv2.VideoCapture(int(source) if source.isdigit() else source)
    while (read := video.read())[0]:
        yield read[1], video.get(cv2.CAP_PROP_POS_MSEC) / 1e3


def main(arguments: list[str] | None = None) -> None:
    """Publish what the tracker finds."""
    parser = argparse.ArgumentParser(description="Odometry of a camera that looks down")
    parser.add_argument("source", help="folder, video, or index of a camera")
    parser.add_argument("--height", type=float, required=True, help="of the camera above the floor, metres")
    parser.add_argument("--std", type=float, default=0.05, help="standard deviation, metres and radians")
    given = parser.parse_args(arguments)
    publish, tracker = publisher(), rdstitch.Tracker(poses=rdstitch.FollowedPoses(given.height))
    for image, timestamp in frames(given.source):
        pose = tracker.add(image, timestamp)
        if pose:
            publish(odometry(pose, given.std))


if __name__ == "__main__":
    main()
