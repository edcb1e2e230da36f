"""Frames registered as they arrive: each against the last keyframes, the last keyframes now and then among themselves.

Memory is bounded: images and matches are kept of the last keyframes only. What comes of it is for watching and
steering; loops are closed and every pair is used when the whole sequence is registered at the end.
"""

from rdstitch.tracking.placement import CameraPose, Placement, PlaneSimilarity
from rdstitch.tracking.preview import Preview
from rdstitch.tracking.tracked_frame import TrackingResult
from rdstitch.tracking.tracker import FrameTracker

__all__ = ["CameraPose", "FrameTracker", "Placement", "PlaneSimilarity", "Preview", "TrackingResult"]
