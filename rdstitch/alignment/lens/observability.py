"""Whether the images show λ at all, or depth that looks like it; and then, which lens it is."""

from collections.abc import Sequence

import numpy as np

from rdstitch.alignment.adjustment_problem import LinkProblem
from rdstitch.alignment.alignment_options import GivenImages
from rdstitch.alignment.least_squares.bundle_adjustment import BundleAdjustmentResult
from rdstitch.alignment.least_squares.observations import Observations
from rdstitch.alignment.least_squares.priors import CameraPriors
from rdstitch.alignment.lens.lens_selection import LensChoice, LensEvidence, choose_lens, residual_coherence
from rdstitch.alignment.noise import COHERENT_CORRELATION, shows_relief
from rdstitch.alignment.pairwise import pairwise_homographies, relations_at
from rdstitch.arrays import BoolArray, FloatArray
from rdstitch.geometry.division_model import OBSERVABLE_STD
from rdstitch.geometry.radial_homography import RadialHomography
from rdstitch.matching.distortion_consensus import vote
from rdstitch.robust.priors import LENS_PRIORS

_FEW_VIEWS = 3  # images up to which depth may look like a lens

_LENS_OVER_DEPTH = 6.0
"""Factor by which a lens must reduce what neighbours share to be no depth itself: λ takes the blame for up to 3 times
what is left of depth, in 14 pairs and triples of published sets, and for 12 to 18 times of what fisheyes of matches
leave beside λ."""


def choose_observable_lens(
    task: GivenImages, sample: Observations, relations: Sequence[RadialHomography], priors: CameraPriors
) -> LensChoice:
    """Whether links with a homography of their own show λ, or what could be depth; and which lens they show."""

    def links_at(lens: FloatArray, free: BoolArray) -> LinkProblem:
        return LinkProblem(sample, relations_at(sample, relations, lens), lens, free, priors)

    options, first, none = task.options, np.arange(len(LENS_PRIORS)) == 0, np.zeros(len(LENS_PRIORS), dtype=np.bool_)
    # The images' points are already relative to the centre of the camera.
    given = np.array([*task.cameras[0].coefficients, 0.0, 0.0])
    if options.lens_known:
        links = links_at(given, none)
        return LensChoice.held(pairwise_homographies(links), "given")
    votes = vote([k.relation.distortion for k in task.links], [k.relation.distortion_std for k in task.links])
    links = links_at(np.where(first, np.nan_to_num(votes.distortion), 0.0), first)
    pairwise = pairwise_homographies(links)
    # One homography a pair leaves λ well determined, without what the prior says.
    information = 1.0 / float(pairwise.covariance[0, 0]) - LENS_PRIORS[0].curvature(float(pairwise.parameters.lens[0]))
    moving = information > OBSERVABLE_STD**-2.0
    if sample.image_count <= _FEW_VIEWS or not moving:
        with_given_lens = pairwise_homographies(links_at(given, none))
        if not moving or _is_depth(pairwise, with_given_lens):
            missing = LensEvidence.DEPTH if moving else LensEvidence.LITTLE_MOTION
            return LensChoice.held(with_given_lens, "λ is not observable", missing)
    return choose_lens(links, pairwise, options.lenses)


def _is_depth(free_lens: BundleAdjustmentResult, given_lens: BundleAdjustmentResult) -> bool:
    """Whether the depth of what a few images show may look like their lens: with λ free, and held.

    Depth changes most from one end of a view to the other, as the effect of a lens does: where it shows in the errors
    that are left, λ takes the blame for more of it than that.
    """
    without, with_lens = residual_coherence(given_lens), residual_coherence(free_lens)
    smaller = with_lens.correlation > COHERENT_CORRELATION and without.size < _LENS_OVER_DEPTH * with_lens.size
    return shows_relief(without) and smaller
