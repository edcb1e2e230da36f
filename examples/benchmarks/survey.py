"""Rendered flights with known places: ``python -m examples.benchmarks.survey [--sets N] [--first N] [--kind NAME]``.

Every set is a flight of 12 images of 480 x 360 pixels, 40 m up, 0.1 m a pixel, somewhere on the Earth, in lanes of
alternate direction or not, with positions in EXIF and a focal length there that is off by 2 %. Kinds: cameras pitched
alike ("pitch"), tilted at random ("tilt"), the same over hills of 5 % of the height ("relief"), and with a receiver
whose errors are 3 m ("gps"); the others have RTK (0.02 m, 0.03 m in height). Printed a row:

model
    Motion models chosen.
error
    Of nine ground points on the map: median and largest, metres, and the median in ground sample distances.
said
    To what the positions agree with the map, and its ±, metres.
z²
    Mean squared error over the squared ±, of one coordinate; the errors of the points of a flight are alike.

At the end, bands ("bands": the same moments, another lens and reversed contrast) and dates ("dates": another flight of
the field, on the grid of the first one): median shift against the first image, pixels.
"""

import math
import tempfile
import time
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import cv2
import numpy as np
from PIL import ExifTags, Image

from examples.benchmarks.driver import run
from rdstitch import CompositeOptions, StitchOptions, mosaic
from rdstitch.arrays import FloatArray
from rdstitch.errors import RdstitchError
from rdstitch.geometry.camera import Camera
from rdstitch.geometry.crs import Crs
from rdstitch.geometry.radial_homography import to_plane
from rdstitch.io.read import read_image
from rdstitch.pipeline.apply_sidecar import apply
from rdstitch.results.stitch_result import StitchResult
from rdstitch.synthetic import sequence_over
from rdstitch.synthetic.poses import Poses
from rdstitch.synthetic.relief import bumps
from rdstitch.synthetic.rendering import Photometry, RenderedSequence
from rdstitch.synthetic.textures import ground

_GSD, _HEIGHT = 0.1, 40.0
_COLUMNS, _ROWS = 4, 3
KINDS = ("pitch", "tilt", "relief", "gps")


class Flight:
    """A rendered flight, and where it is."""

    def __init__(self, kind: str, seed: int) -> None:
        """Make one up."""
        self.rng = rng = np.random.default_rng((seed, 7))
        lens = Camera((480, 360), distortion=-0.05, focal=_HEIGHT / _GSD)
        column, row = (grid.ravel() for grid in np.meshgrid(np.arange(_COLUMNS), np.arange(_ROWS)))
        feet = np.stack([column * 190.0, row * 140.0], axis=1) + rng.normal(0.0, 8.0, (_COLUMNS * _ROWS, 2))
        heights = _HEIGHT / _GSD * (1.0 + rng.normal(0.0, 0.01, len(feet)))
        turn = math.pi if rng.random() < 0.5 else 0.0  # on every other lane
        yaw = row % 2 * turn + rng.normal(0.0, math.radians(3.0), len(feet))
        pitch = (math.radians(rng.uniform(4.0, 10.0)), 0.0) if kind == "pitch" else (0.0, 0.0)
        spread = 0.0 if kind == "pitch" else math.radians(2.0)
        tilt = pitch + rng.normal(0.0, spread, (len(feet), 2))
        self.poses = Poses.of(feet, heights, yaw, tilt)
        self.rise = 0.05 * _HEIGHT / _GSD if kind == "relief" else 0.0
        self.lens, self.seed = lens, seed
        self.sequence = self.rendered(lens, self.poses)
        latitude, longitude = rng.uniform(-75.0, 75.0), rng.choice([rng.uniform(-180.0, 180.0), 180.0, 0.0])
        self.crs = Crs.nearest([latitude], [longitude])
        self.origin = self.crs.project([latitude], [longitude])[0]
        self.std = (3.0, 5.0) if kind == "gps" else (0.02, 0.03)
        self.exif_focal = float(lens.focal or 1.0) * (1.0 + rng.normal(0.0, 0.02))

    def rendered(self, lens: Camera, poses: Poses) -> RenderedSequence:
        """The flight by a lens."""
        relief = partial(bumps, seed=self.seed, height=self.rise) if self.rise else None
        photometry = Photometry(noise=0.01)
        return sequence_over(partial(ground, seed=self.seed), lens, poses, relief=relief, photometry=photometry)

    def on_map(self, texels: FloatArray) -> FloatArray:
        """Easting and northing of places of the ground."""
        return np.asarray(self.origin + texels * (_GSD, -_GSD))

    def write(self, folder: Path, name: str = "f{:02d}.jpg", *, reversed_contrast: bool = False) -> list[Path]:
        """The images with EXIF."""
        folder.mkdir(parents=True, exist_ok=True)
        poses = self.sequence.poses
        places = self.on_map(poses.position) + self.rng.normal(0.0, self.std[0], (len(poses), 2))
        altitude = 200.0 + poses.height * _GSD + self.rng.normal(0.0, self.std[1], len(poses))
        paths = []
        for k, (latitude, longitude) in enumerate(self.crs.geographic(places).tolist()):
            frame = self.sequence.frame(k)
            image = Image.fromarray(255 - frame[..., 1] // 2 if reversed_contrast else frame)
            exif = image.getexif()
            exif[ExifTags.IFD.GPSInfo] = {
                1: "NS"[latitude < 0],
                2: _sexagesimal(latitude),
                3: "EW"[longitude < 0],
                4: _sexagesimal(longitude),
                6: float(altitude[k]),
            }
            # A pixel of 0.01 mm.
            exif[ExifTags.IFD.Exif] = {0x920A: self.exif_focal / 100.0, 0xA20E: 100.0, 0xA210: 4, 0xA002: 480}
            paths.append(folder / name.format(k))
            image.save(paths[-1], exif=exif, quality=95)
        return paths

    def errors(self, result: StitchResult) -> FloatArray:
        """How far nine ground points (P, 2) are off on the map, metres."""
        assert result.georeference is not None
        position, errors = self.sequence.poses.position, []
        low, high = position.min(axis=0), position.max(axis=0)
        for share in np.stack(np.meshgrid(*[(0.0, 0.5, 1.0)] * 2), axis=-1).reshape(-1, 2):
            point = low + share * (high - low)
            for k in np.argsort(np.linalg.norm(position - point, axis=1)).tolist():
                pixel = self.sequence.ground_to_image(k, point[None])
                if result.registration.alignment.used[k] and np.isfinite(pixel).all():
                    alignment = result.registration.alignment
                    to_output = result.canvas.matrix @ alignment.homographies[k]
                    place = result.georeference.to_map(to_plane(alignment.cameras[k], to_output, pixel))
                    right = self.on_map(point[None])
                    if result.georeference.crs != self.crs:
                        right = result.georeference.crs.project(*self.crs.geographic(right).T)
                    errors.append((place - right)[0])
                    break
        return np.array(errors)


def _sexagesimal(degrees: float) -> tuple[float, float, float]:
    minutes = abs(degrees) % 1.0 * 60.0
    return float(int(abs(degrees))), float(int(minutes)), minutes % 1.0 * 60.0


def shift_between(first: Path, second: Path) -> float:
    """Median distance between what two files show at the same pixels."""
    greys = [read_image(file).pixels for file in (first, second)]
    greys = [grey if grey.ndim == 2 else grey.mean(axis=2) for grey in greys]
    assert greys[0].shape == greys[1].shape
    smooth = [cv2.GaussianBlur(grey.astype(np.float32), (0, 0), 1.0) for grey in greys]
    steep = [np.hypot(cv2.Sobel(each, cv2.CV_32F, 1, 0), cv2.Sobel(each, cv2.CV_32F, 0, 1)) for each in smooth]
    side, margin, shifts = 128, 100, []
    window = cv2.createHanningWindow((side, side), cv2.CV_32F)
    for y in range(margin, steep[0].shape[0] - side - margin, side // 2):
        for x in range(margin, steep[0].shape[1] - side - margin, side // 2):
            parts = [np.log1p(each[y : y + side, x : x + side]) for each in steep]
            shifts.append(cv2.phaseCorrelate(parts[0] - parts[0].mean(), parts[1] - parts[1].mean(), window)[0])
    return float(np.median(np.linalg.norm(shifts, axis=1)))


def main(*, sets: int = 3, first: int = 0, kind: str | None = None) -> None:
    """Print a row for every kind of flight, then bands and dates."""
    for each in KINDS:
        if kind in (None, each):
            _places(each, range(first, first + sets))
    for each, measure in (("bands", _bands), ("dates", _dates)):
        if kind in (None, each):
            shifts = [measure(seed) for seed in range(first, first + sets)]
            print(f"{each}: {np.median(shifts):.2f} pixels, largest {max(shifts):.2f}", flush=True)


def _places(kind: str, seeds: Sequence[int]) -> None:
    start, models, errors, said, squares = time.process_time(), [], [], [], []
    for seed in seeds:
        flight = Flight(kind, seed)
        with tempfile.TemporaryDirectory() as folder:
            options = StitchOptions(position_accuracy=flight.std[0], composite=CompositeOptions(scale=0.2))
            try:
                result = mosaic(flight.write(Path(folder)), options=options)
            except RdstitchError as error:
                print(f"{kind} {seed}: {error}")
                continue
        place = result.georeference
        if place is None or place.std is None:
            print(f"{kind} {seed}: {result.not_georeferenced}")
            continue
        models.append(result.registration.alignment.model)
        off = flight.errors(result)
        errors += np.hypot(*off.T).tolist()
        said.append((place.rms or math.nan, place.std))
        squares.append(float(np.mean(off**2)) / place.std**2)
    if errors:
        rms, std = np.median(said, axis=0)
        print(
            f"{kind}: {', '.join(sorted(set(models)))}; error {np.median(errors):.3f} m ({max(errors):.3f}), "
            f"{np.median(errors) / _GSD:.2f} gsd; said {rms:.3f}, ± {std:.3f} m; z² {np.mean(squares):.2f}; "
            f"{time.process_time() - start:.0f} s",
            flush=True,
        )


def _bands(seed: int) -> float:
    """A lens that is 0.3 % shorter, 7 and 9 pixels beside the first one."""
    flight = Flight("tilt", seed)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        flight.write(folder / "red", "V{:02d}_RED.jpg")
        other = replace(flight.lens, focal=398.8, center=(246.5, 170.5))
        # The plane, and the poses on it, are those of the first lens.
        flight.sequence = replace(flight.sequence, lens=other)
        flight.write(folder / "nir", "V{:02d}_NIR.jpg", reversed_contrast=True)
        mosaic([folder / "red"], folder / "red.tif")
        apply(folder / "red.tif.json", [folder / "nir"], folder / "nir.tif")
        return shift_between(folder / "red.tif", folder / "nir.tif")


def _dates(seed: int) -> float:
    """Another flight over the same ground, registered on its own, on the grid of the first."""
    flight = Flight("tilt", seed)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        mosaic(flight.write(folder / "one"), folder / "one.tif")
        poses = flight.sequence.poses.shaken(seed=seed + 1, position=10.0, height=0.02, tilt=0.03)
        flight.sequence = replace(flight.sequence, poses=poses, seed=seed + 1)
        grid = StitchOptions(composite=CompositeOptions(like=str(folder / "one.tif")))
        mosaic(flight.write(folder / "two"), folder / "two.tif", grid)
        return shift_between(folder / "one.tif", folder / "two.tif")


if __name__ == "__main__":
    run(main)
