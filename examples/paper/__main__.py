"""``python -m examples.paper [FIGURE …] [--full] [--output DIR]``."""

import argparse
import sys
import time
from importlib import import_module
from pathlib import Path

from examples.paper.common.report import Effort, Settings, save

FIGURES = {
    "runtime": "time per instance of the solvers",
    "figure2": "numerical stability",
    "figure3": "noise, tilt unknown",
    "figure4": "noise, tilt known",
    "figure5": "pairs through a fisheye lens, stitched",
    "figure7": "inliers against RANSAC iterations",
    "figure8": "votes on λ, and a chart undistorted and rectified",
    "figure9": "trajectories",
    "figure10": "aerial surveys with and without λ",
    "homography_estimation": "robust estimators on pairs with distortion",
    "end_to_end": "rendered sets stitched by rdstitch and by the peers",
    "panoramas": "rendered turns on the spot stitched by rdstitch and by the peers",
}
"""Modules in the order in which they run, with what they measure."""

_REAL_IMAGES = Path(__file__).resolve().parents[2] / "../shared/data"


def main(arguments: list[str] | None = None) -> int:
    """Run the figures asked for; print their tables, write plots where there is an output folder."""
    parser = argparse.ArgumentParser(
        prog="python -m examples.paper",
        description="Reproduce the paper's figures and measure the peers.",
        epilog="Figures: " + ", ".join(f"{name} ({what})" for name, what in FIGURES.items()) + ".",
    )
    parser.add_argument("figures", nargs="*", metavar="FIGURE", help="which ones; all if not given")
    parser.add_argument("--full", action="store_true", help="the paper's counts: minutes to hours")
    parser.add_argument("--output", type=Path, metavar="DIR", help="write tables, plots and images there")
    parser.add_argument("--images", type=Path, metavar="DIR", default=_REAL_IMAGES, help="folder of the real sequences")
    parser.add_argument("--peer-python", metavar="FILE", help="Python that has the package stitching")
    parser.add_argument("--hpatches", type=Path, metavar="DIR", help="folder of HPatches' sequences")
    options = parser.parse_args(arguments)
    unknown = set(options.figures) - set(FIGURES)
    if unknown:
        parser.error(f"unknown figure {', '.join(sorted(unknown))}; there are {', '.join(FIGURES)}")
    settings = Settings(
        Effort.FULL if options.full else Effort.SMALL, options.images, options.peer_python, options.hpatches
    )
    for name in options.figures or FIGURES:
        begun = time.perf_counter()
        report = import_module(f"examples.paper.{name}").run(settings)
        print(report)
        if options.output is not None:
            print("\n".join(save(report, name, options.output)))
        print(f"({name}: {time.perf_counter() - begun:.1f} s)\n", flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
