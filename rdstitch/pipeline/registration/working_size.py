"""Everything between detection and result is measured in pixels of the size that features are detected at.

How well a feature is localised, and so every threshold in pixels, belongs to the size at which it was detected. An
image of 12 megapixels that is halved twice before detection has four times the error in its own pixels. λ, poses and
homographies are in half diagonals, which are the same at every size; only pixels change.
"""

from collections.abc import Sequence
from dataclasses import replace

from rdstitch.features.prepared_image import halving
from rdstitch.geometry.camera import Camera
from rdstitch.matching.two_view import PairRegistration
from rdstitch.results.registration import Registration


def at_working_size(camera: Camera, megapixels: float | None) -> Camera:
    """A camera for its image halved until it has at most so many 10⁶ pixels; the same for None."""
    factor = 1 if megapixels is None else halving(camera.image_size, megapixels)
    width, height = camera.image_size
    return camera.resized((-(-width // factor), -(-height // factor)))


def at_full_size(registration: Registration) -> Registration:
    """A registration with cameras and matches in pixels of the images themselves; errors stay as they are."""
    full = [source.camera for source in registration.sources]
    working = registration.alignment.cameras
    if all(a.image_size == b.image_size for a, b in zip(full, working, strict=True)):
        return registration
    cameras = tuple(camera.resized(original.image_size) for camera, original in zip(working, full, strict=True))
    pairs = tuple(_pair_at_full_size(pair, working, full) for pair in registration.pairs)
    return replace(registration, pairs=pairs, alignment=replace(registration.alignment, cameras=cameras))


def _pair_at_full_size(pair: PairRegistration, working: Sequence[Camera], full: Sequence[Camera]) -> PairRegistration:
    i, j = pair.image1, pair.image2
    after = (full[i].image_size, full[j].image_size)
    return replace(
        pair,
        matches=pair.matches.resized((working[i].image_size, working[j].image_size), after),
        relation=replace(
            pair.relation,
            camera=pair.relation.camera.resized(after[0]),
            camera2=pair.relation.camera2.resized(after[1]),
        ),
    )
