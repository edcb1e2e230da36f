"""Strips of images over rough ground, as matches: links as two-view estimation makes them, and their truth."""

from dataclasses import dataclass, replace

import numpy as np

from examples.worlds.correspondences import stored
from rdstitch.alignment.result import Alignment
from rdstitch.arrays import FloatArray
from rdstitch.geometry.camera import Camera
from rdstitch.geometry.radial_homography import to_plane
from rdstitch.matching.links import Link
from rdstitch.matching.rough_ground import over_rough_ground
from rdstitch.matching.two_view import PairRegistration
from rdstitch.robust import EstimationOptions, PairMatches, estimate_radial_homographies
from rdstitch.synthetic import RELIEFS, RenderedSequence, blank, grid_poses, sequence_over

LENS = Camera((640, 480), -0.2, focal=520.0)
_MATCHES = 300
_NOISE = 0.3
"""Pixels, of each coordinate of a keypoint."""
_OPTIONS = EstimationOptions(select_below=50)


@dataclass(frozen=True)
class Strip:
    """Images in a row, each linked with the three after it."""

    truth: RenderedSequence  # not meant to be rendered
    distortion: float  # its λ
    cameras: list[Camera]  # without λ
    links: list[Link]

    def window(self, first: int, count: int) -> "Strip":
        """Some images that follow one another; their numbers stay."""
        inside = range(first, first + count)
        return replace(self, links=[k for k in self.links if k.image1 in inside and k.image2 in inside])


def strip(kind: str, height: float, seed: int, images: int) -> Strip:
    """A strip over ``kind`` of relief, or "flat", of so many heights of the camera; tilts differ by some degrees."""
    rng = np.random.default_rng((seed, 15))
    lens = Camera(LENS.image_size, float(rng.uniform(-0.3, 0.05)), focal=520.0)
    tilt = (float(rng.uniform(-0.06, 0.06)), float(rng.uniform(-0.06, 0.06)))
    poses = grid_poses(lens, images, 1, overlap=float(rng.uniform(0.6, 0.75)), shift=0.03, tilt=tilt, seed=seed)
    poses = poses.shaken(seed=seed, height=0.05, yaw=0.05, tilt=0.03)
    width = int(rng.integers(100, 500))
    relief = None if kind == "flat" else lambda size: RELIEFS[kind](size, seed, height=height * 520.0, width=width)
    truth = sequence_over(blank, lens, poses, relief=relief, seed=seed)
    pairs, matched = [], []
    for i in range(images):
        for j in range(i + 1, min(i + 4, images)):
            points1, points2 = _matches(truth, i, j, rng)
            if len(points1) >= _MATCHES // 5:
                pairs.append((i, j))
                own = Camera(lens.image_size).with_guessed_focal()
                matched.append(PairMatches(points1, points2, own, own, np.zeros(len(points1)), None))
    relations = estimate_radial_homographies(matched, _OPTIONS)
    registered = [
        PairRegistration(i, j, stored(found.points1, found.points2), relation)
        for (i, j), found, relation in zip(pairs, matched, relations, strict=True)
        if relation
    ]
    links = [pair.link() for pair in over_rough_ground(registered, _OPTIONS.threshold)]
    return Strip(truth, lens.distortion, [Camera(lens.image_size).with_guessed_focal() for _ in range(images)], links)


def _matches(truth: RenderedSequence, i: int, j: int, rng: np.random.Generator) -> tuple[FloatArray, FloatArray]:
    """Points of the ground that both images see, with noise; a tenth of them matched wrongly."""
    width, height = truth.lens.image_size
    points1 = rng.uniform((5.0, 5.0), (width - 6.0, height - 6.0), (_MATCHES, 2))
    points2 = truth.ground_to_image(j, truth.to_ground(i, points1))
    seen = ((points2 >= 0.0) & (points2 <= (width - 1.0, height - 1.0))).all(axis=1)
    points1, points2 = points1[seen], points2[seen]
    wrong = rng.random(len(points2)) < 0.1
    points2[wrong] = rng.uniform((0.0, 0.0), (width - 1.0, height - 1.0), (int(wrong.sum()), 2))
    return points1 + rng.normal(0.0, _NOISE, points1.shape), points2 + rng.normal(0.0, _NOISE, points2.shape)


def displacement(item: Strip, found: Alignment) -> float:
    """Largest distance of an image's centre from the truth, after a similarity, as a share of the strip's length."""
    used = np.flatnonzero(found.used).tolist()
    centre = np.array([[(n - 1) / 2 for n in LENS.image_size]])
    true = np.concatenate([item.truth.to_plane(k, centre) for k in used])
    placed = np.concatenate([to_plane(found.cameras[k], found.homographies[k], centre) for k in used])
    a, b = (points[:, 0] + 1j * points[:, 1] for points in (placed, true))
    a, b = a - a.mean(), b - b.mean()
    if not np.isfinite(a).all():
        return float("inf")
    return float(np.abs(b - np.vdot(a, b) / np.vdot(a, a) * a).max() / np.abs(b[:, None] - b).max())
