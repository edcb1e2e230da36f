"""Tiles on a stage: ``python -m examples.benchmarks.tiles``.

Rendered grids of fluorescence and brightfield tiles: how far tiles are off, λ, the flat field, and the time. With
``--peer-python`` of an environment that has m2stitch, ashlar and basicpy, the same tiles by these; basicpy also with
the camera's true offset taken off, which rdstitch is not told. Errors are within each group of tiles that overlaps hold
together; tiles with content are those of which overlaps show it.
"""

import json
import subprocess
import tempfile
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from examples.benchmarks.driver import run
from rdstitch.arrays import FloatArray
from rdstitch.inputs.source import read_sources
from rdstitch.pipeline.read_inputs import with_flat_field
from rdstitch.stage import TileGrid, register_tiles
from tests.stage_grid import Specimen, StageGrid

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
        positions = np.array(cells, float) * side * (1 - overlap)
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
    found = register_tiles(TileGrid(stage.nominal, (stage.tile, stage.tile)), planes.__getitem__)
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


def main(*, rows: int = 10, tile: int = 1024, only: str = "", peer_python: str | None = None) -> None:
    """Run all sets, or those whose name contains a text."""
    for name, stage in grids(rows, tile):
        if only in name:
            with tempfile.TemporaryDirectory() as folder:
                measure(name, stage, Path(folder), peer_python)


if __name__ == "__main__":
    run(main)
