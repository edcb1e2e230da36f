"""Small real registrations: a row of images over a plane, aligned once, with what a test says of them."""

from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from examples.worlds.alignment_scenes import grid, scene
from rdstitch.alignment import Alignment, AlignmentOptions, align
from rdstitch.choices import Purpose
from rdstitch.compositing import plan_canvas
from rdstitch.executors import open_executor
from rdstitch.geometry.camera import Camera
from rdstitch.inputs.source import Source, read_sources
from rdstitch.io.mask import Mask
from rdstitch.io.metadata import Metadata
from rdstitch.matching.two_view import PairRegistration
from rdstitch.options.composite_options import CompositeOptions
from rdstitch.options.stitch_options import StitchOptions
from rdstitch.pipeline.registration.register import register
from rdstitch.pipeline.run import Run
from rdstitch.results.messages import Severity
from rdstitch.results.placed_images import PlacedImages
from rdstitch.results.registration import Registration
from rdstitch.results.stitch_result import StitchResult
from rdstitch.verification.evidence import ResultEvidence
from rdstitch.verification.findings import Finding, Kind

CAMERA = Camera((400, 300))


def source(name: str = "a.jpg", *, mask: Mask | None = None, **metadata: Any) -> Source:
    """An image in ``folder``, of which there is nothing but its name and what is said of it."""
    return Source(Path("folder") / name, Metadata(CAMERA.image_size, **metadata), CAMERA, mask)


@cache
def _aligned(count: int) -> Alignment:
    rng = np.random.default_rng(0)
    poses = grid(count, 1, (0.4, 0.3), 0.1, rng)
    given = scene(poses, size=CAMERA.image_size, focal=380.0, per_link=60, outliers=0.0, rng=rng)
    return align(given.cameras, given.links, AlignmentOptions(model="rigid", lens="division"))


def registration(
    images: int | Sequence[Source] = 3,
    pairs: Sequence[PairRegistration] = (),
    keypoints: Sequence[int] = (),
    mixed: Any = None,
    **alignment: Any,
) -> Registration:
    """Of so many images, called a.jpg and so on, or of these; what is said of the alignment replaces what was found."""
    sources = [source(f"{name}.jpg") for name in "abcdef"[:images]] if isinstance(images, int) else images
    found = replace(_aligned(max(2, len(sources))), **alignment)
    return Registration(tuple(sources), tuple(keypoints), tuple(pairs), found, (), mixed=mixed)


def stitched(given: Registration, output: Path | None = None, **composite: Any) -> StitchResult:
    """With its canvas, as if its image had been written."""
    placed, options = PlacedImages.of(given, None), StitchOptions(composite=CompositeOptions(**composite))
    canvas = plan_canvas(placed.cameras, placed.homographies)
    return StitchResult(registration=given, placed=placed, canvas=canvas, options=options, output=output)


def registered(frames: Sequence[Path], options: StitchOptions, focal: float | None = 380.0) -> Registration:
    """Of images in files."""
    sources, _ = read_sources(frames, focal=focal, distortion=options.distortion, skip_bad=False)
    with open_executor(1, len(sources)) as executor:
        return register(sources, Run(options), executor)


def evidence(
    given: Registration, purpose: Purpose = Purpose.TRAJECTORY, threshold: float = 3.0, **known: Any
) -> ResultEvidence:
    """Everything that rules look at; what is known is not computed."""
    found = ResultEvidence(given, threshold, purpose=purpose)
    vars(found).update(known)
    return found


def finding(kind: Kind, images: tuple[int, ...] = (), severity: Severity = "failure") -> Finding:
    """A finding of which nothing matters but its kind."""
    return Finding(kind, severity, images, dict.fromkeys(kind.measured, 0))
