"""What all detectors have in common: they find keypoints, some are chosen, and those are described."""

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from rdstitch.arrays import FloatArray
from rdstitch.features.keypoints import Features
from rdstitch.features.learned import AlikedDetection
from rdstitch.features.opencv import OpenCVDetection
from rdstitch.features.options import FeatureOptions
from rdstitch.features.strips import LARGE, StripsDetection
from rdstitch.features.surf.detection import SurfDetection


class Detection(Protocol):
    """Keypoints of one picture, not yet described; always in the same order for the same picture."""

    @property
    def points(self) -> FloatArray:
        """Places, pixels of the picture, (N, 2)."""
        ...

    @property
    def scale(self) -> FloatArray:
        """Diameters, pixels, (N,)."""
        ...

    @property
    def response(self) -> FloatArray:
        """Strengths, (N,)."""
        ...

    def describe(self, chosen: NDArray[np.intp]) -> Features:
        """Features of the chosen keypoints, in their order; some may have no descriptor and drop out."""
        ...


def find(grey: NDArray[np.uint8], options: FeatureOptions) -> Detection:
    """Find the keypoints of a picture by the detector that the options name."""
    if options.kind == "surf":
        return SurfDetection.find(grey, options)
    if options.kind == "aliked":
        return AlikedDetection.find(grey, options)
    if options.kind in ("sift", "rootsift") and grey.size > LARGE:
        return StripsDetection.find(grey, options)
    return OpenCVDetection.find(grey, options)
