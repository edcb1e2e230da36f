"""Tiles that a microscope's motorised stage brings before the camera, with their true places, lens and illumination."""

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Literal

import cv2
import numpy as np
import tifffile
from numpy.typing import NDArray

from rdstitch.arrays import FloatArray
from rdstitch.geometry.camera import Camera

Specimen = Literal["fluorescence", "brightfield"]

_APRON = 16
"""Pixels of the ground beyond the outermost tiles, besides what the lens sees of it."""

_FULL = 4095.0
"""Largest count of a camera of 12 bits."""

_NUCLEI_EVERY = 45.0
"""Mean distance of nuclei in tissue, pixels."""


@dataclass(frozen=True)
class StageGrid:
    """Tiles of a specimen on a stage, rendered on demand."""

    rows: int = 10
    columns: int = 10
    tile: int = 1024  # side, pixels
    overlap: float = 0.1  # share of a tile that its neighbour shows too, as the stage is told
    specimen: Specimen = "fluorescence"  # bright nuclei on dark ground; or stained tissue on bright ground, in colour
    content: float = 0.6  # share of the ground that shows any
    backlash: float = 8.0  # pixels that rows from left to right are off to the left, and the others to the right
    jitter: float = 1.5  # standard deviation of each place, pixels
    turn: float = 0.002  # of the camera against the axes of the stage, radians
    shading: float = 0.3  # share of the light that is missing where it is darkest
    offset: float = 100.0  # counts of the camera without light
    distortion: float = 0.0
    electrons: float = 2.0  # that make a count; more are less noise
    seed: int = 0

    def __len__(self) -> int:
        """Number of tiles, row by row."""
        return self.rows * self.columns

    @property
    def cells(self) -> NDArray[np.intp]:
        """Row and column of each tile, (N, 2)."""
        return np.stack(np.divmod(np.arange(len(self)), self.columns), axis=1)

    @property
    def nominal(self) -> FloatArray:
        """Nominal places of the tiles, pixels (N, 2)."""
        return np.asarray(self.cells[:, ::-1] * (self.tile * (1.0 - self.overlap)), dtype=np.float64)

    @cached_property
    def places(self) -> FloatArray:
        """True places of the tiles, undistorted pixels (N, 2)."""
        rng = np.random.default_rng([self.seed, 1])
        c, s = np.cos(self.turn), np.sin(self.turn)
        places = self.nominal @ np.array([[c, s], [-s, c]])
        places[:, 0] += np.where(self.cells[:, 0] % 2, self.backlash, -self.backlash)
        return np.asarray(places + self.jitter * rng.normal(size=places.shape))

    @property
    def camera(self) -> Camera:
        """The lens on a tile."""
        return Camera((self.tile, self.tile), self.distortion)

    @cached_property
    def flat_field(self) -> FloatArray:
        """Illumination of each pixel, mean 1, (tile, tile, C)."""
        v, u = np.mgrid[: self.tile, : self.tile] / (self.tile - 1.0) - 0.5
        planes = []
        for channel in range(self.channels):
            x, y = u - 0.08 * (channel + 1), v + 0.05 * (channel + 1)
            bowl = x**2 + 1.3 * y**2 + 0.1 * x
            planes.append(1.0 - self.shading * (bowl - bowl.min()) / np.ptp(bowl))
        field = np.stack(planes, axis=-1)
        return np.asarray(field / field.mean(axis=(0, 1)))

    @property
    def channels(self) -> int:
        """Samples of a pixel."""
        return 3 if self.specimen == "brightfield" else 1

    def render(self, index: int) -> NDArray[np.uint16]:
        """One tile as the camera gives it, (tile, tile) or (tile, tile, 3), counts of 12 bits."""
        rng = np.random.default_rng([self.seed, 2, index])
        maps = (self._coordinates(index) - self._origin).astype(np.float32)
        light = cv2.remap(self._ground, maps[..., 0], maps[..., 1], cv2.INTER_LANCZOS4)
        light = np.maximum(light.reshape(self.tile, self.tile, self.channels), 0.0) * self.flat_field
        # Shot noise of the electrons, and 1.5 counts of the amplifier.
        counts = light + rng.normal(size=light.shape) * np.sqrt(light / self.electrons + 1.5**2) + self.offset
        return np.asarray(np.clip(np.rint(counts), 0, _FULL).squeeze(), dtype=np.uint16)

    def write(self, folder: Path) -> list[Path]:
        """Write the tiles, named by row and column, and ``positions.csv`` with the places that the stage was told."""
        folder.mkdir(parents=True, exist_ok=True)
        files = [folder / f"r{row:02d}c{column:02d}.tif" for row, column in self.cells.tolist()]
        for index, file in enumerate(files):
            tifffile.imwrite(file, self.render(index))
        rows = [f"{file.name},{x:.3f},{y:.3f}" for file, (x, y) in zip(files, self.nominal.tolist(), strict=True)]
        (folder / "positions.csv").write_text("\n".join(["name,x,y", *rows, ""]), encoding="utf-8")
        return files

    def _coordinates(self, index: int) -> FloatArray:
        """Map every pixel of a tile to the ground, (h, w, 2)."""
        side = np.arange(self.tile, dtype=np.float64)
        points = np.stack(np.meshgrid(side, side), axis=-1)
        return np.asarray(self.camera.undistort(points.reshape(-1, 2)).reshape(points.shape) + self.places[index])

    @cached_property
    def _origin(self) -> FloatArray:
        """Place of the first pixel of the ground."""
        return np.asarray(self.places.min(axis=0) - self._beyond)

    @property
    def _beyond(self) -> float:
        corner = self.camera.undistort(np.zeros((1, 2)))[0]
        return float(_APRON + max(0.0, -corner.min()))

    @cached_property
    def _ground(self) -> NDArray[np.float32]:
        """Light that the specimen sends, (h, w) or (h, w, 3)."""
        extent = np.ptp(self.places, axis=0) + self.tile + 2 * self._beyond
        width, height = np.ceil(extent).astype(int).tolist()
        size, rng = (height, width), np.random.default_rng([self.seed, 3])
        coarse = _clouds(rng, size, self.tile * 0.8)
        level = np.quantile(coarse[::16, ::16], 1.0 - self.content)
        tissue = np.clip((coarse - level) / 0.05 + 0.5, 0.0, 1.0).astype(np.float32)
        nuclei = _nuclei(rng, size, tissue)
        grain = _clouds(rng, size, 24.0)
        if self.specimen == "fluorescence":
            light = 60.0 + 40.0 * tissue * (1.0 + 0.5 * grain) + 900.0 * nuclei * (1.0 + 0.2 * grain)
            return np.asarray(light, dtype=np.float32)
        fibres = _clouds(rng, size, 9.0)
        stain = tissue * (0.25 + 0.08 * grain + 0.08 * fibres) + 0.8 * nuclei
        colours = np.array([0.7, 1.0, 0.5], dtype=np.float32)
        return np.asarray(2600.0 * np.exp(-np.maximum(stain, 0.0)[..., None] * colours), dtype=np.float32)


def _clouds(rng: np.random.Generator, size: tuple[int, int], grain: float) -> NDArray[np.float32]:
    """Smooth noise of mean 0 and standard deviation about 1 whose features have a size in pixels."""
    coarse = rng.normal(size=[int(side / grain) + 3 for side in size]).astype(np.float32)
    height, width = size
    rows, columns = np.float32(rng.uniform(0, 1)), np.float32(rng.uniform(0, 1))
    y = np.repeat((np.arange(height, dtype=np.float32) / grain + rows)[:, None], width, axis=1)
    x = np.repeat((np.arange(width, dtype=np.float32) / grain + columns)[None], height, axis=0)
    return np.asarray(cv2.remap(coarse, x, y, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT), dtype=np.float32)


def _nuclei(rng: np.random.Generator, size: tuple[int, int], tissue: NDArray[np.float32]) -> NDArray[np.float32]:
    """Brightness of nuclei, ellipses of about ten pixels with soft edges, where there is tissue."""
    height, width = size
    count = int(height * width / _NUCLEI_EVERY**2)
    centres = rng.uniform(size=(count, 2)) * (width, height)
    axes, turns = rng.uniform(5.0, 11.0, size=(count, 2)), rng.uniform(0.0, np.pi, size=count)
    bright = rng.lognormal(-0.3, 0.5, size=count)
    field = np.zeros(size, dtype=np.float32)
    reach = 16
    offsets = np.arange(-reach, reach + 1, dtype=np.float64)
    for (x, y), (a, b), turn, value in zip(centres, axes, turns, bright, strict=True):
        left, top = round(x), round(y)
        if not (reach <= left < width - reach and reach <= top < height - reach) or tissue[top, left] < 0.9:
            continue
        dx, dy = offsets[None] + (left - x), offsets[:, None] + (top - y)
        along, across = np.cos(turn) * dx + np.sin(turn) * dy, np.cos(turn) * dy - np.sin(turn) * dx
        edge = (1.0 - np.hypot(along / a, across / b)) * np.sqrt(a * b) / 2.0
        part = field[top - reach : top + reach + 1, left - reach : left + reach + 1]
        np.maximum(part, value / (1.0 + np.exp(-np.clip(edge * 2.5, -30, 30))), out=part, casting="unsafe")
    return np.asarray(cv2.GaussianBlur(field, (0, 0), 1.0), dtype=np.float32)
