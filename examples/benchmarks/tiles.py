"""Tiles on a stage: ``python -m examples.benchmarks.tiles``.

Rendered grids of fluorescence and brightfield tiles: how far tiles are off, λ, the flat field, and the time. With
``--peer-python`` of an environment that has m2stitch and ashlar, the same tiles by these. Errors are within each group
of tiles that overlaps hold together; tiles with content are those of which overlaps show it.
"""

import argparse
import json
import subprocess
import tempfile
import time
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from rdstitch.arrays import FloatArray
from rdstitch.inputs.source import read_sources
from rdstitch.pipeline.flat_field import with_flat_field
from rdstitch.stage import TileGrid, register_tiles
from rdstitch.synthetic.stage import Specimen, StageGrid

_PEERS = r"""
import json, sys, time, warnings
from pathlib import Path
import numpy as np, tifffile
warnings.filterwarnings("ignore")
folder, overlap, which = Path(sys.argv[1]), float(sys.argv[4]), sys.argv[5]
rows, columns = int(sys.argv[2]), int(sys.argv[3])
files = sorted(folder.glob("r*.tif"))
cells = [divmod(k, columns) for k in range(rows * columns)]
read = lambda file: (lambda a: a if a.ndim == 2 else a.mean(axis=2).astype(a.dtype))(tifffile.imread(file))
tiles = np.stack([read(file) for file in files])
start = time.process_time()
if which == "m2stitch":
    import m2stitch
    found, _ = m2stitch.stitch_images(tiles, [r for r, _ in cells], [c for _, c in cells], row_col_transpose=False)
    places = found[["x_pos", "y_pos"]].to_numpy(float)
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
                yield (
                    name,
                    StageGrid(rows, rows, tile, overlap, specimen, content=0.5, distortion=distortion, seed=7),
                )


def errors(stage: StageGrid, places: FloatArray, groups: Sequence[Sequence[int]]) -> FloatArray:
    """How far tiles are from where they are, but for a shift of each group, pixels."""
    off = places - stage.places
    return np.concatenate(
        [np.linalg.norm(off[list(group)] - np.median(off[list(group)], axis=0), axis=1) for group in groups]
    )


def measure(name: str, stage: StageGrid, folder: Path, peer: str | None) -> None:
    """Print a line for rdstitch, and one for each peer."""
    files = stage.write(folder)
    start = time.process_time()
    sources, _ = with_flat_field(read_sources(files, skip_bad=False)[0], "auto")
    flat_seconds = time.process_time() - start
    field = sources[0].flat_field
    off = float("nan") if field is None else float(np.sqrt(((field.gain / stage.flat_field - 1.0) ** 2).mean()))
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
    for which in ("m2stitch", "ashlar") if peer else ():
        command = [
            peer or "",
            "-c",
            _PEERS,
            str(folder),
            str(stage.rows),
            str(stage.columns),
            str(stage.overlap),
            which,
        ]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        if done.returncode:
            print(f"  {which}: {(done.stderr.strip().splitlines() or ['failed'])[-1]}", flush=True)
            continue
        result = json.loads(done.stdout.splitlines()[-1])
        theirs = errors(stage, np.array(result["places"]), found.groups)
        right = int((theirs < 2.0).sum())
        print(
            f"  {which}: {right} of the same tiles within 2 pixels, error {np.median(theirs):.2f} median, "
            f"{theirs.max():.2f} largest; {1e3 * result['seconds'] / megapixels:.0f} ms a megapixel",
            flush=True,
        )


def main() -> None:
    """Run all sets, or those whose name contains a text."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rows", type=int, default=10)
    parser.add_argument("--tile", type=int, default=1024)
    parser.add_argument("--only", default="")
    parser.add_argument("--peer-python")
    given = parser.parse_args()
    for name, stage in grids(given.rows, given.tile):
        if given.only in name:
            with tempfile.TemporaryDirectory() as folder:
                measure(name, stage, Path(folder), given.peer_python)


if __name__ == "__main__":
    main()
