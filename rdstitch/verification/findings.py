"""What the rules find: data that repairs are made from, and the one place where they become sentences."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from enum import Enum
from typing import Any

from rdstitch.results.messages import MAX_NAMED, Message, Severity, names_of, shortened
from rdstitch.results.registration import Registration


class Scope(Enum):
    """What is to blame: an image or a pair may be left out, the whole may not."""

    WHOLE = 0
    IMAGE = 1
    PAIR = 2


class Kind(Enum):
    """What there is to find: what is to blame, a heading in docs/troubleshooting.md, and the sentence."""

    # fmt: off
    LENSES_MIXED = Scope.WHOLE, "", (
        "two lenses or zooms are mixed: {images2} (λ about {lens2:.3f}) and {images1} ({lens1:.3f}); stitch those of "
        "each on their own"
    )
    MATCHES_DISAGREE = Scope.WHOLE, "", (
        "only {inliers} of {count} matches fit the places that were found for the images"
    )
    IMAGE_MISFITS = Scope.IMAGE, "", (
        "only {inliers} of {count} of its matches fit the place that was found for it; {reason}"
    )
    PAIR_MISFITS = Scope.PAIR, "", (
        "{both}: only {inliers} of {count} matches fit the places that were found for them; {reason}"
    )
    ERRORS = Scope.WHOLE, "", "the images disagree by {rms:.1f} pixels, more than the threshold of {threshold:g} pixels"
    ROUGH = Scope.WHOLE, "relief", (
        "the images disagree by {rms:.1f} pixels, more than the threshold of {threshold:g} pixels, most of all "
        "{both}: the ground is rough"
    )
    RELIEF = Scope.WHOLE, "relief", "{what}; most of all between {first} and {second} ({rms:.1f} pixels)"
    DEPTH_OF_A_TURN = Scope.WHOLE, "parallax", "{what}; most of all between {first} and {second} ({rms:.1f} pixels)"
    FREE_HOMOGRAPHIES = Scope.WHOLE, "shape", (
        "global accuracy unknown: the images do not come from one camera with one focal length, or what they show is "
        "not flat; each has a homography of its own, and their errors add up from image to image, most of all between "
        "{first} and {second}"
    )
    UNLIKE = Scope.PAIR, "", (
        "{both} do not look alike where they are put together ({confirming} of {cells} places agree)"
    )
    AMBIGUOUS = Scope.PAIR, "", (
        "{both} fit as well elsewhere, {shift:.0%} of an image away (a repeated pattern?); take images that share "
        "something unique"
    )
    PATTERN = Scope.WHOLE, "", "{count} of {of} pairs fit as well elsewhere (a repeated pattern?)"
    OVERLAPS_SAMPLED = Scope.WHOLE, "", (
        "of {of} overlaps {count} were compared in their pixels, {sampled} of them at random: at most {share:.1%} of "
        "all are wrong, with a confidence of 95%"
    )
    SETTLED_PATTERN = Scope.WHOLE, "repeated-pattern", (
        "the images show a repeated pattern; what is unique in them (dirt, a mark, an object) decided where they lie; "
        "look at the seams, that between {first} and {second} first"
    )
    RIVAL_MOTION = Scope.WHOLE, "rival-motion", (
        "what was put together fills at most {share:.0%} of the images, and the rest looks different (something that "
        "moved, or a second surface?); mask what does not belong to the plane"
    )
    TWO_OF_ONE_LENS = Scope.WHOLE, "mixed-lenses", (
        "{both} fit without the images of another lens, as any two do; if all are of one lens, the scene is not flat, "
        "and these two lie wrongly; add images of this lens"
    )
    SEVERAL_CAMERAS = Scope.WHOLE, "mixed-lenses", (
        "the images come from {number} cameras: {bodies}; stitch those of each on their own"
    )
    ZOOMED = Scope.WHOLE, "mixed-lenses", (
        "the lens was zoomed between the images, by up to {ratio:.2f} (between {near} and {far}); stitch those of one "
        "zoom on their own"
    )
    UNMASKED = Scope.WHOLE, "", "{without_count} of {of_all} images have no mask: {without}"
    OUTVOTED = Scope.WHOLE, "doubtful-seam", (
        "{they_fit} badly, and little depends on {them}: {named}; look at the seams between them"
    )
    OUTVOTED_PATTERN = Scope.WHOLE, "doubtful-seam", (
        "{they_fit} as well elsewhere (a repeated pattern?), and little depends on {them}: {named}; look at the seams "
        "between them"
    )
    # fmt: on

    def __init__(self, scope: Scope, code: str, text: str) -> None:
        self.scope, self.code, self.text = scope, code, text


@dataclass(frozen=True)
class Finding:
    """One thing that a rule found."""

    kind: Kind
    images: tuple[int, ...] = ()  # indices of the images that it concerns; empty where it concerns the whole
    severity: Severity = "failure"  # as of :class:`rdstitch.results.messages.Message`
    # what the rule measured, of which the kind's sentence names some: images by their indices
    values: Mapping[str, Any] = field(default_factory=dict)

    @property
    def fails(self) -> bool:
        """Whether the result cannot be relied on."""
        return self.severity == "failure"


def messages_of(findings: Iterable[Finding], registration: Registration) -> list[Message]:
    """One message for each finding."""
    paths = [str(source.path) for source in registration.sources]
    return [_message(finding, paths) for finding in findings]


def _message(finding: Finding, paths: Sequence[str]) -> Message:
    images, values = tuple(paths[k] for k in finding.images), dict(finding.values)
    names = names_of(images)
    if "pairs" in values:
        pairs = values.pop("pairs")
        values["named"] = shortened([" and ".join(names_of([paths[i], paths[j]])) for i, j in pairs])
        several = len(pairs) > 1
        values |= {"they_fit": f"{len(pairs)} pairs fit" if several else "one pair fits"}
        values |= {"them": "them" if several else "it"}
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
    kind = finding.kind
    return Message(kind.text.format(of_all=len(paths), **values), images, finding.severity, kind.code, kind.name)
