"""From nominal places and tiles to all places: correlate, learn the stage, refine, adjust."""

import math
from dataclasses import dataclass, replace
from enum import Enum, auto
from typing import Literal

import numpy as np

from rdstitch.arrays import BoolArray, FloatArray, IntArray
from rdstitch.errors import ArgumentError
from rdstitch.geometry.camera import Camera
from rdstitch.matching.match_graph import connected_components
from rdstitch.stage.adjustment import Adjustment, adjust
from rdstitch.stage.choose_places import choose_places
from rdstitch.stage.equations import LinkedPoints
from rdstitch.stage.grid import TileGrid
from rdstitch.stage.overlap import Overlap
from rdstitch.stage.pair_candidates import PairFinder, Reader, SearchPlan, in_pairs
from rdstitch.stage.refinement import BlockMatches, PointMap, refine
from rdstitch.system.progress import Progress, silent

_MAX_STD = 1.0  # coarse pixels: a refined place that is less sure than that was not found

# When a lens is taken to be there.
_LENS_SHOWN = 5.0  # standard deviations that pairs along rows and pairs along columns must show each
_LENS_AGREES = 0.25  # of λ: by how much the two may differ beyond chance
_WHOLE_PIXEL = 0.5  # pixels by which a lens must move corners: leaving whole pixels costs as much


class LensEstimate(Enum):
    """What is taken for a λ that is not known."""

    FREE = auto()  # what all tiles together show
    IF_SHOWN = auto()  # the same where pairs along rows and pairs along columns agree on it, else 0


@dataclass(frozen=True, eq=False)
class TileRegistration:
    """The places of all tiles, and the matches that show them."""

    plan: SearchPlan  # how neighbours were looked for
    adjustment: Adjustment
    links: LinkedPoints  # blocks of all pairs that show something
    compared: IntArray  # (Q, 2), int: all pairs that were compared
    groups: tuple[tuple[int, ...], ...]  # tiles that links hold together, the largest group first
    z: int | Literal["max"] | None = None  # z, time: plane and time of the files that were read, where they were chosen
    time: int | None = None

    @property
    def grid(self) -> TileGrid:
        """The tiles, and where they should be."""
        return self.plan.grid

    @property
    def linked(self) -> BoolArray:
        """Which tiles links hold (N,); the others have the place that the model of the stage gives them."""
        return np.isin(np.arange(len(self.grid)), [tile for group in self.groups for tile in group])

    @property
    def stds(self) -> FloatArray:
        """Standard deviation of each tile's place against the largest group, in x and in y, pixels (N,)."""
        group = self.groups[0] if self.groups else range(len(self.grid))
        return self.adjustment.stds(np.array(group))

    @property
    def off_stage(self) -> FloatArray:
        """How far each tile is from where the model of the stage has it, pixels (N,)."""
        return np.asarray(np.linalg.norm(self.adjustment.off_stage, axis=1))

    @property
    def contradicting(self) -> IntArray:
        """Pairs (K, 2) that hold their tiles, but where the grid does not have them by half a tile or more."""
        held = self.links.tiles[self.adjustment.holding]
        shown, told = (places[held[:, 1]] - places[held[:, 0]] for places in (self.adjustment.places, self.grid.places))
        return held[(np.abs(shown - told) > np.array(self.grid.size) / 2.0).any(axis=1)]

    @property
    def mostly_nominal(self) -> bool:
        """Whether more tiles have their places from the stage alone than from what they show."""
        return 2 * int(self.linked.sum()) < len(self.grid)


def register_tiles(
    plan: SearchPlan,
    read: Reader,
    *,
    distortion: float | LensEstimate = LensEstimate.IF_SHOWN,
    progress: Progress = silent,
) -> TileRegistration:
    """Find the places of all tiles, with a λ that is known, or one that they show."""
    if distortion is LensEstimate.FREE and plan.grid.tile_sizes is not None:
        raise ArgumentError("tiles of different sizes do not show λ; give it with --lambda, or leave that out")
    pairs = plan.grid.neighbours(plan.search)
    known = None if isinstance(distortion, LensEstimate) else distortion
    finder = PairFinder(plan, pairs)
    candidates, lens = finder.candidates(read, known, progress)
    chosen = choose_places(pairs, candidates, plan, lens)
    matches: dict[int, BlockMatches] = {}
    camera = Camera(plan.grid.size, lens)
    tiles = in_pairs(read, pairs[list(chosen)])
    for count, ((number, offset), (one, two)) in enumerate(zip(chosen.items(), tiles, strict=True)):
        overlap = finder.overlap(number, offset, 1)
        for cells in (overlap.cells(plan.grid.size), overlap.whole):
            cut = replace(overlap, blocks=cells)
            refined = refine(one, two, cells, _transfer(cut, offset, camera), plan.factor + 1.5)
            # What is less sure than the coarse place was not found by looking around that.
            if refined.std < _MAX_STD * plan.factor:
                matches[number] = refined
                break
        progress("refining", count + 1, len(chosen))
    links = LinkedPoints.of(pairs, matches)
    fitted = _with_lens(plan, links, lens, distortion)
    held = links.tiles[fitted.holding]
    groups = connected_components(len(plan.grid), *held.T)
    together = tuple(tuple(group) for group in groups if len(group) > 1)
    return TileRegistration(plan, fitted, links, pairs, together)


def _with_lens(plan: SearchPlan, links: LinkedPoints, lens: float, distortion: float | LensEstimate) -> Adjustment:
    """All places, with λ where it is known, asked for, or shown; ``lens`` is where its estimate starts."""
    grid, std = plan.grid, plan.stage_std
    if not isinstance(distortion, LensEstimate):
        return replace(adjust(grid, links, std, float(distortion)), distortion_std=0.0)
    straight = adjust(grid, links, std)
    if not len(links.pair) or grid.tile_sizes is not None:
        return straight
    bent = adjust(grid, links, std, lens, free_lens=True)
    better = straight.cost(bent.noise) - bent.cost(bent.noise) > math.log(max(2, len(links.pair)))
    moved = abs(bent.distortion) * math.hypot(*grid.size) / 2.0
    if distortion is LensEstimate.FREE:
        return bent
    if better and moved > _WHOLE_PIXEL and _lens_is_there(grid, links, std, bent.distortion):
        return bent
    return replace(straight, distortion_std=max(bent.distortion_std, abs(bent.distortion)))


def _lens_is_there(grid: TileGrid, links: LinkedPoints, std: float, lens: float) -> bool:
    """Check whether pairs along rows and pairs along columns show the same λ: what else bends tiles does not."""
    off = np.abs(grid.places[links.tiles[:, 1]] - grid.places[links.tiles[:, 0]])
    estimates = []
    for along in (off[:, 0] > off[:, 1], off[:, 0] <= off[:, 1]):
        part = links.of_pairs(along)
        if not len(part.pair):
            return False
        fitted = adjust(grid, part, std, lens, free_lens=True)
        estimates.append((fitted.distortion, fitted.distortion_std))
    (a, a_std), (b, b_std) = estimates
    agree = abs(a - b) <= max(_LENS_AGREES * abs(a + b) / 2.0, 3.0 * math.hypot(a_std, b_std))
    return agree and a * b > 0.0 and all(abs(value) > _LENS_SHOWN * deviation for value, deviation in estimates)


def _transfer(overlap: Overlap, offset: FloatArray, camera: Camera) -> PointMap:
    """Map points of the first tile to the second, whose blocks are off by an offset in the mean."""
    if camera.distortion == 0.0:
        return lambda points: points - offset
    middle = overlap.centers
    between = (camera.undistort(middle) - camera.undistort(middle - offset)).mean(axis=0)
    return lambda points: camera.distort(camera.undistort(points) - between)
