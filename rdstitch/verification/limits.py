"""The thresholds that results are judged by, with units and what set each: a measurement, or "unmeasured"."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Limit:
    """A threshold; as an attribute of a class its value."""

    value: float
    unit: str
    source: str

    def __get__(self, instance: object, owner: type) -> float:
        """The value."""
        return self.value


class Limits:
    """Limits on matches, pixels, patterns, second motions, layouts and inputs; fractions of what their names say."""

    # Matches.
    min_pair_inlier_fraction = Limit(0.5, "fraction", "by definition: less is another motion than that of the whole")
    min_image_inlier_fraction = Limit(0.6, "fraction", "right images have 0.83 and more even with relief, others 0.52")
    few_matches = Limit(40, "matches", "pairs that share nothing have been seen to have up to 33 of one motion")
    max_rms = Limit(1.0, "thresholds of inliers", "by definition of an inlier")
    # Where the images look alike.
    max_rough_rms = Limit(3.0, "thresholds of inliers", "small_failures, classical")
    # Errors that neighbours have in common.
    max_shared_error = Limit(1 / 3, "thresholds of inliers", "python -m examples.benchmarks.trust --kind cylinder")
    max_relief_rms = Limit(0.02, "image diagonals", "python -m examples.benchmarks.relief")
    max_length_std = Limit(0.05, "log focal length", "unmeasured: 5 cm in a metre are seen")
    # Cells of an overlap, in the images of COMPARED_SIDE, by python -m examples.benchmarks.alike: which of 1,000 cells
    # agree in overlaps that are right, and in the same put a tenth of a diagonal elsewhere.
    min_texture = Limit(0.012, "of full range, rms", "right 884, wrong 8; 854 and 8 with 0.003, 909 and 8 with 0.048")
    min_correlation = Limit(0.5, "correlation", "right 884, wrong 8; 888 and 29 with 0, 857 and 3 with 0.7")
    max_offset = Limit(2.5, "pixels", "right 884, wrong 8; 712 and 1 with 1, 932 and 22 with 4")
    min_cells = Limit(8, "cells", "of 8, none agrees in 9 % of right overlaps with min_alike_fraction: 0.74 to the 8th")
    # Of the cells of one overlap, then of all overlaps.
    max_unlike_fraction = Limit(0.10, "fraction", "chance reaches 0.07; low sun, parallax, blur 0.20")
    alike_by_chance = Limit(0.07, "fraction", "21 of the 17 x 17 places that are searched lie within max_offset")
    max_chance = Limit(0.01, "probability that as many cells are alike by chance", "by definition")
    min_alike_fraction = Limit(0.25, "fraction", "0.26 to 1 in 22 sets that a person would keep: benchmarks.world")
    min_clearly_alike_fraction = Limit(0.5, "fraction", "python -m examples.benchmarks.relief")
    max_wrong_overlaps = Limit(0.1, "fraction", "25 taken at random, all right, show as much: Wilson's bound")
    # Repeated patterns.
    ambiguous_correlation_ratio = Limit(0.9, "ratio to here", "patterns reach 0.97, other images seldom 0.5")
    ambiguous_residual_ratio = Limit(2.0, "ratio of power to here", "1.5 on tiles, 3 and more on rows of plants")
    min_kept_overlap = Limit(0.5, "fraction", "unmeasured")
    max_ambiguous_pairs = Limit(0.4, "fraction", "unmeasured: of more, leaving some out proves nothing")
    min_period_correlation = Limit(0.4, "correlation", "unmeasured")
    min_periods = Limit(4, "periods", "unmeasured: a median of their copies must stand one that is dirty")
    min_departure = Limit(5.0, "spreads of the copies", "unmeasured")
    min_departure_correlation = Limit(0.8, "correlation", "right ones have 0.87 to 0.99")
    min_matched_departures = Limit(400.0, "squared spreads times pixels", "a stain of 16 pixels, 5 spreads over noise")
    min_lead = Limit(3.0, "ratio to any other shift", "unmeasured")
    # Second motions.
    min_motion_inliers = Limit(12, "matches", "four define it; eight more by chance have not been seen")
    min_plane_fraction = Limit(0.5, "fraction", "by definition: what fills less of the images is in front of it")
    # Layouts.
    max_magnification = Limit(4.0, "ratio to the median place", "a plane seen 60 degrees off its normal")
    max_aspect = Limit(2.0, "ratio of both directions", "a plane seen 60 degrees off its normal")
    visible_cut = Limit(0.02, "fraction of the images", "unmeasured: of more that is cut away a note says so")
    max_straightening_cut = Limit(0.1, "fraction of the images", "unmeasured")
    # Inputs.
    max_focal_ratio = Limit(1.03, "ratio", "EXIF rounds focal lengths to about one per cent")
