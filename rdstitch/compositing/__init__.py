"""From registered images to one image: canvas, resampling, exposure, seams, blending."""

from rdstitch.compositing.canvas import Canvas, plan_canvas
from rdstitch.compositing.compositor import Composite, FileComposite, compose, compose_decided, compose_to_file
from rdstitch.compositing.panorama_canvas import plan_panorama
from rdstitch.compositing.plan import CompositePlan, plan_composite
from rdstitch.compositing.preparation import Decisions, decide, planned
from rdstitch.compositing.seam_quality import SeamBreak, SeamQuality
from rdstitch.compositing.source_images import PlacedImage
from rdstitch.options.composite_options import CompositeOptions

__all__ = [
    "Canvas",
    "Composite",
    "CompositeOptions",
    "CompositePlan",
    "Decisions",
    "FileComposite",
    "PlacedImage",
    "SeamBreak",
    "SeamQuality",
    "compose",
    "compose_decided",
    "compose_to_file",
    "decide",
    "plan_canvas",
    "plan_composite",
    "plan_panorama",
    "planned",
]
