"""Converting registered tiles to a :class:`Registration`, which later stages take."""

import math
from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np

from rdstitch.alignment import Alignment
from rdstitch.alignment.result import LinkFit, ReliefTest, Unused
from rdstitch.arrays import FloatArray
from rdstitch.errors import RegistrationError
from rdstitch.features import Correspondences
from rdstitch.geometry.camera import Camera
from rdstitch.geometry.radial_homography import RadialHomography
from rdstitch.inputs.source import Source
from rdstitch.matching.feature_store import StoredMatches
from rdstitch.matching.two_view import PairRegistration
from rdstitch.results.messages import MAX_NAMED, Message, names_of, shortened
from rdstitch.results.registration import Registration
from rdstitch.stage.register_tiles import TileRegistration


def tiles_as_registration(sources: Sequence[Source], tiled: TileRegistration) -> Registration:
    """Convert registered tiles to a registration."""
    fitted, links = tiled.adjustment, tiled.links
    if not tiled.linked.any():
        raise RegistrationError(
            f"none of {len(tiled.compared)} pairs of neighbours show the same where they should: the places "
            f"({tiled.grid.source}) or the overlap may be wrong; --search PX looks farther"
        )
    distortion, std = fitted.distortion, fitted.distortion_std
    cameras = [replace(source.camera, distortion=distortion, distortion_std=std or None) for source in sources]
    places = fitted.places - fitted.places[0]
    exact = _homographies(cameras, places)
    pairs, fits = zip(*(_pair(tiled, cameras, exact, number) for number in range(len(links.tiles))), strict=True)
    used_pairs = [fit for fit in fits if fit.used]
    rms = math.sqrt(float(np.mean([fit.rms**2 for fit in used_pairs if fit.inliers] or [math.nan])))
    alignment = Alignment(
        cameras=tuple(cameras),
        # Without a lens to take out every sample can stay as it was measured.
        homographies=_homographies(cameras, np.rint(places)) if fitted.distortion == 0.0 else exact,
        used=np.ones(len(sources), dtype=np.bool_),
        components=(tuple(range(len(sources))),),
        reference=0,
        model="rigid",
        model_reason="a stage moves without turning",
        rms=rms,
        links=fits,
        lens_reason="given" if std == 0.0 else "one parameter",
        relief=ReliefTest(False, 0.0, 0.0, "Taken to be flat: tiles on a stage."),
    )
    counts = np.bincount(links.tiles[links.pair].ravel(), minlength=len(sources))
    return Registration(
        tuple(sources), tuple(counts.tolist()), pairs, alignment, _messages(sources, tiled), tiles=tiled
    )


def _homographies(cameras: Sequence[Camera], places: FloatArray) -> FloatArray:
    """From each tile's normalized coordinates to those of the first (N, 3, 3); places (N, 2) are its pixels."""
    # Of tiles of several sizes each has its own frame.
    scales, centers = (np.array([getattr(camera, part) for camera in cameras]) for part in ("scale", "center"))
    matrices = np.tile(np.eye(3), (len(cameras), 1, 1))
    matrices[:, [0, 1], [0, 1]] = (scales / scales[0])[:, None]
    matrices[:, :2, 2] = (places + centers - centers[0]) / scales[0]
    return matrices


def _pair(
    tiled: TileRegistration, cameras: Sequence[Camera], homographies: FloatArray, number: int
) -> tuple[PairRegistration, LinkFit]:
    """A link between tiles, and how well it fits."""
    fitted, links = tiled.adjustment, tiled.links
    first, second = links.tiles[number].tolist()
    of_pair = np.flatnonzero(links.pair == number)
    agreeing = fitted.agreeing[of_pair]
    errors, used = np.linalg.norm(fitted.residuals[of_pair], axis=1), bool(fitted.holding[number])
    rms = math.sqrt(float((errors[agreeing] ** 2).mean())) if agreeing.any() else math.nan
    matrix = np.linalg.solve(homographies[second], homographies[first])
    relation = RadialHomography(
        matrix, cameras[first], cameras[second], agreeing, model="rigid", rms=rms, reason="correlation"
    )
    indices = np.tile(np.arange(len(of_pair), dtype=np.intp)[:, None], 2)
    blocks = links.blocks.take(of_pair)
    matches = Correspondences(indices, blocks.points1, blocks.points2, np.zeros(len(of_pair)))
    reason = Unused.NO if used else Unused.CONTRADICTS
    fit = LinkFit(first, second, len(errors), int(agreeing.sum()), rms if used else math.nan, reason)
    return PairRegistration(first, second, StoredMatches.of(matches), relation), fit


def _messages(sources: Sequence[Source], tiled: TileRegistration) -> tuple[Message, ...]:
    """Messages on the places."""
    fitted = tiled.adjustment

    def named(tiles: Iterable[int]) -> str:
        return shortened(names_of([str(sources[k].path) for k in tiles]))

    messages, alone = list[Message](), np.flatnonzero(~tiled.linked)
    if tiled.mostly_nominal:
        text = (
            f"{len(alone)} of {len(sources)} tiles have their places from the stage alone: they show nothing, or the "
            f"places ({tiled.grid.source}) or the overlap are wrong"
        )
        messages.append(Message(text, severity="failure", code="nominal-places"))
    elif len(alone):
        who = "1 tile has its place" if len(alone) == 1 else f"{len(alone)} tiles have their places"
        text = (
            f"{who} from the stage alone, ± {_rms(tiled.stds[alone]):.1f} pixels, since no neighbour shows the same: "
            f"{named(alone)}"
        )
        messages.append(Message(text, severity="note", code="nominal-places"))
    if len(tiled.groups) > 1:
        others = [k for group in tiled.groups[1:] for k in group]
        text = (
            f"tiles form {len(tiled.groups)} groups that only the stage holds together, ± "
            f"{_rms(tiled.stds[others]):.1f} pixels: {named(others)} have no link to the largest"
        )
        messages.append(Message(text, code="nominal-places"))
    if len(moved := np.flatnonzero(tiled.linked & (tiled.off_stage > max(tiled.plan.search, 5.0 * fitted.stage.std)))):
        off = ", ".join(f"{value:.0f}" for value in tiled.off_stage[moved][:MAX_NAMED])
        messages.append(Message(f"not where the stage was sent, {off} pixels off by what they show: {named(moved)}"))
    if fitted.distortion != 0.0:
        text = (
            f"the lens, λ = {fitted.distortion:.4f}, is corrected by resampling; --lambda 0 keeps the measured samples"
        )
        messages.append(Message(text, severity="note"))
    return tuple(messages)


def _rms(values: FloatArray) -> float:
    return math.sqrt(float((values**2).mean()))
