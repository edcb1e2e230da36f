"""Which of the places where the second tile of a pair may lie in the first it has, by what all pairs show."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from rdstitch.arrays import FloatArray, IntArray
from rdstitch.stage.adjustment import Adjustment, adjust
from rdstitch.stage.equations import LinkedPoints
from rdstitch.stage.evidence import ANYWHERE, HUNDRED_TO_ONE
from rdstitch.stage.pair_candidates import Candidates, SearchPlan
from rdstitch.stage.refinement import BlockMatches

_ROUNDS = 4  # by which what is certain of the stage decides about what was not


def choose_places(
    pairs: IntArray, candidates: Sequence[Candidates], plan: SearchPlan, lens: float
) -> dict[int, FloatArray]:
    """Choose where the second tile of each pair is in the first, where one place stands out.

    What is certain teaches what the stage does, which decides among the places of the other pairs.
    """
    chosen: dict[int, FloatArray] = {}
    fitted = adjust(plan.grid, LinkedPoints.of(pairs, {}), plan.stage_std, lens)
    for count in range(_ROUNDS):
        before = dict(chosen)
        doubted = {number for number, holds in zip(chosen, fitted.holding, strict=True) if not holds}
        for number, of_pair in enumerate(candidates):
            if not len(of_pair.nats) or (number in chosen and number not in doubted):
                continue
            chosen.pop(number, None)
            best, odds = _most_likely(of_pair, *fitted.between(pairs[number]), plan)
            # What is likely wherever the stage is goes first, and what is so only near where it should be second.
            if odds > HUNDRED_TO_ONE and (count > 0 or of_pair.nats[best] > HUNDRED_TO_ONE):
                chosen[number] = of_pair.offsets[best]
        chosen.update(_moved_tiles(pairs, candidates, fitted, chosen, plan.search))
        chosen = dict(sorted(chosen.items()))
        if count > 0 and {k: v.tolist() for k, v in chosen.items()} == {k: v.tolist() for k, v in before.items()}:
            break
        fitted = adjust(plan.grid, _coarse_links(pairs, chosen, plan), plan.stage_std, lens)
    return chosen


def _most_likely(
    candidates: Candidates, expected: FloatArray, covariance: FloatArray, plan: SearchPlan
) -> tuple[int, float]:
    """The candidate that is likely the most where the stage leads one to expect it, and the logarithm of its odds."""
    covariance = covariance + np.eye(2) * (plan.factor / 2.0) ** 2
    off = candidates.offsets - expected
    squared = np.einsum("ki,ij,kj->k", off, np.linalg.inv(covariance), off)
    log_prior = -0.5 * squared - 0.5 * math.log((2.0 * math.pi) ** 2 * float(np.linalg.det(covariance)))
    anywhere = -math.log(float(np.prod(plan.grid.size)))
    score = candidates.nats + np.logaddexp(log_prior, ANYWHERE + anywhere)
    best = int(score.argmax())
    # Nothing of what was found may be right, either.
    elsewhere = np.append(score[candidates.distinct_from(best)], anywhere)
    return best, float(score[best] - np.logaddexp.reduce(elsewhere))


class _Move(NamedTuple):
    """A candidate of a pair, as a move of one of its tiles away from where the stage was sent."""

    pair: int
    candidate: int  # its number among those of the pair
    nats: float


def _moved_tiles(
    pairs: IntArray, candidates: Sequence[Candidates], fitted: Adjustment, chosen: dict[int, FloatArray], search: float
) -> dict[int, FloatArray]:
    """Places of pairs of tiles that are somewhere else: no pair alone can say so, but all pairs of a tile together."""
    of_tile: dict[int, list[int]] = {}
    for number, pair in enumerate(pairs.tolist()):
        for tile in pair:
            of_tile.setdefault(tile, []).append(number)
    offsets: dict[int, FloatArray] = {}
    for tile, numbers in of_tile.items():
        if any(number in chosen or number in offsets for number in numbers):
            continue
        signs = [1.0 if pairs[number][1] == tile else -1.0 for number in numbers]
        moved = [s * (candidates[n].offsets - fitted.between(pairs[n])[0]) for s, n in zip(signs, numbers, strict=True)]
        moves = [_Move(n, k, nats) for n in numbers for k, nats in enumerate(candidates[n].nats.tolist())]
        place, agreeing = _largest_group(np.concatenate(moved), moves, search)
        if np.abs(place).max() <= search:
            continue
        margins = {move: move.nats - candidates[move.pair].best_elsewhere(move.candidate) for move in agreeing}
        supporting = {move: margin for move, margin in margins.items() if margin > 0.0}
        if len(supporting) > 1 and sum(supporting.values()) > HUNDRED_TO_ONE - ANYWHERE:
            offsets |= {move.pair: candidates[move.pair].offsets[move.candidate] for move in supporting}
    return offsets


def _largest_group(places: FloatArray, moves: Sequence[_Move], reach: float) -> tuple[FloatArray, list[_Move]]:
    """A move (2,) that pairs of a tile agree on the most, and the strongest candidate of each for it."""
    best, total, agreeing = np.zeros(2), -math.inf, list[_Move]()
    for place in places:
        strongest: dict[int, _Move] = {}
        for k in np.flatnonzero(np.abs(places - place).max(axis=1) <= reach).tolist():
            if moves[k].nats > strongest.get(moves[k].pair, (0, 0, -math.inf))[2]:
                strongest[moves[k].pair] = moves[k]
        if (together := sum(max(move.nats, 0.0) for move in strongest.values())) > total:
            best, total, agreeing = place, together, list(strongest.values())
    return best, agreeing


def _coarse_links(pairs: IntArray, chosen: dict[int, FloatArray], plan: SearchPlan) -> LinkedPoints:
    """Matches of whole overlaps, as exact as coarse tiles show them."""
    matches = {}
    for number, offset in chosen.items():
        middle = (np.array(plan.grid.size) - 1.0 + offset) / 2.0
        information = np.eye(2)[None] / (plan.factor / 2.0) ** 2
        matches[number] = BlockMatches(middle[None], (middle - offset)[None], information)
    return LinkedPoints.of(pairs, matches)
