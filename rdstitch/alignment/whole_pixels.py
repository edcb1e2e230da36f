"""Scans, screenshots and crops of one image: what was moved by whole pixels is put together without resampling."""

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from rdstitch.alignment.result import Alignment
from rdstitch.arrays import FloatArray
from rdstitch.geometry.camera import Camera
from rdstitch.matching.match_graph import spanning_forest, spanning_tree
from rdstitch.matching.two_view import PairRegistration
from rdstitch.numerics.robust_loss import RAYLEIGH_MEDIAN
from rdstitch.robust.posterior import Evidence

_RESOLVED = 0.1  # standard deviation of the shift of a pair, pixels, up to which its matches can say that it is whole
_FREEDOM = 4  # parameters of an image that whole pixels take the place of: two of the shift, turn and scale
_UPRIGHT = 0.01  # largest turn of the reference image in the output, radians, where that can be its frame
_REASON = "moved by whole pixels, as parts of one image are"


def on_whole_pixels(alignment: Alignment, pairs: Sequence[PairRegistration]) -> Alignment:
    """The same alignment of some pairs, by whole pixels and without a lens where that explains their matches as well.

    They are compared by their posterior, and the shifts of pairs must agree in every loop. A lens that was given, and a
    turn on the spot, stay.
    """
    given = alignment.lens_given and any(any(camera.coefficients) for camera in alignment.cameras)
    whole = None if alignment.on_sphere or given else _whole_shifts(alignment, pairs)
    frame = alignment.homographies[alignment.reference] / alignment.homographies[alignment.reference][2, 2]
    linear = frame[:2, :2] - np.outer(frame[:2, 2], frame[2, :2])
    unit = math.sqrt(abs(float(np.linalg.det(linear))))
    if whole is None or np.abs(linear / unit - np.eye(2)).max() > _UPRIGHT:
        return alignment
    # What was found of a camera over a plane is no property of a cut-out.
    cameras = tuple(Camera(c.image_size) for c in alignment.cameras)
    reference, homographies = cameras[alignment.reference], np.full_like(alignment.homographies, np.nan)
    for index, shift in zip(np.flatnonzero(alignment.used), whole, strict=True):
        camera = cameras[index]
        middle = (shift + camera.center - reference.center) / reference.scale
        homographies[index] = np.diag([unit * camera.scale / reference.scale] * 2 + [1.0])
        homographies[index][:2, 2] = frame[:2, 2] + unit * middle
    return replace(
        alignment,
        cameras=cameras,
        homographies=homographies,
        model="rigid",
        model_reason=f"rigid: {_REASON}",
        poses=None,
        tilt_spread=0.0,
        lens="division",
        lens_reason=_REASON,
        parameters=(),
        covariance=np.empty((0, 0)),
    )


def _whole_shifts(alignment: Alignment, pairs: Sequence[PairRegistration]) -> FloatArray | None:
    """Where the images that are used begin in the reference image, (N, 2); None unless whole pixels fit."""
    holding = {fit.images for fit in alignment.holding}
    number = np.cumsum(alignment.used) - 1
    numbers, shifts, spread, residuals = [], [], [], []
    for pair in pairs:
        if pair.images not in holding:
            continue
        link = pair.link()
        moved = link.points1 - link.points2
        shift = np.rint(np.median(moved, axis=0))
        expected = alignment.transfer(pair.image1, pair.image2, link.points1)
        whole, fitted = moved - shift, np.nan_to_num(expected - link.points2)  # 0 where a lens cannot see them
        # Of most sets the first pair already says no.
        if np.median(np.linalg.norm(whole, axis=1)) > 0.5 + np.median(np.linalg.norm(fitted, axis=1)):
            return None
        numbers.append((number[pair.image1], number[pair.image2]))
        shifts.append(shift)
        spread.append(float(np.median(np.linalg.norm(fitted, axis=1))) / RAYLEIGH_MEDIAN / math.sqrt(len(moved)))
        residuals.append((link.points1, whole, fitted))
    if not numbers or max(spread) > _RESOLVED:
        return None
    first, second = np.array(numbers, dtype=np.intp).T
    count, weight = int(alignment.used.sum()), np.ones(len(first))
    if len(spanning_forest(count, first, second, weight)) < count - 1:  # an image is held by none of them
        return None
    motions = np.tile(np.eye(3), (len(first), 1, 1))
    motions[:, :2, 2] = shifts
    root = int(number[alignment.reference])
    tree = spanning_tree(count, first, second, weight, root)
    places = np.rint(tree.chained(motions, first, np.eye(3))[:, :2, 2])
    if (places[second] - places[first] != shifts).any():
        return None
    points, whole, fitted = (np.concatenate(parts) for parts in zip(*residuals, strict=True))
    evidence = Evidence.of(
        np.repeat(np.arange(len(residuals)), [len(part) for part, *_ in residuals]),
        points,
        np.zeros(len(residuals), dtype=np.intp),
        np.array([float(np.median(np.linalg.norm(fitted, axis=1))) / RAYLEIGH_MEDIAN]),
        np.array([alignment.cameras[alignment.reference].scale]),
        np.array([min(1.0, (len(places) - 1) / len(residuals))]),
    )
    by_model = evidence.cost(fitted, _FREEDOM * (len(places) - 1))
    return places if evidence.cost(whole, 0)[0] <= by_model[0] else None
