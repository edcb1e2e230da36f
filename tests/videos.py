"""Motion JPEG videos."""

from collections.abc import Iterable
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray


def write_video(file: Path, frames: Iterable[NDArray[np.uint8]], rate: float = 5.0) -> Path:
    """Write RGB or grey frames, so many a second; skips the test where this OpenCV writes no videos."""
    images = [cv2.cvtColor(k, cv2.COLOR_GRAY2BGR) if k.ndim == 2 else k[..., ::-1] for k in frames]
    writer = cv2.VideoWriter(str(file), cv2.VideoWriter.fourcc(*"MJPG"), rate, images[0].shape[1::-1])
    if not writer.isOpened():
        pytest.skip("this OpenCV writes no videos")
    for image in images:
        writer.write(np.ascontiguousarray(image))
    writer.release()
    return file
