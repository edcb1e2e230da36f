"""The path of the camera, by its alignment and the wheel odometry of the same drive."""

import math
from collections.abc import Sequence

import numpy as np

from rdstitch.alignment.frames.quarter_turns import QuarterTurns
from rdstitch.errors import InputError
from rdstitch.inputs.frame import frame_numbers
from rdstitch.inputs.odometry import Odometry
from rdstitch.inputs.source import Source
from rdstitch.inputs.times import timestamps_of
from rdstitch.results.messages import Message, shortened
from rdstitch.results.registration import Registration
from rdstitch.trajectories.odometry_fit import along_odometry
from rdstitch.trajectories.trajectory import Trajectory
from rdstitch.verification.limits import Limits


def camera_path(
    registration: Registration, odometry: Odometry | None, height: float | None
) -> tuple[Trajectory, list[Message]]:
    """The path, labelled by the images, in units of ``height`` of the first image or of the odometry; with messages."""
    sources = registration.sources
    # Of the camera itself, whatever EXIF says of how its images are looked at.
    stored = QuarterTurns.of(sources).back.alignment(registration.alignment)
    path = Trajectory.from_alignment(stored, height or 1.0)
    if odometry is None:
        messages = focal_unknown("all lengths", path.length_std)
    else:
        path, messages = _along_odometry(path, sources, odometry, keep_unit=height is not None)
    numbers = frame_numbers([source.frame for source in sources])
    return path.labelled([source.name for source in sources], numbers, timestamps_of(sources)), messages


def _along_odometry(
    path: Trajectory, sources: Sequence[Source], odometry: Odometry, *, keep_unit: bool
) -> tuple[Trajectory, list[Message]]:
    """Fuse the path with odometry: its unit, unless ``keep_unit``, and poses of frames without one."""
    times = timestamps_of(sources)
    bodies = {k: body for k, time in enumerate(times.tolist()) if (body := odometry.at(time)) is not None}
    if not bodies:
        first, last = odometry.times[[0, -1]].tolist()
        seen = times[np.isfinite(times)]
        of = f"those of the images are from {seen.min():.3f} to {seen.max():.3f} s" if len(seen) else "images have none"
        raise InputError(f"{odometry.name}: has times from {first:.3f} to {last:.3f} s, {of}; give --timestamps")
    along, messages = along_odometry(path, bodies, keep_unit=keep_unit), focal_unknown("all lengths", path.length_std)
    if along is None:
        return path, [
            *messages,
            Message(f"{odometry.name}: shows too few motions, or none, of the images that have a pose; it is not used"),
        ]
    whole, fit = along
    if not keep_unit:
        known, height_std = fit.length_std <= Limits.max_length_std, math.hypot(fit.length_std, path.length_std)
        height = f"{whole.height[0]:.4g} ± {height_std:.1%}"
        text = f"lengths are those of the odometry, ± {fit.length_std:.1%}: the camera is at {height}"
        advice = "" if known else "; look at its units and times, drive straight ahead too, or give --height"
        messages = [Message(f"{text}{advice}", severity="note" if known else "warning")]
    seen_frames = set(path.frame.tolist())
    if added := [sources[k].name for k in whole.frame.tolist() if k not in seen_frames]:
        messages.append(Message(f"placed by the odometry alone: {shortened(added)}", severity="note"))
    return whole, messages


def focal_unknown(lengths: str, std: float) -> list[Message]:
    """Warn if the focal length, and with it these lengths, is hardly known by the images."""
    if not std > Limits.max_length_std:
        return []
    text = f"{lengths} may be off together by {std:.0%}: the images hardly show the focal length; give --focal"
    return [Message(text, code="focal-unknown")]
