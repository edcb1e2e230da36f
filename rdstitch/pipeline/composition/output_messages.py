"""Messages on an output: georeference, cut-away parts, broken seams, colour profiles."""

from collections.abc import Sequence
from pathlib import Path

from rdstitch.compositing import Canvas, CompositeOptions, SeamBreak, SeamQuality
from rdstitch.compositing.projection import PLANE
from rdstitch.georeferencing.georeference import check_summary, map_summary
from rdstitch.georeferencing.place_on_map import MapPlacement
from rdstitch.inputs.source import Source
from rdstitch.io.colour import colour_space
from rdstitch.io.deepzoom import MAX_TILE_PROFILE
from rdstitch.results.messages import MAX_NAMED, Message, names_of, shortened
from rdstitch.results.placed_images import PlacedImages
from rdstitch.verification.limits import Limits


def masked_messages(placed: PlacedImages) -> list[Message]:
    """How much of every image was masked as static."""
    if placed.static is None:
        return []
    fraction = float(placed.static.mean())
    text = f"{fraction:.0%} of every image is black, or stays where it is, in all of them, and was masked"
    return [Message(text, severity="detail")]


def cut_away_messages(placed: PlacedImages, canvas: Canvas, options: CompositeOptions) -> list[Message]:
    """How much of the images is cut away because it would be stretched too far."""
    if placed.grid is not None or options.like is not None or options.extent is not None:
        return []
    fraction = canvas.cut_away(placed.cameras, placed.homographies)
    text = (
        f"{fraction:.0%} of what the images show is cut away: it would be stretched over {options.max_stretch:g} times"
    )
    if placed.turned and canvas.projection == PLANE:
        text += "; --projection cylinder or sphere shows more"
    return [Message(text, severity="note")] if fraction > Limits.visible_cut else []


def place_messages(placement: MapPlacement, placed: PlacedImages) -> list[Message]:
    """Messages on the georeference; none if hardly an image has a position."""
    lost = [source for source in placed.sources if source.metadata.gps_problem]
    messages = [
        Message(f"{each.metadata.gps_problem}, and was not used; give --positions", (str(each.path),)) for each in lost
    ]
    if (place := placement.place) is None:
        known = placement.reason and placed.has_place
        return [*messages, Message(f"not georeferenced: {placement.reason}")] if known else messages
    messages += map(Message, placement.cautions)
    messages.append(Message(map_summary(place), severity="note"))
    if place.assumption:
        messages.append(Message(place.assumption))
    if place.checks:
        messages.append(Message(check_summary(place), severity="note"))
    if place.rejected:
        names = [residual.name for residual in place.rejected]
        more = f" and {len(names) - MAX_NAMED} more" if len(names) > MAX_NAMED else ""
        off = max(residual.distance for residual in place.rejected)
        contradicted = f"the images contradict, by up to {off:.3g} m," if off else "have no place in the output"
        text = f"{place.source} that {contradicted} were not used: "
        messages.append(Message(f"{text}{', '.join(names[:MAX_NAMED])}{more}"))
    return messages


def seam_messages(seams: SeamQuality, paths: Sequence[str]) -> list[Message]:
    """A warning on broken seams, a detail if they are not visible; or a warning that most overlaps are dissimilar."""
    hold = len(seams.places) and seams.seams_fit
    if seams.mostly_unlike and not hold and seams.least_alike is not None:
        images = tuple(paths[k] for k in seams.least_alike)
        text = (
            f"only {seams.alike:.0%} of what the images share looks alike, the least between "
            f"{' and '.join(names_of(images))}: something that fills a part of them (a vehicle, a mount) may have been "
            "registered instead of the scene; mask it"
        )
        return [Message(text, images, code="rival-motion")]
    if not seams.breaks:
        return []
    longest: dict[tuple[int, int], SeamBreak] = {}
    for one in seams.breaks:
        longest.setdefault(one.images, one)
    worst = list(longest.values())[:MAX_NAMED]
    breaks = []
    for one in worst:
        (x, y), (first, second) = one.position, names_of(paths[k] for k in one.images)
        breaks.append(f"a break of {one.length:.0f} pixels at ({x:.0f}, {y:.0f}), between {first} and {second}")
    more = f", and {rest} more" if (rest := len(seams.breaks) - len(worst)) else ""
    text = (
        f"{'; '.join(breaks)}{more}: something moved, or is nearer than the rest; leave one of the two out, or mask it"
    )
    images = tuple(dict.fromkeys(paths[k] for one in worst for k in one.images))
    return [Message(text, images, "warning" if seams.broken_in_output else "detail", code="seam-break")]


def lost_profile_messages(source: Source, output: Path) -> list[Message]:
    """Why the output lacks the colour profile of the image whose metadata it has."""
    lost, size = source.metadata.profile_lost, len(source.metadata.icc_profile)
    if output.suffix.lower() == ".dzi" and size > MAX_TILE_PROFILE:
        lost = f"its colour profile of {size / 1e3:.0f} kB is too large to be in every tile"
    elif output.suffix.lower() == ".webp" and size > len(source.metadata.with_samples(3).icc_profile):
        lost = "its colour profile is one of grey samples, and WebP has colours"
    return [Message(f"{lost}; colours are as if it had none", (str(source.path),))] if lost else []


def differing_profile_messages(placed: PlacedImages) -> list[Message]:
    """Which images have other colours than those of the output."""
    first = placed.profile_source
    spaces = [(str(source.path), colour_space(source.metadata.icc_profile)) for source in placed.sources]
    others = [path for path, space in spaces if space != colour_space(first.metadata.icc_profile)]
    if not others:
        return []
    what = f"another colour profile than {first.name}, whose the output has"
    who = "has" if len(others) == 1 else f"{len(others)} of the images ({shortened(names_of(others))}) have"
    text = f"{who} {what}: their colours are off; convert them to one colour space first"
    return [Message(text, tuple(others), code="colour-profiles")]
