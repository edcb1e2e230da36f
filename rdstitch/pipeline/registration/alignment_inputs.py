"""Options of the alignment and control points, from the user's options, headers and tables."""

import math
from collections.abc import Sequence

import numpy as np

from rdstitch.alignment import AlignmentOptions
from rdstitch.alignment.frames.quarter_turns import QuarterTurns
from rdstitch.alignment.least_squares.plane_marks import Sighting
from rdstitch.arrays import FloatArray
from rdstitch.errors import ArgumentError
from rdstitch.geometry.camera import Camera
from rdstitch.inputs.positions import metres_around_median, positions_of
from rdstitch.inputs.source import Source
from rdstitch.options.stitch_options import StitchOptions
from rdstitch.system.file_access import canonical_name


def alignment_options(sources: Sequence[Source], options: StitchOptions) -> AlignmentOptions:
    """The options of the alignment, for images as stored; inexact attitudes leave the tilt of the mount free."""
    stored = QuarterTurns.of(sources).back
    measured = [source.attitude for source in sources if source.attitude is not None]
    attitudes = [attitude.tilt for attitude in measured]
    delayed = [attitude.by_delay for attitude in measured if attitude.by_delay is not None]
    timed = delayed and len(delayed) == len(sources) and stored.none
    exact = bool(attitudes) and options.attitude_std == 0.0
    places = [source.metadata.gps for source in sources]
    return AlignmentOptions(
        reference=_reference(sources, options.reference),
        model=options.model,
        lens=options.lens,
        lens_known=options.known_distortion is not None,
        tilt=options.tilt or ((0.0, 0.0) if exact else None),
        attitudes=stored.tilts(np.array(attitudes)) if attitudes else None,
        delayed_attitudes=np.array(delayed) if timed else None,
        attitudes_std=options.attitude_std,
        gravity=_gravity(sources, stored),
        positions=positions_of(sources) if sources else None,
        positions_std=[math.nan if p is None or p.std is None else p.std[0] for p in places] or None,
        pose_covariance=options.pose_covariance,
    )


def sightings(sources: Sequence[Source], cameras: Sequence[Camera]) -> tuple[Sighting, ...]:
    """Ground control points in the images as the camera stored them, of the size that features are detected at."""
    sighted = [(k, point) for k, source in enumerate(sources) for point in source.control if not point.check]
    metres = metres_around_median([point.place for _, point in sighted])
    sightings, stored = [], QuarterTurns.of(sources).back
    for (k, point), (east, north) in zip(sighted, metres.tolist(), strict=True):
        x, y = stored.point(sources[k].camera.normalize(point.pixel) * cameras[k].scale, k).tolist()
        sightings.append(Sighting(k, (x, y), point.name, (east, north), point.std))
    return tuple(sightings)


def _gravity(sources: Sequence[Source], stored: QuarterTurns) -> FloatArray | None:
    """Direction down in the axes of each camera, (N, 3), by its attitude or its XMP; None where all lack both."""
    known = [source.down for source in sources]
    if all(down is None for down in known):
        return None
    directions = np.array([(np.nan,) * 3 if down is None else down for down in known])
    return stored.directions(directions)


def _reference(sources: Sequence[Source], name: str | None) -> int | None:
    if name is None:
        return None
    for index, source in enumerate(sources):
        if canonical_name(name) in (source.name, canonical_name(source.path)):
            return index
    raise ArgumentError(f"the reference image {name!r} is not among the input images")
