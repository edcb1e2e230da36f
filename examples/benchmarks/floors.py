"""How far each stage is from its floor: ``python -m examples.benchmarks.floors FOLDER …``.

Processor seconds of a mosaic's stages with one worker, and of the least that can be done in their place: images decoded
once by OpenCV, SIFT in one pass at the working size, one product of all descriptors of each pair, ten linearizations of
all inliers, one remap of each image to where it lies, and the output encoded at once.
"""

import sys
import time
from collections.abc import Callable
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from functools import wraps
from importlib import import_module
from pathlib import Path
from tempfile import TemporaryDirectory
from threading import local
from typing import Any
from unittest.mock import patch

import cv2
import numpy as np
from numpy.typing import NDArray

import rdstitch
from examples.benchmarks.driver import images_of, run, timed
from rdstitch.features.opencv import SIFT_CONTRAST
from rdstitch.geometry.radial_homography import transfer_jacobian
from rdstitch.options.feature_options import FeatureOptions

# What is first imported while functions are timed would keep the timers of the first folder.
from rdstitch.pipeline.recipes import mosaic

_FUNCTIONS = {
    "decode": ("rdstitch.io.read:read_image",),
    "detect and describe": ("rdstitch.features.detect:detect_view",),
    "match": ("rdstitch.matching.two_view:match_pairs",),
    "estimate pairs": ("rdstitch.matching.two_view:estimate_pairs",),
    "adjust": (
        "rdstitch.pipeline.registration.aligner:Aligner.draft",
        "rdstitch.pipeline.registration.aligner:Aligner.completed",
    ),
    "exposure and seams": (
        "rdstitch.compositing.survey:survey_images",
        "rdstitch.compositing.gain_compensation:estimate_exposure",
        "rdstitch.compositing.seam_finder:find_seams",
    ),
    "warp and blend": ("rdstitch.compositing.render:Renderer.tile",),
    "encode": ("rdstitch.io.write_jpeg:_jpeg",),
}
"""The functions of each stage; what one of another stage takes within them is that stage's."""


@dataclass
class Spent:
    """Processor seconds of the stages, without what others take within them."""

    seconds: dict[str, float] = field(default_factory=dict)
    nested: local = field(default_factory=local)

    def timed(self, stage: str, function: Callable[..., Any]) -> Callable[..., Any]:
        """The function, which adds to the time of a stage."""

        @wraps(function)
        def run(*given: Any, **named: Any) -> Any:
            inner: list[float] = self.nested.__dict__.setdefault("inner", [0.0])
            begun = time.thread_time()
            inner.append(0.0)
            try:
                return function(*given, **named)
            finally:
                taken = time.thread_time() - begun
                self.seconds[stage] = self.seconds.get(stage, 0.0) + taken - inner.pop()
                inner[-1] += taken

        return run


@contextmanager
def watched(spent: Spent) -> Any:
    """Time the functions of all stages, wherever they are known by name."""
    with ExitStack() as stack:
        for stage, names in _FUNCTIONS.items():
            for module, _, name in (each.partition(":") for each in names):
                *outer, last = name.split(".")
                owner: Any = import_module(module)
                for each in outer:
                    owner = getattr(owner, each)
                plain = getattr(owner, last)
                timer = spent.timed(stage, plain)
                homes = [known for key, known in sys.modules.items() if key.startswith("rdstitch.")]
                for home in [owner] if outer else [home for home in homes if getattr(home, last, None) is plain]:
                    stack.enter_context(patch.object(home, last, timer))
        yield


def floors(
    images: list[NDArray[np.uint8]], result: rdstitch.StitchResult, output: NDArray[np.uint8]
) -> dict[str, float]:
    """Seconds of the least that can be done in place of each stage but the decoding."""
    options = FeatureOptions().for_images(len(images))
    most, megapixels = options.limits
    sift = cv2.SIFT.create(nfeatures=most, contrastThreshold=SIFT_CONTRAST, enable_precise_upscale=True)
    small = [_reduced(np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)), megapixels) for image in images]
    taken = {}
    taken["detect and describe"], found = timed(lambda: [sift.detectAndCompute(grey, None)[1] for grey in small])
    pairs = result.registration.pairs
    taken["match"], _ = timed(lambda: [found[pair.image1] @ found[pair.image2].T for pair in pairs])
    points = [np.full((int(pair.relation.inliers.sum()), 2), 0.3) for pair in pairs if pair.relation]
    taken["adjust"], _ = timed(lambda: [transfer_jacobian(np.eye(3), -0.1, each) for each in points for _ in range(10)])
    boxes = [np.ptp(np.concatenate(outlines), axis=0).astype(int) + 1 for outlines in result.canvas.outlines]
    maps = [np.meshgrid(*(np.arange(side, dtype=np.float32) for side in box)) for box in boxes]
    taken["warp and blend"], _ = timed(
        lambda: [cv2.remap(image, x, y, cv2.INTER_CUBIC) for image, (x, y) in zip(images, maps, strict=True)]
    )
    taken["encode"], _ = timed(lambda: cv2.imencode(".jpg", output, [cv2.IMWRITE_JPEG_QUALITY, 95]))
    return taken


def _reduced(grey: NDArray[np.uint8], megapixels: float | None) -> NDArray[np.uint8]:
    while megapixels is not None and grey.size > megapixels * 1e6:
        grey = np.asarray(cv2.resize(grey, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA), dtype=np.uint8)
    return grey


def main(folders: tuple[Path, ...]) -> None:
    """Print a table for each folder."""
    cv2.setNumThreads(1)
    for folder in folders:
        print_stages(folder)


def print_stages(folder: Path) -> None:
    """Print the table of a folder."""
    files, spent, options = images_of(folder), Spent(), rdstitch.StitchOptions(workers=1, force=True)
    with TemporaryDirectory() as place:
        file = Path(place) / "out.jpg"
        with watched(spent):
            whole, result = timed(lambda: mosaic(files, file, options))
        output = _decoded(file, cv2.IMREAD_UNCHANGED)
    decode, images = timed(lambda: [_decoded(each, cv2.IMREAD_COLOR) for each in files])
    least = {"decode": decode} | floors(images, result, output)
    print(f"\n{folder.name}, {len(files)} images: {whole:.1f} s\n{'':22s}{'s':>8s}{'floor':>8s}{'times':>8s}")
    for stage in _FUNCTIONS:
        own, floor = spent.seconds.get(stage, 0.0), least.get(stage)
        print(f"{stage:22s}{own:8.2f}" + ("" if floor is None else f"{floor:8.2f}{own / max(floor, 1e-3):8.1f}"))
    print(f"{'all else':22s}{whole - sum(spent.seconds.values()):8.2f}")


def _decoded(file: Path, flags: int) -> NDArray[np.uint8]:
    return np.asarray(cv2.imread(str(file), flags), dtype=np.uint8)


if __name__ == "__main__":
    run(main)
