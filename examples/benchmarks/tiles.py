"""Tiles on a stage: ``python -m examples.benchmarks.tiles``.

Rendered grids of fluorescence and brightfield tiles: how far tiles are off, λ, the flat field, and the time. With
``--peer-python`` of an environment that has m2stitch, ashlar and basicpy, the same tiles by these; basicpy also with
the camera's true offset taken off, which rdstitch is not told. Errors are within each group of tiles that overlaps hold
together; tiles with content are those of which overlaps show it.

``--worlds-only`` tries what goes wrong: a pattern that repeats itself, axes and overlaps that were told wrongly, a tile
that lies elsewhere, two tiles, hardly any content and none, and the files of OME-TIFF, ImageJ and Micro-Manager.
Errors are then those of all tiles against the largest group, and a false claim is a tile that is off by more than five
of its standard deviations.
"""

import json
import subprocess
import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import tifffile
from numpy.typing import NDArray

from examples.benchmarks.driver import run
from examples.worlds.stage_grid import Specimen, StageGrid
from rdstitch.arrays import FloatArray, IntArray
from rdstitch.errors import RegistrationError
from rdstitch.inputs.source import read_sources
from rdstitch.options.tile_options import TileOptions
from rdstitch.pipeline.composition.flat_field import with_flat_field
from rdstitch.pipeline.stage_tiles import place_tiles
from rdstitch.stage import SearchPlan, TileGrid, register_tiles

_PEERS = r"""
import json, sys, time, warnings
from pathlib import Path
import numpy as np, tifffile
warnings.filterwarnings("ignore")
folder, overlap, which = Path(sys.argv[1]), float(sys.argv[4]), sys.argv[5]
rows, columns = int(sys.argv[2]), int(sys.argv[3])
files = sorted(folder.glob("r*.tif"))
cells = [divmod(k, columns) for k in range(rows * columns)]
colours = np.stack([np.atleast_3d(tifffile.imread(file)) for file in files])
tiles = colours[..., 0] if colours.shape[-1] == 1 else colours.mean(axis=-1).astype(colours.dtype)
places = np.zeros((0, 2))
start = time.process_time()
if which == "m2stitch":
    import m2stitch
    found, _ = m2stitch.stitch_images(tiles, [r for r, _ in cells], [c for _, c in cells], row_col_transpose=False)
    places = found[["x_pos", "y_pos"]].to_numpy(float)
elif which.startswith("basicpy"):
    from basicpy import BaSiC
    start = time.process_time()
    planes = []
    for channel in np.moveaxis(colours, -1, 0):
        basic = BaSiC()
        basic.fit(channel.astype(np.float32) - (float(sys.argv[6]) if which.endswith("offset") else 0.0))
        planes.append(np.asarray(basic.flatfield))
    np.save(folder / "flat_field.npy", np.stack(planes, axis=-1))
else:
    from ashlar import reg
    side = tiles.shape[1]
    class Meta(reg.Metadata):
        def __init__(self): pass
        _num_images = num_images = len(tiles)
        num_channels, pixel_size, pixel_dtype = 1, 1.0, tiles.dtype
        size = np.array([side, side])
        positions = np.loadtxt(folder / "positions.csv", delimiter=",", skiprows=1, usecols=(2, 1))
        def tile_position(self, i): return self.positions[i]
        def tile_size(self, i): return self.size
    class Reader(reg.Reader):
        def __init__(self): self.metadata = Meta()
        def read(self, series, c): return tiles[series]
    aligner = reg.EdgeAligner(Reader(), channel=0, max_shift=20)
    aligner.run()
    places = np.asarray(aligner.positions, float)[:, ::-1]
print(json.dumps({"seconds": time.process_time() - start, "places": places.tolist()}))
"""


def grids(rows: int, tile: int) -> Iterator[tuple[str, StageGrid]]:
    """The sets, and what they are called."""
    kinds: tuple[Specimen, ...] = ("fluorescence", "brightfield")
    for specimen in kinds:
        for overlap in (0.05, 0.1, 0.2):
            for distortion in (0.0, -0.02):
                name = f"{specimen}, {overlap:.0%} overlap, λ = {distortion:g}"
                yield (name, StageGrid(rows, rows, tile, overlap, specimen, content=0.5, distortion=distortion, seed=7))


def errors(stage: StageGrid, places: FloatArray, groups: Sequence[Sequence[int]]) -> FloatArray:
    """How far tiles are from where they are, but for a shift of each group, pixels."""
    off = places - stage.places
    return np.concatenate(
        [np.linalg.norm(off[list(group)] - np.median(off[list(group)], axis=0), axis=1) for group in groups]
    )


def gain_error(stage: StageGrid, gain: NDArray[Any]) -> float:
    """How far a flat field is from the truth, root mean square, but for its mean in each channel."""
    return float(np.sqrt(((gain / gain.mean(axis=(0, 1)) / stage.flat_field - 1.0) ** 2).mean()))


def measure(name: str, stage: StageGrid, folder: Path, peer: str | None) -> None:
    """Print a line for rdstitch, and one for each peer."""
    files = stage.write(folder)
    start = time.process_time()
    sources, _ = with_flat_field(read_sources(files, skip_bad=False)[0], "auto")
    flat_seconds = time.process_time() - start
    field = sources[0].flat_field
    off = float("nan") if field is None else gain_error(stage, field.gain)
    # Read once before: what is timed is registration.
    planes = [pixels if pixels.ndim == 2 else pixels.mean(axis=2) for pixels in (s.read().pixels for s in sources)]
    start = time.process_time()
    found = register_tiles(SearchPlan.of(TileGrid(stage.nominal, (stage.tile, stage.tile))), planes.__getitem__)
    seconds = time.process_time() - start
    megapixels = len(stage) * stage.tile**2 / 1e6
    fitted, own = found.adjustment, errors(stage, found.adjustment.places, found.groups)
    print(
        f"{name}\n  rdstitch: {int(found.linked.sum())} of {len(stage)} tiles, error {np.median(own):.2f} median, "
        f"{own.max():.2f} largest; λ = {fitted.distortion:.5f} ± {fitted.distortion_std:.5f}; flat field {off:.2%}; "
        f"{1e3 * seconds / megapixels:.0f} ms a megapixel, flat field {1e3 * flat_seconds / megapixels:.0f}",
        flush=True,
    )
    for which in ("m2stitch", "ashlar", "basicpy", "basicpy, true offset") if peer else ():
        about = map(str, (folder, stage.rows, stage.columns, stage.overlap, which, stage.offset))
        command = [str(peer), "-c", _PEERS, *about]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        if done.returncode:
            print(f"  {which}: {(done.stderr.strip().splitlines() or ['failed'])[-1]}", flush=True)
            continue
        result = json.loads(done.stdout.splitlines()[-1])
        milliseconds = 1e3 * result["seconds"] / megapixels
        if which.startswith("basicpy"):
            their_field = gain_error(stage, np.load(folder / "flat_field.npy"))
            print(f"  {which}: flat field {their_field:.2%}; {milliseconds:.0f} ms a megapixel", flush=True)
            continue
        theirs = errors(stage, np.array(result["places"]), found.groups)
        right = int((theirs < 2.0).sum())
        print(
            f"  {which}: {right} of the same tiles within 2 pixels, error {np.median(theirs):.2f} median, "
            f"{theirs.max():.2f} largest; {milliseconds:.0f} ms a megapixel",
            flush=True,
        )


@dataclass(frozen=True)
class World:
    """Tiles whose places were told, rightly or not."""

    tiles: list[NDArray[Any]]
    places: FloatArray  # (N, 2): true ones, pixels
    told: FloatArray
    cells: IntArray  # (N, 2): row and column by which they are named
    layout: str = ""  # how they are stored: plain files with a table, or "set", "series", "hyperstack", "micro-manager"

    def write(self, folder: Path) -> TileOptions:
        """Write the files, and give how they are stitched."""
        names = [f"r{row:02d}c{column:02d}.tif" for row, column in self.cells.tolist()]
        lines = [f"{name},{x:.3f},{y:.3f}" for name, (x, y) in zip(names, self.told.tolist(), strict=True)]
        (folder / "positions.csv").write_text("\n".join(["name,x,y", *lines, ""]), encoding="utf-8")
        height, width = self.tiles[0].shape
        for k, (name, tile) in enumerate(zip(names, self.tiles, strict=True)):
            if self.layout == "micro-manager":
                x, y = (0.5 * self.told[k]).tolist()
                tag = json.dumps({"XPositionUm": x, "YPositionUm": y, "PixelSizeUm": 0.5}).encode()
                tifffile.imwrite(folder / name, tile, metadata=None, extratags=[(51123, 2, len(tag) + 1, tag, True)])
            elif self.layout == "hyperstack":
                stack = np.stack([np.zeros_like(tile), tile])
                tifffile.imwrite(folder / name, stack, imagej=True, metadata={"axes": "CYX"})
            elif self.layout != "series":
                xml = self._ome(width, height, names, k) if self.layout == "set" else None
                tifffile.imwrite(folder / name, tile, description=xml, metadata=None)
        if self.layout == "series":
            (folder / "positions.csv").unlink()
            xml = self._ome(width, height, [], 0)
            tifffile.imwrite(folder / "all.ome.tif", np.stack(self.tiles), description=xml, metadata=None)
        if self.layout in ("", "hyperstack"):
            channel = 1 if self.layout == "hyperstack" else None
            return TileOptions(positions=folder / "positions.csv", channel=channel, flat_field="off")
        return TileOptions(flat_field="off")

    def _ome(self, width: int, height: int, names: Sequence[str], own: int) -> bytes:
        images = []
        for k, (x, y) in enumerate((0.5 * self.told).tolist()):
            inner = f'<UUID FileName="{names[k]}">urn:uuid:{k}</UUID>' if names else ""
            images.append(
                f'<Image ID="Image:{k}"><Pixels ID="Pixels:{k}" DimensionOrder="XYZCT" Type="{self.tiles[0].dtype}" '
                f'SizeX="{width}" SizeY="{height}" SizeZ="1" SizeC="1" SizeT="1" PhysicalSizeX="0.5">'
                f'<TiffData IFD="{0 if names else k}" PlaneCount="1">{inner}</TiffData><Plane TheC="0" TheZ="0" '
                f'TheT="0" PositionX="{x}" PositionY="{y}"/></Pixels></Image>'
            )
        space = "http://www.openmicroscopy.org/Schemas/OME/2016-06"
        return f'<OME xmlns="{space}" UUID="urn:uuid:{own}">{"".join(images)}</OME>'.encode()


def _of_stage(stage: StageGrid, told: FloatArray | None = None, layout: str = "") -> World:
    tiles = [stage.render(index) for index in range(len(stage))]
    return World(tiles, stage.places, stage.nominal if told is None else told, stage.cells, layout)


def _chip(pitch: tuple[int, int], unique: bool, seed: int) -> World:
    """An integrated circuit, with some marks or with nothing unique, told two pixels off."""
    rng, side = np.random.default_rng(seed), 256
    cells = np.stack(np.divmod(np.arange(12), 4), axis=1)
    nominal = cells[:, ::-1] * (0.88 * side)
    places = np.rint(nominal + 2.0 * rng.normal(size=nominal.shape)) + 10.0
    y, x = np.mgrid[:780, :1000]
    ground = 60.0 + 90.0 * ((x % pitch[0] < 0.6 * pitch[0]) & (y % pitch[1] < 0.5 * pitch[1]))
    for u, v in rng.uniform(0, 1, size=(250 if unique else 0, 2)) * (980, 760):
        ground[int(v) : int(v) + 12, int(u) : int(u) + 12] = 220.0
    ground = cv2.GaussianBlur(ground.astype(np.float32), (0, 0), 1.2)
    cut = [ground[v : v + side, u : u + side] for u, v in places.astype(int).tolist()]
    tiles = [np.clip(part + rng.normal(0.0, 3.0, part.shape), 0, 255).astype(np.uint8) for part in cut]
    return World(tiles, places, np.asarray(nominal, dtype=np.float64), cells)


def worlds(seed: int) -> Iterator[tuple[str, World]]:
    """What goes wrong, and what it is called."""
    yield "a pattern of 16 x 10, nothing unique", _chip((16, 10), False, seed)
    yield "a pattern of 11 x 9, with marks", _chip((11, 9), True, seed)
    rich = StageGrid(4, 4, 320, 0.13, content=0.7, backlash=4.0, seed=seed)
    flip = rich.nominal * (1.0, -1.0)
    yield "rows told from the bottom", _of_stage(rich, flip - flip.min(axis=0))
    yield "rows and columns exchanged", _of_stage(rich, rich.nominal[:, ::-1])
    yield "an overlap of 20 % told for 13 %", _of_stage(rich, rich.nominal * (0.80 / 0.87))
    astray = rich.nominal.copy()
    astray[5] += (53.0, 0.0)
    yield "a tile 53 px from where it was told to be", _of_stage(rich, astray)
    yield "two tiles", _of_stage(StageGrid(1, 2, 320, 0.13, content=0.9, seed=seed))
    yield "hardly any content", _of_stage(replace(rich, content=0.15))
    yield "nothing but ground", _of_stage(replace(rich, content=0.0))
    for layout in ("set", "series", "hyperstack", "micro-manager"):
        yield f"files: {layout}", _of_stage(rich, layout=layout)


def try_world(name: str, world: World, folder: Path, peer: str | None) -> int:
    """Print a line for rdstitch, and one for each peer; the number of false claims."""
    options, count = world.write(folder), len(world.tiles)
    claims = 0
    try:
        inputs = [folder] if world.layout == "series" else sorted(folder.glob("*.tif"))
        tiled, _ = place_tiles(inputs, options=options)
    except RegistrationError:
        print(f"{name}\n  rdstitch: refused", flush=True)
    else:
        group = list(tiled.groups[0])
        off = tiled.adjustment.places - world.places
        off -= off[group].mean(axis=0)
        z = off / tiled.stds[:, None]
        claims = int((np.abs(z) > 5.0).any(axis=1).sum())
        print(
            f"{name}\n  rdstitch: {int(tiled.linked.sum())} of {count} tiles registered, error "
            f"{np.median(np.linalg.norm(off[tiled.linked], axis=1)):.2f} median, "
            f"{np.linalg.norm(off, axis=1).max():.2f} largest of all; squared error over variance {np.mean(z**2):.2f}, "
            f"{claims} false claims{', status 5' if tiled.mostly_nominal else ''}",
            flush=True,
        )
    for which in ("m2stitch", "ashlar") if peer and not world.layout else ():
        rows, columns = (world.cells.max(axis=0) + 1).tolist()
        about = map(str, (folder, rows, columns, 0.0, which, 0.0))
        done = subprocess.run([str(peer), "-c", _PEERS, *about], capture_output=True, text=True, check=False)
        if done.returncode:
            print(f"  {which}: {(done.stderr.strip().splitlines() or ['failed'])[-1][:100]}", flush=True)
            continue
        theirs = np.array(json.loads(done.stdout.splitlines()[-1])["places"]) - world.places
        theirs = np.linalg.norm(theirs - np.median(theirs, axis=0), axis=1)
        print(f"  {which}: error {np.median(theirs):.2f} median, {theirs.max():.2f} largest of all", flush=True)
    return claims


def main(
    *,
    rows: int = 10,
    tile: int = 1024,
    only: str = "",
    worlds_only: bool = False,
    seeds: int = 1,
    peer_python: str | None = None,
) -> None:
    """Run all sets, or those whose name contains a text."""
    if worlds_only:
        claims = 0
        for name, world in (pair for seed in range(seeds) for pair in worlds(seed)):
            if only in name:
                with tempfile.TemporaryDirectory() as folder:
                    claims += try_world(name, world, Path(folder), peer_python)
        print(f"false claims: {claims}")
        return
    for name, stage in grids(rows, tile):
        if only in name:
            with tempfile.TemporaryDirectory() as folder:
                measure(name, stage, Path(folder), peer_python)


if __name__ == "__main__":
    run(main)
