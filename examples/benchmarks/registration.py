"""Registration measured: ``python -m examples.benchmarks.registration [--pairs N] [--frames N] [--folder DIR] …``.

Processor time of pairs, beside homlib's estimators in the same run, and of whole mosaics by stage, beside OpenCV and
the package stitching where they are installed (``--peer-python``: a Python that has it). ``--folder`` adds one's own
images. Times depend on the machine: only those of one run compare.
"""

from collections.abc import Iterator
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

import rdstitch
from examples.benchmarks.driver import StageTimes, run, timed
from examples.judging import registration_error
from examples.paper.common.estimators import lomsac_estimators
from examples.paper.common.stitchers import installed_stitchers, run_all
from examples.paper.end_to_end import SETS
from examples.worlds.correspondences import correspondences
from examples.worlds.floor_drives import floor_drive
from rdstitch.arrays import FloatArray
from rdstitch.geometry.camera import Camera
from rdstitch.io.read import read_image
from rdstitch.robust import EstimationOptions, PairMatches, estimate_radial_homographies
from rdstitch.synthetic import RenderedSequence
from rdstitch.system.process_memory import peak_memory

MATCHES = 300
_ROUNDS = 3
_SELECT_BELOW = 50  # as registration estimates its pairs
_COMPARED = ("OpenCV Stitcher, SCANS", "stitching, AffineStitcher")


def print_pairs(count: int) -> None:
    """Time of a pair and median error of λ, focal length unknown."""
    for motion in ("rigid", "homography"):
        for outliers in (0.3, 0.6):
            made = [correspondences(MATCHES, seed=seed, outliers=outliers, motion=motion) for seed in range(count)]
            truth = np.array([matches.truth.distortion for matches in made])
            pairs = []
            for matches in made:
                camera = Camera(matches.truth.camera.image_size).with_guessed_focal()
                pairs.append(PairMatches(matches.points1, matches.points2, camera, camera))
            print(f"\n{count} pairs of {MATCHES} matches, {motion}, {100 * outliers:.0f} % outliers")
            print(f"{'':34s}{'ms a pair':>10s}{'mean':>8s}{'|Δλ|':>9s}")
            for name, seconds, found in _estimators(pairs):
                error = np.median(np.abs(found - truth))
                print(f"{name:34s}{1e3 * np.median(seconds):10.2f}{1e3 * seconds.mean():8.2f}{error:9.4f}")


def _estimators(pairs: list[PairMatches]) -> Iterator[tuple[str, FloatArray, FloatArray]]:
    """Name, seconds of each pair, and λ of each pair; inf where there is none."""
    how = EstimationOptions(select_below=_SELECT_BELOW)
    rounds = [timed(lambda: estimate_radial_homographies(pairs, how)) for _ in range(_ROUNDS)]
    seconds, found = min(rounds, key=lambda result: result[0])
    yield "rdstitch, all pairs in a batch", np.full(len(pairs), seconds / len(pairs)), _distortions(found)
    for name, options in (("rdstitch, one by one", how), ("  with competing motion models", EstimationOptions())):
        alone = [timed(partial(_alone, pair, options)) for pair in pairs]
        yield name, np.array([taken for taken, _ in alone]), _distortions([one for _, one in alone])
    peers = lomsac_estimators()
    if not peers:
        print("homlib is not installed (pip install homlib): it is left out")
    for peer in peers:
        runs = [timed(partial(peer.run, pair.points1, pair.points2, pair.camera1.image_size)) for pair in pairs]
        yield peer.name, np.array([taken for taken, _ in runs]), np.array([one.distortion for _, one in runs])


def _alone(pair: PairMatches, options: EstimationOptions) -> rdstitch.RadialHomography:
    return estimate_radial_homographies([pair], options)[0]


def _distortions(found: list[rdstitch.RadialHomography]) -> FloatArray:
    return np.array([one.distortion if one else np.inf for one in found])


def print_mosaic(name: str, folder: Path, sequence: RenderedSequence | None = None) -> None:
    """A line: processor time, λ, pairs, errors against the truth where it is known; and one of the stages."""
    stages = StageTimes()
    options = rdstitch.StitchOptions(workers=1, overwrite=True, force=True)
    with TemporaryDirectory() as output:
        seconds, result = timed(lambda: rdstitch.mosaic([folder], Path(output) / "out.jpg", options, progress=stages))
    alignment, pairs = result.registration.alignment, result.registration.pairs
    used, count = int(alignment.used.sum()), len(alignment.used)
    line = _times(name, seconds, count, result.canvas.size)
    line += f"  λ {alignment.distortion:+.5f}  {used}/{count} images  {len(pairs)} pairs"
    if sequence is not None:
        error = registration_error(alignment, sequence, "similarity")
        line += f"  error {error.median:.3f}, 95 % {error.percentile95:.3f} px"
    print(line)
    print("    " + ", ".join(f"{stage} {taken:.1f}" for stage, taken in stages.spent.items() if taken > 0.05))


def _times(name: str, seconds: float, images: int, size: tuple[int, int]) -> str:
    """Processor time of the whole, of an image, and of a megapixel of output; others leave images out."""
    megapixels = size[0] * size[1] / 1e6
    each = f"{seconds / megapixels:9.2f}" if megapixels else f"{'-':>9s}"
    return f"{name:34s}{seconds:8.1f}{seconds / images:10.3f}{each}"


def print_peers(files: list[Path], peer_python: str | None) -> None:
    """Processor time of other stitchers on the same images, whatever comes of it."""
    stitchers, notes = installed_stitchers(peer_python)
    for stitcher in stitchers:
        if stitcher.name in _COMPARED:
            with TemporaryDirectory() as folder:
                output = Path(folder) / "out.tif"
                done = run_all(stitcher.commands(files, output, 60.0), Path(folder), 600.0)
                height, width = read_image(output).pixels.shape[:2] if output.exists() else (0, 0)
            status = "time is up" if done.status is None else f"exit status {done.status}"
            print(f"{_times(stitcher.name, done.processor_seconds, len(files), (width, height))}  {status}")
    print(*notes, sep="\n")


def main(
    *,
    pairs: int = 100,
    frames: int = 80,
    views: bool = True,
    folder: tuple[Path, ...] = (),
    peer_python: str | None = None,
) -> None:
    """Print the tables."""
    if pairs:
        print_pairs(pairs)
    print(f"\n{'processor time of mosaic, s':34s}{'whole':>8s}{'an image':>10s}{'a Mpx':>9s}")
    with TemporaryDirectory() as rendered:
        work: list[tuple[str, Path, RenderedSequence | None]] = []
        if views:
            work.append(("12 views of 640 x 480", Path(rendered) / "views", SETS[0].sequence(seed=100)))
        if frames:
            drive = floor_drive("parking", frames, seed=23, overlap=0.75, size=(480, 360))
            work.append((f"{frames} frames of 480 x 360", Path(rendered) / "frames", drive))
        for _, place, sequence in work:
            assert sequence is not None
            place.mkdir()
            sequence.write(place)
        for name, place, sequence in [*work, *((own.name, own, None) for own in folder)]:
            print_mosaic(name, place, sequence)
            print_peers(sorted(path.resolve() for path in place.iterdir() if path.suffix != ".csv"), peer_python)
    print(f"\nlargest memory {peak_memory():.0f} MB")


if __name__ == "__main__":
    run(main)
