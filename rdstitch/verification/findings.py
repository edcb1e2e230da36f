"""What the rules find: data that repairs are made from, and the one place where they become sentences."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from rdstitch.results.messages import MAX_NAMED, Message, Severity, names_of, shortened
from rdstitch.results.registration import Registration


@dataclass(frozen=True)
class Finding:
    """One thing that a rule found."""

    kind: str  # a key of :data:`TEXTS`
    images: tuple[int, ...] = ()  # indices of the images that it concerns; empty where it concerns the whole
    # as of :class:`rdstitch.results.messages.Message`. A failure of one image or of a pair may be mended without
    # these; one of
    # the whole, or of more images, may not
    severity: Severity = "failure"
    values: Mapping[str, object] = field(default_factory=dict)  # what was measured: sizes, shares and counts, by name

    @property
    def fails(self) -> bool:
        """Whether the result cannot be relied on."""
        return self.severity == "failure"


TEXTS = {
    "lenses mixed": (
        "",
        "two lenses or zooms are mixed: {images2} (λ about {lens2:.3f}) and {images1} ({lens1:.3f}); stitch those of "
        "each on their own",
    ),
    "matches disagree": ("", "only {inliers} of {count} matches fit the places that were found for the images"),
    "image misfits": ("", "only {inliers} of {count} of its matches fit the place that was found for it; {reason}"),
    "pair misfits": ("", "{both}: only {inliers} of {count} matches fit the places that were found for them; {reason}"),
    "errors": ("", "the images disagree by {rms:.1f} pixels, more than the threshold of {threshold:g} pixels"),
    "rough": (
        "relief",
        "the images disagree by {rms:.1f} pixels, more than the threshold of {threshold:g} pixels: the ground is rough",
    ),
    "relief": ("relief", "{what}; most of all between {first} and {second} ({rms:.1f} pixels)"),
    "depth of a turn": ("parallax", "{what}; most of all between {first} and {second} ({rms:.1f} pixels)"),
    "parallax": (
        "parallax",
        "the camera moved while it turned (parallax), or things moved before it: they are off by up to {size:.0f} "
        "pixels between {first} and {second} ({share:.0%} of their matches); turn about the lens, not about yourself",
    ),
    "shape unknown": (
        "shape",
        "global accuracy unknown: the images do not come from one camera with one focal length, or what they show is "
        "not flat; each has a homography of its own, and their errors add up from image to image",
    ),
    "shape bent": (
        "shape",
        "may be bent by about {size:.0f} pixels from end to end, though neighbours fit: the errors have a pattern that "
        "was not modelled, most likely {cause}",
    ),
    "shape free": (
        "shape",
        "may be bent by about {size:.0f} pixels from end to end, though neighbours fit: the images cannot exclude "
        "{cause}; give {remedy}",
    ),
    "unlike": (
        "",
        "{both} do not look alike where they are put together ({confirming} of {cells} places agree)",
    ),
    "ambiguous": (
        "",
        "{both} fit as well elsewhere, {shift:.0%} of an image away (a repeated pattern?); take images that share "
        "something unique",
    ),
    "pattern": ("", "{count} of {of} pairs fit as well elsewhere (a repeated pattern?)"),
    "looked at": (
        "",
        "of {of} overlaps {count} were compared in their pixels, {sampled} of them at random: at most {share:.1%} of "
        "all are wrong, with a confidence of 95%",
    ),
    "settled pattern": (
        "repeated-pattern",
        "the images show a repeated pattern; what is unique in them (dirt, a mark, an object) decided where they lie; "
        "look at the seams, that between {first} and {second} first",
    ),
    "second motion": (
        "rival-motion",
        "{moving} (something that moved, or a second surface?); a mask keeps it out",
    ),
    "undecided motion": (
        "rival-motion",
        "{moving}, and it is not clear which of the two is the plane; mask what does not belong to it",
    ),
    "two of one lens": (
        "mixed-lenses",
        "{both} fit without the images of another lens, as any two do; if all are of one lens, the scene is not flat, "
        "and these two lie wrongly; add images of this lens",
    ),
    "several cameras": (
        "mixed-lenses",
        "the images come from {number} cameras: {bodies}; stitch those of each on their own",
    ),
    "zoomed": (
        "mixed-lenses",
        "the lens was zoomed between the images, by up to {ratio:.2f} (between {near} and {far}); stitch those of one "
        "zoom on their own",
    ),
    "unmasked": ("", "{without_count} of {of_all} images have no mask: {without}"),
}
"""Code (a heading in docs/troubleshooting.md) and sentence of each kind, with fields for its values."""

_MOVING = (
    "{share:.0%} of what the images have in common moves differently from the rest, most of it around ({place[0]:.0f}, "
    "{place[1]:.0f}) of {shown[0]} when compared with {shown[1]}, by {off:.0f} pixels"
)
_OUTVOTED = {"outvoted": "badly", "ambiguous": "as well elsewhere (a repeated pattern?)"}


def messages_of(findings: Iterable[Finding], registration: Registration) -> list[Message]:
    """One message for each finding."""
    paths = [str(source.path) for source in registration.sources]
    return [_message(finding, paths) for finding in findings]


def _message(finding: Finding, paths: Sequence[str]) -> Message:
    images, values = tuple(paths[k] for k in finding.images), dict[str, Any](finding.values)
    names = names_of(images)
    if "pairs" in values:
        return Message(_outvoted(finding.kind, values["pairs"], paths), images, finding.severity, code="doubtful-seam")
    if len(names) == 2:
        values |= {"first": names[0], "second": names[1], "both": " and ".join(names)}
    for key in ("images1", "images2", "without"):
        if key in values:
            values[f"{key}_count"] = len(values[key])
            values[key] = shortened(names_of(paths[k] for k in values[key]))
    values |= {key: names_of([paths[values[key]]])[0] for key in ("near", "far") if key in values}
    if "bodies" in values:
        bodies = sorted(values["bodies"].items(), key=lambda body: -len(body[1]))
        listed = (f"{body} ({len(shown)}: {shortened(names_of(paths[k] for k in shown))})" for body, shown in bodies)
        values |= {"number": len(bodies), "bodies": "; ".join([*listed][:MAX_NAMED])}
    if "shown" in values:
        values["moving"] = _MOVING.format(**{**values, "shown": names_of(paths[k] for k in values["shown"])})
    code, text = TEXTS[finding.kind]
    return Message(text.format(of_all=len(paths), **values), images, finding.severity, code, finding.kind)


def _outvoted(kind: str, pairs: Sequence[tuple[int, int]], paths: Sequence[str]) -> str:
    """Suspicious pairs on which nothing depends."""
    named = shortened([" and ".join(names_of([paths[i], paths[j]])) for i, j in pairs])
    fit, it = ("one pair fits", "it") if len(pairs) == 1 else (f"{len(pairs)} pairs fit", "them")
    return f"{fit} {_OUTVOTED[kind]}, and little depends on {it}: {named}; look at the seams between them"
