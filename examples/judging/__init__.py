"""How far a stitched image or a registration is from the truth of :mod:`rdstitch.synthetic`, and from real ones."""

from examples.judging.alignment import AlignmentError, alignment_error, registration_error
from examples.judging.comparison import PlaneComparison, compare_with_plane
from examples.judging.fitting import fit_homography, fit_similarity
from examples.judging.sphere import SphereComparison, compare_with_sphere

__all__ = [
    "AlignmentError",
    "PlaneComparison",
    "SphereComparison",
    "alignment_error",
    "compare_with_plane",
    "compare_with_sphere",
    "fit_homography",
    "fit_similarity",
    "registration_error",
]
