"""SURF in the steps that all detectors take: find, choose, describe."""

from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray

from rdstitch.arrays import FloatArray
from rdstitch.features.keypoints import Features
from rdstitch.features.options import FeatureOptions
from rdstitch.features.surf.descriptor import describe_patches
from rdstitch.features.surf.hessian import Blobs, find_blobs
from rdstitch.features.surf.orientation import orientations
from rdstitch.features.surf.pyramid import Grey, pyramid
from rdstitch.features.surf.refinement import refine


@dataclass(frozen=True, eq=False)
class SurfDetection:
    """Blobs of a picture, to be described."""

    levels: list[Grey]
    blobs: Blobs
    upright: bool
    extended: bool

    @classmethod
    def find(cls, grey: Grey, options: FeatureOptions) -> Self:
        """Find the blobs of a picture."""
        blobs = find_blobs(grey, options.surf_threshold, options.surf_octaves, options.surf_layers)
        levels = pyramid(grey, options.surf_octaves + 3)
        if options.surf_refine:
            blobs = refine(levels, blobs)
        return cls(levels, blobs, options.surf_upright, options.surf_extended)

    @property
    def points(self) -> FloatArray:
        """Places, pixels of the picture, (N, 2)."""
        return self.blobs.points

    @property
    def scale(self) -> FloatArray:
        """Diameters, pixels, (N,)."""
        return self.blobs.size

    @property
    def response(self) -> FloatArray:
        """Strengths, (N,)."""
        return self.blobs.response

    def describe(self, chosen: NDArray[np.intp]) -> Features:
        """Orient and describe the chosen blobs."""
        blobs = self.blobs.take(chosen)
        angle = np.zeros(len(blobs)) if self.upright else orientations(self.levels, blobs.points, blobs.scale)
        return Features(
            points=blobs.points,
            descriptors=describe_patches(self.levels, blobs.points, blobs.scale, angle, self.extended),
            scale=blobs.size,
            angle=angle,
            response=blobs.response,
            laplacian_sign=blobs.laplacian_sign,
            kind="surf",
        )
