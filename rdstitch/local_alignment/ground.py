"""Heights of rough ground: one surface for all images, from the parallax that it leaves between them.

What lies at the height ``z`` over ``X`` of the plane is seen by a camera at the height ``h`` over ``c`` where its ray
meets the plane, at ``X + (X - c) z / (h - z)``. One number explains a match, where fields of the images have two in
either; and images displaced by it show the ground straight from above (a true orthophoto), not only alike.
"""

from dataclasses import dataclass, replace
from typing import Self

import numpy as np
from numpy.typing import NDArray

from rdstitch.arrays import FloatArray
from rdstitch.local_alignment.field import grid_shape, node_points, nodes_around
from rdstitch.local_alignment.fit import PlacedFields, Reweighting, Stiffness, factorized, interpolation, smoothness
from rdstitch.local_alignment.matches import ImagesOnSurface, PlacedMatches
from rdstitch.system.late_imports import sparse

_HIGHEST = 0.5  # of the height of the lowest camera: what is higher comes near it, where parallax has no bound
_MAX_NODES = 40_000  # of more, the grid is coarser


@dataclass(frozen=True, eq=False)
class Ground:
    """Heights at the nodes of a square grid over the plane; lengths in pixels of the median image."""

    origin: FloatArray  # (2,): place of the first node
    spacing: float
    heights: FloatArray  # (rows, columns)
    centers: FloatArray  # (N, 3): where the cameras are above the plane

    @classmethod
    def flat(cls, matches: PlacedMatches, centers: FloatArray, spacing: float) -> Self:
        """The plane, wherever there are matches."""
        origin = matches.places.min(axis=(0, 1)) - spacing
        extent = matches.places.max(axis=(0, 1)) + spacing - origin
        spacing = max(spacing, float(np.sqrt(extent.prod() / _MAX_NODES)))
        columns, rows = np.ceil(extent / spacing).astype(int) + 1
        return cls(origin, spacing, np.zeros((rows, columns)), centers)

    def nodes(self, places: FloatArray) -> tuple[NDArray[np.intp], FloatArray]:
        """Nodes (M, 4) around places (M, 2) and their weights (M, 4)."""
        return nodes_around((places - self.origin) / self.spacing, self.heights.shape)

    def fields(self, images: ImagesOnSurface, stiffness: Stiffness) -> PlacedFields:
        """How far it displaces what each image shows."""
        shapes, values = tuple(grid_shape(camera.image_size, stiffness.cells) for camera in images.cameras), []
        for k, (camera, shape) in enumerate(zip(images.cameras, shapes, strict=True)):
            places = np.nan_to_num(images.to_surface(k, node_points(camera.image_size, shape)))
            nodes, weights = self.nodes(places)
            height = (self.heights.ravel()[nodes] * weights).sum(axis=-1, keepdims=True)
            values.append((places - self.centers[k, :2]) * (height / (self.centers[k, 2] - height)))
        return PlacedFields(images, stiffness, shapes, tuple(values))


def fit_ground(matches: PlacedMatches, images: ImagesOnSurface, centers: FloatArray, stiffness: Stiffness) -> Ground:
    """The ground that explains matches of images whose camera centres (N, 3) are known, by reweighted least squares."""
    sides = [max(camera.image_size) for camera in images.cameras]
    ground = Ground.flat(matches, centers, float(np.median(sides)) / stiffness.cells)
    below, above = centers[matches.images, :2], centers[matches.images, 2:]
    highest = _HIGHEST * float(above.min())
    # What a height displaces in an image, in the middle of the matches: stiffness is of displacements.
    lever = float(np.median(np.linalg.norm(matches.places - below, axis=-1) / above[..., 0]))
    prior = smoothness(ground.heights.shape, ground.spacing, stiffness.slope / lever, float(np.median(sides)))
    height, residual, reweighting = np.zeros((len(matches), 1, 1)), matches.residual, Reweighting(matches)
    while (weight := reweighting.weights(residual)) is not None:
        ratio = height / (above - height)
        places = ((matches.places + ratio * below) / (1.0 + ratio)).mean(axis=1)
        by_height = (places[:, None] - below) / (above - height)  # displacement in either image of a unit of height
        parallax = by_height[:, 0] - by_height[:, 1]
        design = interpolation(*ground.nodes(places), ground.heights.size)
        weighted = sparse.csr_array(design.T * (weight * (parallax**2).sum(axis=1)))
        right = design.T @ (weight * (parallax * matches.residual).sum(axis=1))
        solved = np.minimum(factorized(weighted @ design + prior).solve(right), highest)
        ground = replace(ground, heights=solved.reshape(ground.heights.shape))
        height = (design @ solved)[:, None, None]
        residual = matches.residual - parallax * height[:, 0]
    return ground
