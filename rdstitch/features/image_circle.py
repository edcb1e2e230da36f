"""The circle that a fisheye lens shows of the world, dark around it."""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from rdstitch.arrays import FloatArray

_DARK = 0.1  # of the brightest twentieth, up to which a pixel is dark: a surround has stray light, and noise
_TOLERANCE = 0.01  # of the radius that the edge of the circle may be off: JPEG files and blurred rims
_MIN_ARC = 0.5  # fraction of the circle that has to be seen: longer sides may cut off the rest


@dataclass(frozen=True)
class Circle:
    """A circle, pixels: (x, y) of its centre, and its radius."""

    center: tuple[float, float]
    radius: float


def find_circle(grey: NDArray[np.float32]) -> Circle | None:
    """Find the circle outside which an image (h, w) is dark, up to all four corners; None where there is none."""
    black = min(float(grey.min()), 0.0)  # of samples with a sign the lowest
    dark = grey - black <= _DARK * (float(np.quantile(grey, 0.95)) - black)
    height, width = grey.shape
    if not dark[[0, 0, -1, -1], [0, -1, 0, -1]].all():
        return None
    _, labels = cv2.connectedComponents(dark.astype(np.uint8))
    surround = np.isin(labels, labels[[0, 0, -1, -1], [0, -1, 0, -1]])
    contours, _ = cv2.findContours((~surround).astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    if not contours:
        return None
    edge = max(contours, key=len)[:, 0].astype(np.float64)
    inner = (edge > 1.0).all(axis=1) & (edge < np.array([width, height]) - 2.0).all(axis=1)
    return _circle_through(edge[inner])


def _circle_through(points: FloatArray) -> Circle | None:
    """The circle on which nearly all points (N, 2) lie, around most of it."""
    if len(points) < 8:
        return None
    chosen = np.ones(len(points), dtype=np.bool_)
    for _ in range(3):
        x, y = points[chosen].T
        (a, b, c), *_ = np.linalg.lstsq(np.stack([2 * x, 2 * y, np.ones_like(x)], axis=1), x**2 + y**2, rcond=None)
        radius = float(np.sqrt(max(c + a * a + b * b, 0.0)))
        off = np.abs(np.hypot(*(points - (a, b)).T) - radius)
        chosen = off <= _TOLERANCE * radius + 1.0
        if chosen.mean() < 0.9:
            return None
    angles = np.arctan2(*(points[chosen] - (a, b)).T)
    seen = len(np.unique(np.floor(angles / np.radians(5.0)))) / 72.0
    return Circle((float(a), float(b)), radius) if seen >= _MIN_ARC else None
