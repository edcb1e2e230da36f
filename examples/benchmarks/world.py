"""Sets of the world, as a user would stitch them: ``python -m examples.benchmarks.world FOLDER… [--output DIR]``.

Every subfolder that holds images is one set; each is stitched by ``rdstitch mosaic`` with no option. A row a set: exit
status, images used, model, λ, the ratio of the areas that a pixel gets within the output (98 % over 2 %), the focal
length, the share of the places along its seams that is broken and the longest break in pixels, lines of messages, and
processor time. With ``--peer-python``, a Python that has the package ``stitching``, what that makes of the same images
stands beside it: images used, its seams, measured as ours are where its own seam finder puts them, and processor time.

A result is "good" where the status is 0, all images are used, |λ| ≤ 0.09, the ratio of areas at most 30, and no image
folded: what a person sees at a glance. Look at the images in ``--output`` for the rest.
"""

import json
import math
import os
import subprocess
import sys
import tempfile
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from PIL import Image

from examples.benchmarks.driver import SUFFIXES, images_of, run
from examples.benchmarks.peer_layers import PeerLayer, layers_of_peer
from rdstitch.arrays import FloatArray
from rdstitch.compositing.seam_quality import DIAGONAL, SeamQuality, SeamTile, measure_seams

_GRID = np.stack(np.meshgrid([0.1, 0.5, 0.9], [0.1, 0.5, 0.9]), axis=-1).reshape(-1, 2)
_MAX_DISTORTION, _MAX_STRETCH = 0.09, 30.0
_MAX_SECONDS = 900

_VARIANTS = ("as it is", "quality 92", "70 %", "other order")
_FAMILIES = {"rotation": "turn", "homography": "homographies"}  # all others are planes under one camera


@dataclass(frozen=True)
class Peer:
    """What the package ``stitching`` makes of a set."""

    used: int
    seams: SeamQuality
    seconds: float

    def __str__(self) -> str:
        """The end of a line of the table."""
        longest = max((one.length for one in self.seams.breaks), default=0.0)
        share = self.seams.broken_fraction if len(self.seams.places) else math.nan
        return f" {self.used:5d} {100 * share:5.1f} {longest:5.0f} {self.seconds:7.1f}"


@dataclass(frozen=True)
class Row:
    """What became of one set."""

    name: str
    status: int
    count: int
    seconds: float
    messages: tuple[str, ...]
    peer: "Peer | None"
    used: int = 0
    model: str = ""
    distortion: float = math.nan
    stretch: float = math.nan
    folded: bool = False
    focal: float = math.nan
    broken: float = math.nan  # share of the places along the seams
    longest: float = 0.0  # break, pixels

    @property
    def good(self) -> bool:
        """Whether a person would keep it, as far as numbers tell."""
        whole = self.status == 0 and self.used == self.count and not self.folded
        return whole and not abs(self.distortion) > _MAX_DISTORTION and self.stretch <= _MAX_STRETCH

    @property
    def kind(self) -> str:
        """What kind of result it is."""
        if self.status:
            return f"status {self.status}"
        breaks = any("[seam-break]" in line for line in self.messages)
        return f"{_FAMILIES.get(self.model, 'plane')} {self.used}/{self.count}{' breaks' if breaks else ''}"

    def __str__(self) -> str:
        """One line of the table."""
        return (
            f"{'good' if self.good else '-':4s} {self.name:24s} {self.status:3d} {self.used:3d}/{self.count:<3d} "
            f"{self.model:10s} {self.distortion:+7.3f} {self.stretch:8.1f}{'F' if self.folded else ' '} "
            f"{self.focal:6.2f} {100 * self.broken:5.1f} {self.longest:5.0f} {len(self.messages):3d} "
            f"{self.seconds:7.1f}{'' if self.peer is None else self.peer}"
        )


def to_output(image: dict[str, Any], points: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Map measured pixels (N, 2) of an image to a planar output, and the sign of their depth."""
    half = math.hypot(*image["size"]) / 2.0
    distorted = (points - np.array(image["center_px"])) / half
    squared = (distorted**2).sum(axis=1)
    divisor = 1.0 + sum(c * squared ** (k + 1) for k, c in enumerate(image["coefficients"]))
    plane = np.column_stack([distorted, divisor]) @ np.array(image["to_output"]).T
    return plane[:, :2] / plane[:, 2:], plane[:, 2]


def shape_of(images: list[dict[str, Any]]) -> tuple[float, bool]:
    """Ratio of the areas of pixels in a planar output, and whether an image is folded; (1, False) on a sphere."""
    areas, folded = [], False
    for image in images:
        if image["to_output"] is None:
            continue
        points, step = _GRID * image["size"], 1e-3 * image["size"][1]
        (origin, depth), (right, _), (down, _) = (to_output(image, points + d) for d in ((0, 0), (step, 0), (0, step)))
        folded |= bool(depth.min() * depth.max() <= 0.0)
        a, b = right - origin, down - origin
        areas.append(np.abs(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]) / step**2)
    if not areas:
        return 1.0, folded
    low, high = np.quantile(np.concatenate(areas), [0.02, 0.98])
    return float(high / max(low, 1e-12)), folded


def execute(command: list[str]) -> tuple[int, str, float]:
    """Run a command; its status, standard error, and processor time."""
    with tempfile.TemporaryFile("w+") as errors:
        process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=errors)
        _, status, usage = os.wait4(process.pid, 0)
        errors.seek(0)
        return os.waitstatus_to_exitcode(status), errors.read(), usage.ru_utime + usage.ru_stime


def seams_of(layers: list[PeerLayer]) -> SeamQuality:
    """Measure seams as those of our outputs are: where seen at a usual size of the images, exposure corrected."""
    area = float(np.median([np.count_nonzero(layer.mask) for layer in layers]))
    unit = max(1.0, 1.44 * math.sqrt(area) / DIAGONAL)  # the diagonal of an image of 4 to 3
    corner = np.min([layer.corner for layer in layers], axis=0)
    tiles, kept = [], []
    for layer in layers:
        (x, y), (height, width) = layer.corner - corner, layer.mask.shape
        left, top, right, bottom = (math.floor(edge / unit) for edge in (x, y, x + width, y + height))
        size = right + 1 - left, bottom + 1 - top
        offset = (np.array([left, top]) + 0.5) * unit - 0.5 - (x, y)
        to_layer = np.array([[unit, 0.0, offset[0]], [0.0, unit, offset[1]]])
        smooth = cv2.GaussianBlur(layer.pixels.mean(axis=2, dtype=np.float32), (0, 0), math.hypot(unit, unit / 2.0))
        linear = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        grey = cv2.warpAffine(smooth, to_layer, size, flags=linear, borderMode=cv2.BORDER_REPLICATE)
        inside, owned = (cv2.warpAffine(mask, to_layer, size, flags=linear) for mask in (layer.mask, layer.kept))
        tiles.append(SeamTile((left, top, right + 1, bottom + 1), grey, inside > 254))
        kept.append(owned > 127)
    columns, rows = np.max([tile.box[2:] for tile in tiles], axis=0)
    labels = np.full((rows, columns), -1, dtype=np.int32)
    for k, (tile, mask) in enumerate(zip(tiles, kept, strict=True)):
        left, top, right, bottom = tile.box
        labels[top:bottom, left:right][mask] = k
    return measure_seams(tiles, labels, 1.0, unit)


def peer_of(python: str, files: list[str], output: Path) -> Peer:
    """Stitch one set by the package ``stitching``."""
    layers, seconds = layers_of_peer(python, files, output)
    return Peer(len(layers), seams_of(layers) if layers else SeamQuality(), seconds)


def stitch(folder: Path, output: Path, options: list[str], peer_python: str | None) -> Row:
    """Stitch one set."""
    files = [str(file) for file in images_of(folder)]
    written = output / f"{folder.name}.jpg"
    program = ["timeout", str(_MAX_SECONDS), sys.executable, "-m", "rdstitch_cli"]
    status, errors, seconds = execute([*program, "mosaic", *files, "-o", str(written), "--overwrite", *options])
    messages = tuple(line for line in errors.splitlines() if line.startswith("rdstitch:"))
    (output / f"{folder.name}.txt").write_text(errors)
    peer = None if peer_python is None else peer_of(peer_python, files, output / f"{folder.name}.peer.jpg")
    row = Row(folder.name, status, len(files), seconds, messages, peer)
    sidecar = Path(f"{written}.json")
    if status or not sidecar.exists():
        return row
    record = json.loads(sidecar.read_text())
    used = [image for image in record["images"] if image["used"]]
    stretch, folded = shape_of(used)
    focal = (record["focal_px"] or math.nan) / (math.hypot(*used[0]["size"]) / 2.0)
    distortion = math.nan if record["lambda"] is None else record["lambda"]
    row = replace(row, used=len(used), model=record["model"], distortion=distortion)
    seams = record["seams"]
    broken = seams["broken"] / seams["places"] if seams["places"] else math.nan
    longest = max((one["length_px"] for one in seams["breaks"]), default=0.0)
    return replace(row, stretch=stretch, folded=folded, focal=focal, broken=broken, longest=longest)


def save_again(folder: Path, to: Path, variant: str) -> Path:
    """The images of a set as a user may have them instead."""
    files = images_of(folder)
    saved = to / variant.replace(" ", "_") / folder.name
    saved.mkdir(parents=True, exist_ok=True)
    order = np.random.default_rng(len(files)).permutation(len(files))
    order = order[::-1] if (order == np.arange(len(files))).all() else order
    for position, file in zip(order, files, strict=True):
        if variant == "other order":
            (saved / f"{position:03d}{file.suffix}").write_bytes(file.read_bytes())
            continue
        with Image.open(file) as image:
            again = image.convert("RGB")
            if variant == "70 %":
                width, height = image.size
                again = again.resize((round(0.7 * width), round(0.7 * height)), Image.Resampling.LANCZOS)
            kept = {"exif": image.info["exif"]} if "exif" in image.info else {}
            again.save(saved / f"{file.stem}.jpg", quality=92, **kept)
    return saved


def compare_variants(sets: list[Path], output: Path, options: list[str], pool: ThreadPoolExecutor) -> None:
    """Print the kind of result of each set in each variant, and the share that is of the kind of the set as it is."""
    print(f"{'set':24s} " + " ".join(f"{variant:24s}" for variant in _VARIANTS))

    def kinds_of(folder: Path) -> list[str]:
        with tempfile.TemporaryDirectory() as scratch:
            every = [folder, *(save_again(folder, Path(scratch), variant) for variant in _VARIANTS[1:])]
            kinds = []
            for variant, each in zip(_VARIANTS, every, strict=True):
                written = output / variant.replace(" ", "_")
                written.mkdir(parents=True, exist_ok=True)
                kinds.append(stitch(each, written, options, None).kind)
            return kinds

    same = []
    for folder, kinds in zip(sets, pool.map(kinds_of, sets), strict=True):
        same += [kind == kinds[0] for kind in kinds[1:]]
        print(f"{folder.name:24s} " + " ".join(f"{kind:24s}" for kind in kinds), flush=True)
    print(f"{sum(same)} of {len(same)} of the same kind, {np.mean(same):.1%}")


def main(
    folders: tuple[Path, ...],
    *,
    output: Path | None = None,
    peer_python: str | None = None,
    jobs: int = 1,
    options: str = "",
    resaved: bool = False,
) -> None:
    """Print a row a set."""
    sets = sorted({file.parent for folder in folders for file in folder.rglob("*") if file.suffix.lower() in SUFFIXES})
    output = output or Path(tempfile.mkdtemp())
    output.mkdir(parents=True, exist_ok=True)
    if resaved:
        with ThreadPoolExecutor(jobs) as pool:
            compare_variants(sets, output, options.split(), pool)
        return
    columns = "areas   f/half  torn break lines  cpu s" + ("" if peer_python is None else "  peer  torn break   cpu s")
    print(f"     set                      status used  model           λ    {columns}")
    with ThreadPoolExecutor(jobs) as pool:
        rows = []
        for row in pool.map(lambda folder: stitch(folder, output, options.split(), peer_python), sets):
            print(row, flush=True)
            rows.append(row)
    ratios = [row.seconds / row.peer.seconds for row in rows if row.peer is not None and row.peer.used]
    print(
        f"{sum(row.good for row in rows)} of {len(rows)} good; {sum(len(row.messages) for row in rows)} messages"
        + (f"; time over the peer's, median {np.median(ratios):.2f}" if ratios else "")
    )


if __name__ == "__main__":
    run(main)
