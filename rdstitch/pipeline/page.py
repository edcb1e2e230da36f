"""The page beside a Deep Zoom picture: what it says of each picture."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from rdstitch.compositing import Canvas
from rdstitch.io.outputs import Outputs
from rdstitch.pipeline.compose import Composed
from rdstitch.stitch_result import StitchResult
from rdstitch.viewer import ViewedPicture, viewer_page, viewer_path


def write_page(outputs: Outputs, output: str | Path, composed: Composed, pictures: Sequence[ViewedPicture]) -> None:
    """Write the page of a ``.dzi`` output; others have none."""
    page, written = viewer_path(output), composed.written
    if page is not None and written is not None:
        text = viewer_page(output, composed.canvas.size, pictures, written.seams, written.origin)
        # Names of files need not be UTF-8.
        outputs.write(page, text.encode("utf-8", "backslashreplace"))


def plainly_viewed(canvas: Canvas, names: Sequence[str]) -> list[ViewedPicture]:
    """The pictures on a canvas, of which nothing was estimated."""
    return [ViewedPicture(name, outlines, ()) for name, outlines in zip(names, canvas.outlines, strict=True)]


def viewed_pictures(result: StitchResult) -> list[ViewedPicture]:
    """The pictures of a result with what was found of each."""
    alignment, registration = result.registration.alignment, result.registration
    names = [source.name for source in registration.sources]
    viewed = []
    for outlines, index in zip(result.canvas.outlines, np.flatnonzero(alignment.used).tolist(), strict=True):
        source = registration.sources[index]
        links = [fit for fit in alignment.links if fit.used and index in (fit.image1, fit.image2)]
        facts = [
            ("size", "{} x {} pixels".format(*source.camera.image_size)),
            ("features", str(registration.keypoints[index])),
            ("matches", str(sum(fit.inliers for fit in links))),
        ]
        partners = [f"{names[fit.image1 + fit.image2 - index]} ({fit.inliers}, {fit.rms:.2f} pixels)" for fit in links]
        facts.append(("pairs", ", ".join(partners)))
        if alignment.poses is not None:
            poses = alignment.poses
            facts += [
                ("position", "{:.3f}, {:.3f} heights".format(*poses.position[index])),
                ("height", f"{poses.height[index]:.3f}"),
                ("yaw", f"{np.degrees(poses.yaw[index]):.2f}°"),
                ("tilt", "{:.2f}°, {:.2f}°".format(*np.degrees(poses.tilt[index]))),
            ]
        if index == alignment.reference:
            facts.append(("reference", "yes"))
        viewed.append(ViewedPicture(names[index], outlines, tuple(facts)))
    return viewed
