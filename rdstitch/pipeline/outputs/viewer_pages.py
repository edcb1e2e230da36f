"""The page beside a Deep Zoom image, with what was found of each image in it."""

from collections.abc import Callable, Sequence

import numpy as np

from rdstitch.alignment.result import links_by_image
from rdstitch.compositing import Canvas
from rdstitch.results.messages import Message
from rdstitch.results.stitch_result import OutputImage, StitchResult
from rdstitch.system.outputs import Outputs
from rdstitch.viewer.page import ViewedImage, viewer_page, viewer_path


def write_page(result: OutputImage, outputs: Outputs, images: Callable[[], Sequence[ViewedImage]]) -> list[Message]:
    """Write the page of a ``.dzi`` output, if it is one; with a warning if that fails."""
    output, written = result.output, result.written
    if output is None or written is None or (page := viewer_path(output)) is None:
        return []
    gsd = None if result.georeference is None else result.georeference.gsd

    def stage() -> None:
        text = viewer_page(output, result.canvas.size, images(), written.seams, written.origin, gsd)
        # Names of files need not be UTF-8.
        outputs.write(page, text.encode("utf-8", "backslashreplace"))

    return outputs.attempt(page, stage)


def plainly_viewed(canvas: Canvas, names: Sequence[str]) -> list[ViewedImage]:
    """The images on a canvas, without estimates."""
    return [ViewedImage(name, outlines, ()) for name, outlines in zip(names, canvas.outlines, strict=True)]


def viewed_images(result: StitchResult) -> list[ViewedImage]:
    """The images of a result, each with its estimates."""
    alignment, registration = result.registration.alignment, result.registration
    names = [source.name for source in registration.sources]
    links_of = links_by_image(alignment.holding)
    viewed = []
    for outlines, index in zip(result.canvas.outlines, np.flatnonzero(alignment.used).tolist(), strict=True):
        source = registration.sources[index]
        links = links_of.get(index, [])
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
        viewed.append(ViewedImage(names[index], outlines, tuple(facts)))
    return viewed
