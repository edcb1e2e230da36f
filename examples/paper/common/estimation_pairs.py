"""Pairs of images with a known map between them, to judge estimators of homographies under distortion.

Rendered ones, and planar scenes as in HPatches, to which division distortion is added.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import cv2
import numpy as np

from examples.judging.fitting import apply
from examples.paper.common.report import Pixels
from rdstitch.arrays import FloatArray
from rdstitch.features import FeatureOptions, detect, match
from rdstitch.geometry.camera import Camera
from rdstitch.io.read import read_image
from rdstitch.synthetic import Photometry, RenderedSequence, ground, pair_poses, sequence_over

_SUFFIXES = (".ppm", ".png", ".jpg")
_WARP = 0.25  # of the sides, by which corners of made scenes are moved


@dataclass(frozen=True)
class PlanarScene:
    """Images of one plane, taken without distortion."""

    images: Sequence[Callable[[], Pixels]]  # each gives one
    homographies: Sequence[FloatArray]  # from the first image to each, px; the first is the identity; shape (3, 3)


def read_scenes(folder: Path) -> list[PlanarScene]:
    """HPatches' folders: ``1.ppm`` and so on, and text files ``H_1_2`` and so on."""
    scenes = []
    for sub in sorted(path for path in folder.iterdir() if path.is_dir()):
        files = sorted(
            (p for p in sub.iterdir() if p.suffix in _SUFFIXES and p.stem.isdigit()), key=lambda p: int(p.stem)
        )
        known = [(file, sub / f"H_1_{file.stem}") for file in files[1:]]
        known = [(file, text) for file, text in known if text.is_file()]
        if known:
            readers = [partial(_read, file) for file in (files[0], *(file for file, _ in known))]
            scenes.append(PlanarScene(readers, [np.eye(3), *(np.loadtxt(text) for _, text in known)]))
    return scenes


def made_scenes(photo: Pixels | None, count: int, seed: int, size: tuple[int, int] = (640, 480)) -> list[PlanarScene]:
    """Scenes in the manner of HPatches: parts of a photo, or of a rendered ground, and strong warps of them."""
    scenes = []
    frame = np.array([(0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0)]) * (np.array(size) - 1.0)
    for number in range(count):
        rng = np.random.default_rng((seed, number))
        source = _ground(size, seed + number) if photo is None else photo
        room = np.array([source.shape[1], source.shape[0]]) - 2 * np.array(size)
        corner = np.array(size) / 2 + rng.uniform(0.0, 1.0, 2) * np.maximum(room, 0)
        seen = [frame + corner, frame + corner + rng.uniform(-_WARP, _WARP, (4, 2)) * np.array(size)]
        to_image = [_perspective(corners, frame) for corners in seen]
        warps = [partial(_warped, source, h, size) for h in to_image]
        scenes.append(PlanarScene(warps, [np.eye(3), to_image[1] @ np.linalg.inv(to_image[0])]))
    return scenes


def _perspective(source: FloatArray, target: FloatArray) -> FloatArray:
    """The homography of four points."""
    found = cv2.getPerspectiveTransform(source.astype(np.float32), target.astype(np.float32))
    return np.asarray(found, dtype=np.float64)


def _warped(source: Pixels, homography: FloatArray, size: tuple[int, int]) -> Pixels:
    return np.asarray(cv2.warpPerspective(source, homography, size, flags=cv2.INTER_AREA), dtype=np.uint8)


def _read(file: Path) -> Pixels:
    return np.asarray(read_image(file).pixels, dtype=np.uint8)


def _ground(size: tuple[int, int], seed: int) -> Pixels:
    width, height = (2 * extent for extent in size)
    values = ground((width, height), seed).region(0, 0, width, height)
    pixels: Pixels = np.rint(255.0 * values).astype(np.uint8).squeeze()
    return pixels


_GRID = (20, 15)
_FEATURES = FeatureOptions(max_features=1500)
_RATIO = 0.9  # loose, so that the estimators have something to do


@dataclass(frozen=True)
class JudgedPair:
    """Matches of two images of a plane through one lens, and where points truly go.

    ``points1``, ``points2``: matches, px; shape (N, 2). ``grid1``, ``grid2``: places all over what both images show, px
    in either; shape (M, 2).
    """

    points1: FloatArray
    points2: FloatArray
    image_size: tuple[int, int]  # of both images
    distortion: float  # true λ
    grid1: FloatArray
    grid2: FloatArray


def rendered_pairs(count: int, distortion: float, *, free: bool, seed: int) -> Iterator[JudgedPair]:
    """Pairs of a floor; λ is uniform from ``distortion`` to 0. Those that show nothing in common are left out.

    ``free``: the camera moves freely; a planar motion with one tilt otherwise.
    """
    for number in range(count):
        rng = np.random.default_rng((seed, number))
        lens = Camera((640, 480), rng.uniform(distortion, 0.0), focal=rng.uniform(450.0, 650.0), focal_source="option")
        psi, theta = rng.uniform(-0.1, 0.1, 2)
        poses = pair_poses(
            lens,
            rng.uniform(0.3, 0.6),
            yaw=rng.uniform(-np.pi, np.pi),
            direction=rng.uniform(-np.pi, np.pi),
            tilt=(float(psi), float(theta)),
        )
        if free:
            poses = poses.shaken(seed=number, height=0.15, tilt=0.15)
        photometry = Photometry(gain=np.array([1.0, 0.85]), vignetting=0.2, blur=0.5, noise=0.01)
        sequence = sequence_over(partial(ground, seed=seed + number), lens, poses, photometry=photometry, seed=number)
        pair = _judged(sequence.frame(0), sequence.frame(1), lens, partial(_over_the_plane, sequence))
        if len(pair.grid1):
            yield pair


def _over_the_plane(sequence: RenderedSequence, points: FloatArray) -> FloatArray:
    return sequence.to_image(1, sequence.to_plane(0, points))


def scene_pairs(scenes: Sequence[PlanarScene], distortion: float, *, seed: int, per_scene: int) -> Iterator[JudgedPair]:
    """The first image of every scene with others, all distorted by the same λ, uniform from ``distortion`` to 0.

    Images of different sizes are brought to the size of the first, which a homography describes.
    """
    for number, scene in enumerate(scenes):
        lam = float(np.random.default_rng((seed, number)).uniform(distortion, 0.0))
        first = scene.images[0]()
        size = (first.shape[1], first.shape[0])
        lens = Camera(size, lam)
        one = _through(lens, first, size)
        for k in range(1, min(1 + per_scene, len(scene.images))):
            other = scene.images[k]()
            resize = np.diag([size[0] / other.shape[1], size[1] / other.shape[0], 1.0])
            homography = resize @ scene.homographies[k]

            def transfer(points: FloatArray, lens: Camera = lens, h: FloatArray = homography) -> FloatArray:
                return _measured(lens, apply(h, _ideal(lens, points)))

            yield _judged(one, _through(lens, other, size), lens, transfer)


def _judged(one: Pixels, two: Pixels, lens: Camera, transfer: Callable[[FloatArray], FloatArray]) -> JudgedPair:
    matches = match(detect(one, _FEATURES), detect(two, _FEATURES), _RATIO)
    width, height = lens.image_size
    grid = np.meshgrid(np.linspace(0.0, width - 1.0, _GRID[0]), np.linspace(0.0, height - 1.0, _GRID[1]))
    places = np.stack(grid, axis=-1).reshape(-1, 2)
    moved = transfer(places)
    with np.errstate(invalid="ignore"):
        seen = ((moved >= 0.0) & (moved <= (width - 1.0, height - 1.0))).all(axis=1)
    return JudgedPair(matches.points1, matches.points2, lens.image_size, lens.distortion, places[seen], moved[seen])


def _ideal(lens: Camera, points: FloatArray) -> FloatArray:
    """Px of the distorted image to px of the one without distortion, with the corners where they were."""
    centre = np.array(lens.center)
    ideal: FloatArray = centre + (lens.undistort(points) - centre) * (1.0 + lens.distortion)
    return ideal


def _measured(lens: Camera, points: FloatArray) -> FloatArray:
    """The inverse."""
    centre = np.array(lens.center)
    return lens.distort(centre + (points - centre) / (1.0 + lens.distortion))


def _through(lens: Camera, image: Pixels, size: tuple[int, int]) -> Pixels:
    """An image as the lens would have taken it."""
    resized = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
    grid = np.stack(np.meshgrid(np.arange(size[0]), np.arange(size[1])), axis=-1).astype(np.float64)
    u, v = np.moveaxis(_ideal(lens, grid.reshape(-1, 2)).reshape(grid.shape).astype(np.float32), -1, 0)
    distorted = cv2.remap(resized, u, v, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT)
    return np.asarray(distorted, dtype=np.uint8)
