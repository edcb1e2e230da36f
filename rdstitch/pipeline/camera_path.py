"""The path of the camera, from where its images lie."""

from pathlib import Path

from rdstitch.alignment.frames.quarter_turns import QuarterTurns
from rdstitch.alignment.trajectory import Trajectory
from rdstitch.inputs.odometry import Odometry
from rdstitch.inputs.times import timestamps_of
from rdstitch.pipeline.along_odometry import along_odometry
from rdstitch.results.messages import Message
from rdstitch.results.registration import Registration


def camera_path(
    registration: Registration, odometry: Odometry | str | Path | None, height: float | None
) -> tuple[Trajectory, list[Message]]:
    """The path with names, numbers and times of the images; and what odometry, if it was given, has shown of it.

    ``height`` of the first image over the plane, in the unit of the path, where that is not one or the odometry's.
    """
    sources, messages = registration.sources, list[Message]()
    # Of the camera itself, whatever EXIF says of how its images are looked at.
    stored = QuarterTurns.of(sources).back.alignment(registration.alignment)
    path = Trajectory.from_alignment(stored, height or 1.0)
    if odometry is not None:
        path, messages = along_odometry(path, sources, odometry, keep_unit=height is not None)
    numbers = [source.number(k) for k, source in enumerate(sources)]
    return path.labelled([source.name for source in sources], numbers, timestamps_of(sources)), messages
