"""From registered pictures to one picture: canvas, resampling, exposure, seams, blending."""

from rdstitch.compositing.canvas import Canvas, plan_canvas
from rdstitch.compositing.compose import Composite, compose
from rdstitch.compositing.options import CompositeOptions

__all__ = ["Canvas", "Composite", "CompositeOptions", "compose", "plan_canvas"]
