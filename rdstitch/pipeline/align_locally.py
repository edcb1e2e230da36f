"""Stage: displacement fields of a registration's images, from all matches of their pairs."""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

import numpy as np

from rdstitch.arrays import FloatArray
from rdstitch.choices import LocalAlignmentMode
from rdstitch.features.line_segments import MEGAPIXELS, line_segments
from rdstitch.inputs.source import Source
from rdstitch.local_alignment import LocalAlignment, Match, align_locally, no_local_alignment
from rdstitch.matching.two_view import PairRegistration
from rdstitch.results.registration import Registration


def straight_edges(source: Source) -> FloatArray:
    """Ends (N, 2, 2) of the straight edges in an image, pixels."""
    return line_segments(source.view(MEGAPIXELS))[0]


def align_registration_locally(
    registration: Registration,
    choice: LocalAlignmentMode,
    edges: Callable[[int], FloatArray] | None = None,
    threads: int = 1,
) -> LocalAlignment:
    """Displacement fields of the images that are used, in their order, from the matches of all their pairs.

    ``edges`` are those of an image that fields should not bend.
    """
    if choice == "off":
        return no_local_alignment("switched off")
    alignment = registration.alignment
    used, poses = np.flatnonzero(alignment.used), alignment.poses
    position = np.cumsum(alignment.used) - 1
    pairs = [
        pair
        for pair in registration.pairs
        if pair.relation and alignment.used[pair.image1] and alignment.used[pair.image2]
    ]

    def match(pair: PairRegistration) -> Match:
        found = pair.correspondences
        return Match(int(position[pair.image1]), int(position[pair.image2]), found.points1, found.points2)

    def edges_of(images: list[int]) -> list[FloatArray]:
        with ThreadPoolExecutor(threads) as pool:
            return list(pool.map(edges or (lambda k: straight_edges(registration.sources[k])), used[images].tolist()))

    return align_locally(
        map(match, pairs),
        [alignment.cameras[k] for k in used],
        alignment.homographies[used],
        choice,
        pairs=len(pairs),
        on_sphere=alignment.on_sphere,
        centers=None if poses is None or alignment.on_sphere else np.column_stack([poses.position, poses.height])[used],
        edges=edges_of,
    )
