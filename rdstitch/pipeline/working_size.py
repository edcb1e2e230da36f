"""Everything between detection and result is measured in pixels of the size that features are detected at.

How well a feature is localised, and so every threshold in pixels, belongs to the size at which it was detected. A
picture of 12 megapixels that is halved twice before detection has four times the error in its own pixels. λ, poses and
homographies are in half diagonals, which are the same at every size; only pixels change.
"""

from collections.abc import Sequence
from dataclasses import replace

from rdstitch.arrays import FloatArray
from rdstitch.camera import Camera
from rdstitch.features import Features
from rdstitch.features.picture import halving
from rdstitch.matching.two_view import PairRegistration
from rdstitch.registration import Registration


def at_working_size(camera: Camera, megapixels: float | None) -> Camera:
    """A camera for its picture halved until it has at most so many 10⁶ pixels; the same for None."""
    factor = 1 if megapixels is None else halving(camera.image_size, megapixels)
    width, height = camera.image_size
    return camera.resized((-(-width // factor), -(-height // factor)))


def features_at(features: Features, full: Camera, working: Camera) -> Features:
    """Features with points and scales in pixels of the ``working`` size instead of the full one."""
    if full.image_size == working.image_size:
        return features
    return replace(
        features,
        points=_moved(features.points, full, working),
        scale=features.scale * working.half_diagonal / full.half_diagonal,
        image_size=working.image_size,
    )


def at_full_size(registration: Registration) -> Registration:
    """A registration with cameras and matches in pixels of the pictures themselves; errors stay as they are."""
    full = [source.camera for source in registration.sources]
    working = registration.alignment.cameras
    if all(a.image_size == b.image_size for a, b in zip(full, working, strict=True)):
        return registration
    cameras = tuple(camera.resized(own.image_size) for camera, own in zip(working, full, strict=True))
    pairs = tuple(_pair_at_full_size(pair, working, full) for pair in registration.pairs)
    return replace(registration, pairs=pairs, alignment=replace(registration.alignment, cameras=cameras))


def _pair_at_full_size(pair: PairRegistration, working: Sequence[Camera], full: Sequence[Camera]) -> PairRegistration:
    i, j = pair.image1, pair.image2
    found = pair.correspondences
    return replace(
        pair,
        correspondences=replace(
            found,
            points1=_moved(found.points1, working[i], full[i]),
            points2=_moved(found.points2, working[j], full[j]),
        ),
        relation=replace(
            pair.relation,
            camera=pair.relation.camera.resized(full[i].image_size),
            camera2=pair.relation.camera2.resized(full[j].image_size),
        ),
    )


def _moved(points: FloatArray, before: Camera, after: Camera) -> FloatArray:
    """Points (N, 2) of one size in pixels of another: the same in half diagonals from the centre of the picture."""
    return Camera(after.image_size).denormalize(Camera(before.image_size).normalize(points))
