"""The thresholds that results are judged by, with units, and what set them: "chosen" where nothing was measured."""

from typing import NamedTuple


class Limit(NamedTuple):
    """A threshold."""

    value: float
    unit: str
    source: str


class Limits:
    """Of matches, pixels, second motions and inputs."""

    # Matches.
    pair_inliers = Limit(0.5, "share of its matches", "less is another motion than that of the whole")
    image_inliers = Limit(
        0.6, "share of its matches", "right images have been seen to have 0.83 even with relief, others 0.52"
    )
    few_matches = Limit(40, "matches", "pairs that share nothing have been seen to have up to 33 of one motion")
    error = Limit(1.0, "thresholds, rms of the whole", "the definition of an inlier")
    rough_error = Limit(3.0, "thresholds, where images look alike", "small_failures, classical")
    bent = Limit(
        1 / 3,
        "thresholds that neighbours' errors have in common",
        "chosen on rendered planes: python -m examples.benchmarks.trust --kind cylinder",
    )
    relief_error = Limit(0.02, "of an image's diagonal", "python -m examples.benchmarks.relief")
    length_std = Limit(0.05, "standard deviation of the focal length's logarithm", "chosen: 5 cm in a metre are seen")
    # Cells of an overlap.
    texture = Limit(0.012, "standard deviation in a cell, of full range", "chosen")
    correlation = Limit(0.5, "of two places that look alike", "chosen")
    offset = Limit(2.5, "pixels of the compared images", "chosen")
    cells = Limit(8, "cells of an overlap", "of fewer the pixels say nothing")
    unlike = Limit(0.10, "share of the cells of an overlap", "chance reaches 0.07; low sun, parallax, blur 0.20")
    alike = Limit(0.25, "share of the overlaps", "0.26 to 1 in 22 sets that a person would keep: benchmarks.world")
    clearly_alike = Limit(0.5, "share of the overlaps", "python -m examples.benchmarks.relief")
    wrong_overlaps = Limit(0.1, "share of overlaps", "25 taken at random, all right, show as much: Wilson's bound")
    # Repeated patterns.
    as_well_elsewhere = Limit(0.9, "of the correlation here", "repeated patterns reach 0.97, other images seldom 0.5")
    unexplained_elsewhere = Limit(
        2.0, "times the power that is left here", "1.5 on tiles, 3 and more on rows of plants, which only resemble"
    )
    kept_overlap = Limit(0.5, "of the overlap, that a shift keeps", "chosen")
    pattern = Limit(0.4, "share of the checked pairs", "more is a pattern all over: leaving some out proves nothing")
    period = Limit(0.4, "correlation at a shift that is a period", "chosen")
    periods = Limit(4, "periods that an image shows", "chosen: a median of their copies must stand one that is dirty")
    departure = Limit(5.0, "spreads of the copies of a place", "chosen")
    same_departures = Limit(0.8, "correlation of departures", "right ones have 0.87 to 0.99")
    matched_departures = Limit(400.0, "squared spreads times pixels", "a stain of 16 pixels, 5 spreads beyond noise")
    lead = Limit(3.0, "times what any other shift matches", "chosen")
    # Second motions.
    motion_inliers = Limit(12, "matches", "four define it; eight more by chance have not been seen")
    filled_by_plane = Limit(0.5, "share of the images", "what fills less is in front of it")
    # Inputs.
    zoom = Limit(1.03, "ratio of focal lengths in EXIF", "they are rounded to about one per cent")
