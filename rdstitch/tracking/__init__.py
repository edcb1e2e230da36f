"""Frames registered as they arrive: each against the last keyframes, the last keyframes now and then among themselves.

Memory is bounded: images and matches are kept of the last keyframes only. What comes of it is for watching and
steering; loops are closed and every pair is used when the whole sequence is registered at the end.

Constants that say what other values give were changed alone, over twelve drives of :mod:`examples.benchmarks.robot`: 26
frames, seeds 3 and 4, without tilt or camera, with bumper, poor floor, wrong focal length, late IMU. As they are, the
rms error of positions is 2.5 mm at a height of 400 mm, and their squared errors are 0.97 variances (NEES), none beyond
3.9 σ. Other constants are unmeasured.
"""

from rdstitch.tracking.placement import CameraPose, Placement, PlaneSimilarity
from rdstitch.tracking.preview import Preview
from rdstitch.tracking.tracked_frame import TrackingResult
from rdstitch.tracking.tracker import FrameTracker

__all__ = ["CameraPose", "FrameTracker", "Placement", "PlaneSimilarity", "Preview", "TrackingResult"]
