"""Planar scenes as in HPatches: images of one plane with the homographies from the first to each other one."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import cv2
import numpy as np

from examples.paper.common.report import Pixels
from rdstitch.arrays import FloatArray
from rdstitch.io.read import read_image
from rdstitch.synthetic import ground

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
