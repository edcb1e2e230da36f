"""Stage: displacement fields of the pictures of a registration, where the ground is not quite a plane."""

import numpy as np

from rdstitch.local_alignment import LocalAlignment, LocalAlignmentMode, Match, align_locally, no_local_alignment
from rdstitch.registration import Registration


def align_registration_locally(registration: Registration, choice: LocalAlignmentMode) -> LocalAlignment:
    """Displacement fields of the pictures that are used, in their order, from the matches of all their pairs.

    Parameters
    ----------
    registration : Registration
        In pixels of the pictures.
    choice : "auto", "off" or int
        See :func:`rdstitch.local_alignment.align_locally`.
    """
    alignment = registration.alignment
    if alignment.on_sphere:
        return no_local_alignment("a camera that turned on the spot sees no relief")
    position = np.cumsum(alignment.used) - 1
    matches = [
        Match(
            int(position[pair.image1]),
            int(position[pair.image2]),
            pair.correspondences.points1,
            pair.correspondences.points2,
        )
        for pair in registration.pairs
        if pair.relation and alignment.used[pair.image1] and alignment.used[pair.image2]
    ]
    cameras = [camera for camera, used in zip(alignment.cameras, alignment.used, strict=True) if used]
    return align_locally(matches, cameras, alignment.homographies[alignment.used], choice)
