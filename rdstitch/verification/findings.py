"""What the rules find: data that repairs are made from, and the one place where they become sentences."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from enum import Enum
from string import Formatter
from typing import NamedTuple

from rdstitch.alignment.result import ReliefTest
from rdstitch.alignment.sentences import few_features
from rdstitch.results.messages import MAX_NAMED, Message, Severity, names_of, shortened
from rdstitch.results.registration import Registration


class Scope(Enum):
    """What is to blame: an image or a pair may be left out, the whole may not."""

    WHOLE = 0
    IMAGE = 1
    PAIR = 2


class Misfit(Enum):
    """Why matches agree with each other only."""

    FEW_FEATURES = ""  # of some images, which the sentence names
    FEW_MATCHES = "too few to place it: little overlap, or none?"
    OTHER_MOTION = "they fit each other: does it show another surface, or come from another camera or zoom?"


class Images(tuple[int, ...]):
    """Indices of images, which a sentence names."""


class Pairs(tuple[tuple[int, ...], ...]):
    """Pairs of images, which a sentence names."""


class Bodies(dict[str, Images]):
    """Images by make, model and serial number of the camera."""


Value = int | float | Misfit | ReliefTest | Images | Pairs | Bodies


class Kind(Enum):
    """What there is to find: what is to blame, a heading in docs/troubleshooting.md, and the sentence.

    ``measured``: names of the values that a finding of this kind has; ``first``, ``second``, ``both`` are its images.
    """

    # fmt: off
    LENSES_MIXED = Scope.WHOLE, "", (
        "two lenses or zooms are mixed: {images2} (λ about {lens2:.3f}) and {images1} ({lens1:.3f}); stitch those of "
        "each on their own"
    )
    MATCHES_DISAGREE = Scope.WHOLE, "", (
        "only {inliers} of {count} matches fit the places that were found for the images"
    )
    IMAGE_MISFITS = Scope.IMAGE, "", (
        "only {inliers} of {count} of its matches fit the place that was found for it; {misfit}"
    )
    PAIR_MISFITS = Scope.PAIR, "", (
        "{both}: only {inliers} of {count} matches fit the places that were found for them; {misfit}"
    )
    ERRORS = Scope.WHOLE, "", "the images disagree by {rms:.1f} pixels, more than the threshold of {threshold:g} pixels"
    ROUGH = Scope.WHOLE, "relief", (
        "the images disagree by {rms:.1f} pixels, more than the threshold of {threshold:g} pixels, most of all "
        "{both}: the ground is rough"
    )
    RELIEF = Scope.WHOLE, "relief", "{relief.explanation}; most of all between {first} and {second} ({rms:.1f} pixels)"
    DEPTH_OF_A_TURN = Scope.WHOLE, "parallax", (
        "{relief.explanation}; most of all between {first} and {second} ({rms:.1f} pixels)"
    )
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
        "of {of} overlaps {count} were compared in their pixels, {sampled} of them at random: at most {fraction:.1%} "
        "of all are wrong, with a confidence of 95%"
    )
    SETTLED_PATTERN = Scope.WHOLE, "repeated-pattern", (
        "the images show a repeated pattern; what is unique in them (dirt, a mark, an object) decided where they lie; "
        "look at the seams, that between {first} and {second} first"
    )
    RIVAL_MOTION = Scope.WHOLE, "rival-motion", (
        "what was put together fills at most {fraction:.0%} of the images, and the rest looks different (something "
        "that moved, or a second surface?); mask what does not belong to the plane"
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
    UNMASKED = Scope.WHOLE, "", "{count} of {of} images have no mask: {without}"
    OUTVOTED = Scope.WHOLE, "doubtful-seam", (
        "{pairs.fit} badly, and little depends on {pairs.them}: {pairs.names}; look at the seams between them"
    )
    OUTVOTED_PATTERN = Scope.WHOLE, "doubtful-seam", (
        "{pairs.fit} as well elsewhere (a repeated pattern?), and little depends on {pairs.them}: {pairs.names}; look "
        "at the seams between them"
    )
    # fmt: on

    def __init__(self, scope: Scope, code: str, text: str) -> None:
        self.scope, self.code, self.text = scope, code, text
        words = {name.partition(".")[0] for _, name, _, _ in Formatter().parse(text) if name}
        self.measured = words - {"first", "second", "both"}


@dataclass(frozen=True)
class Finding:
    """One thing that a rule found."""

    kind: Kind
    severity: Severity  # as of :class:`rdstitch.results.messages.Message`
    images: tuple[int, ...] = ()  # indices of the images that it concerns; empty where it concerns the whole
    values: Mapping[str, Value] = field(default_factory=dict)  # what the rule measured, as the kind's sentence names it

    def __post_init__(self) -> None:
        assert self.values.keys() == self.kind.measured, f"{self.kind}: {self.values.keys()}, not {self.kind.measured}"

    @property
    def fails(self) -> bool:
        """Whether the result cannot be relied on."""
        return self.severity == "failure"


def messages_of(findings: Iterable[Finding], registration: Registration) -> list[Message]:
    """One message for each finding."""
    return [_message(finding, registration) for finding in findings]


def _message(finding: Finding, given: Registration) -> Message:
    kind, names = finding.kind, _names(given, finding.images)
    words = {name: _in_words(value, finding, given) for name, value in finding.values.items()}
    if len(names) == 2:
        words |= {"first": names[0], "second": names[1], "both": " and ".join(names)}
    images = tuple(str(given.sources[k].path) for k in finding.images)
    return Message(kind.text.format(**words), images, finding.severity, kind.code, kind.name)


class _PairWords(NamedTuple):
    fit: str
    them: str
    names: str


def _in_words(value: Value, finding: Finding, given: Registration) -> object:
    """A value as a sentence has it: what is neither images nor a reason is formatted by the sentence itself."""
    match value:
        case Misfit.FEW_FEATURES:
            few = ((given.sources[k].name, few_features(given.keypoints, k)) for k in finding.images)
            return ", ".join(f"{name} has {why}" for name, why in few if why)
        case Misfit():
            return f"{value.value}{' stitch them on their own' * (finding.kind is Kind.PAIR_MISFITS)}"
        case Images():
            return shortened(_names(given, value))
        case Pairs():
            fit, them = (f"{len(value)} pairs fit", "them") if len(value) > 1 else ("one pair fits", "it")
            return _PairWords(fit, them, shortened([" and ".join(_names(given, pair)) for pair in value]))
        case Bodies():
            commonest = sorted(value.items(), key=lambda body: -len(body[1]))[:MAX_NAMED]
            return "; ".join(f"{body} ({len(shown)}: {shortened(_names(given, shown))})" for body, shown in commonest)
        case _:
            return value


def _names(given: Registration, images: Iterable[int]) -> list[str]:
    return names_of(str(given.sources[k].path) for k in images)
