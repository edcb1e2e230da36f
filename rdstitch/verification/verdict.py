"""Every run judges itself: can the result be relied on?"""

import math
from collections.abc import Container, Mapping, Sequence
from concurrent.futures import Executor, ThreadPoolExecutor
from contextlib import nullcontext

import numpy as np

from rdstitch.alignment.result import Alignment, LinkFit
from rdstitch.cache import NO_CACHE, Cache
from rdstitch.errors import RegistrationError
from rdstitch.matching.match_graph import connected_components
from rdstitch.messages import Message, Severity, names_of, shortened
from rdstitch.registration import Registration
from rdstitch.verification.competing_motions import Contest
from rdstitch.verification.input_doubts import doubtful_inputs
from rdstitch.verification.misfits import agreement_of_all, disagreeing_pairs, misfitting_images
from rdstitch.verification.overlap_check import CheckedLink, check_overlaps, share_alike
from rdstitch.verification.parallax import find_parallax, parallax_messages
from rdstitch.verification.rival_check import compare_with_rivals, outside_rivals
from rdstitch.verification.rival_motion import MIN_AGREEMENT, find_rival_motions, is_apart, rival_messages
from rdstitch.verification.rules import Situation, one_of_each, spoken

Pair = tuple[int, int]

_MAX_RMS = 1.0  # of the whole, in thresholds
_MAX_RMS_OF_RELIEF = 3.0  # the same where the images look alike
_MAX_RELIEF = 0.02  # of an image's diagonal: the same where relief explains them, and most of the overlaps look alike
_MAX_AMBIGUITY = 0.4  # share of the pairs that may fit elsewhere: more is a pattern all over
# Of the cells of an overlap that agree: chance lets up to 7 % do so, and right registrations of difficult images
# (low sun, parallax, blur) have been seen to have 20 %.
_MIN_AGREEMENT, _DOUBTFUL_AGREEMENT = 0.10, 0.15
_USUAL_AGREEMENT, _CLEAR_AGREEMENT = 0.25, 0.5
_MIN_CELLS = 8  # below, the overlap has too little texture to say anything


class RefusedError(RegistrationError):
    """A registration failed its checks; it is kept for those who want to see why.

    Attributes
    ----------
    registration : Registration
    """

    code = "not-reliable"

    def __init__(self, registration: Registration) -> None:
        chosen = one_of_each(registration.failures)
        reasons = "; ".join(message.clause for message in chosen)
        if rest := len(registration.failures) - len(chosen):
            reasons += f"; and {rest} more like {'these' if len(chosen) > 1 else 'this'}"
        super().__init__(f"no reliable result: {reasons} (--force writes it all the same)")
        self.registration = registration


def judge(
    registration: Registration,
    threshold: float,
    executor: Executor | None = None,
    cache: Cache = NO_CACHE,
    *,
    lens_only: bool = False,
) -> tuple[Message, ...]:
    """Check an alignment against the pairs that it was made from, and against the pixels.

    What makes the places of images doubtful, a repeated pattern for one, leaves the lens as it is: a board shifted by
    a square is as straight as before. And images that mostly show what rests in them keep some matches of that,
    which agree with nothing, and look alike anywhere but where the moving plane puts them.

    Parameters
    ----------
    registration : Registration
    threshold : float
        Largest transfer error of an inlier of a pair, pixels.
    executor : concurrent.futures.Executor, optional
        Where images are compared; None: in one thread.
    cache : Cache
    lens_only : bool
        Only the lens is wanted, so that doubts about the places of images do not make the result fail, and are
        not reported where a repeated pattern explains them.

    Returns
    -------
    tuple of Message
        Failures, with the images that they concern where that is clear, and warnings; none for a good result.
    """
    alignment = registration.alignment
    paths = [str(source.path) for source in registration.sources]
    used = [fit for fit in alignment.links if fit.used]
    resting = registration.static_background
    disagreeing = disagreeing_pairs(registration)
    agreeing = [fit for fit in used if (fit.image1, fit.image2) not in disagreeing]
    geometric = [
        *_mixed(paths, registration),
        *agreement_of_all(used),
        *([] if resting else misfitting_images(registration, agreeing)),
        *([] if resting else (disagreeing[pair] for pair in _decisive(disagreeing, used, len(paths)))),
    ]
    if geometric:  # what the pixels say of images that may be left out need not be known
        return tuple(geometric)
    with nullcontext(executor) if executor is not None else ThreadPoolExecutor(1) as where:
        checked = [] if resting else check_overlaps(registration, where, cache)
    rivals = find_rival_motions(alignment, registration.pairs, threshold)
    parallax = find_parallax(alignment, registration.pairs) if alignment.on_sphere else []
    compared = compare_with_rivals(registration, rivals, checked)
    seen = outside_rivals(checked, rivals, compared)
    ambiguous = _ambiguous(paths, seen)
    if lens_only:  # it is the same a period of the pattern further on, and what rests has a message of its own
        rivals = [] if resting else [rival for rival in rivals if (rival.image1, rival.image2) not in ambiguous]
    # What two images share of a plane looks alike; where something else moves, it may be that which holds them.
    undecided = is_apart(rivals) and not (compared and (compared.won or compared.lost))
    least = MIN_AGREEMENT if undecided else _MIN_AGREEMENT
    suspicions = {**disagreeing, **_unlike(paths, seen, least), **_of_the_rival(paths, checked, compared), **ambiguous}
    decisive = [] if lens_only or resting else _decisive(suspicions, used, len(paths))
    doubtful = [pair for pair in suspicions if pair not in decisive and not (lens_only and pair in ambiguous)]
    messages = (
        *_error_of_the_whole(alignment, threshold, checked),
        *(parallax_messages(paths, parallax) or _relief(paths, alignment)),
        *([] if lens_only else _shape(paths, alignment)),
        *([] if lens_only else _pattern(ambiguous, checked)),
        *(suspicions[pair] for pair in decisive),
        *_outvoted(paths, doubtful, ambiguous, seams=not lens_only),
        *([] if parallax else rival_messages(paths, rivals, share_alike(checked), compared, lens_only=lens_only)),
        *([] if lens_only else _little_alike(paths, [link for link in seen if link.pair not in suspicions])),
        *([] if lens_only else _settled(paths, seen)),
        *_two_left(paths, registration),
        *doubtful_inputs(registration.sources),
    )
    shape, size = alignment.shape, min(2.0 * camera.half_diagonal for camera in alignment.cameras)
    bent = shape is not None and math.hypot(shape.shift, shape.shift_std) < size
    flat = not alignment.on_sphere and int(alignment.used.sum()) > 2
    depth = alignment.relief.found or bool(parallax)
    return spoken(messages, Situation(_usual_agreement(checked), flat, depth, bent))


def _failure(text: str, images: Sequence[str] = ()) -> Message:
    return Message(text, tuple(images), "failure")


def _error_of_the_whole(alignment: Alignment, threshold: float, checked: Sequence[CheckedLink]) -> list[Message]:
    """Errors of all pairs together; those of rough ground are a warning where the pixels agree."""
    rms = alignment.rms
    if rms <= _MAX_RMS * threshold:
        return []
    text = f"the images disagree by {rms:.1f} pixels, more than the threshold of {threshold:g} pixels"
    relief, alike = alignment.relief, _usual_agreement(checked)
    largest = _MAX_RELIEF * 2.0 * max(camera.half_diagonal for camera in alignment.cameras)
    # Without what neighbours have in common, errors are those of a plane.
    explained = rms <= largest and rms**2 - relief.size**2 <= (_MAX_RMS * threshold) ** 2
    # Where the pixels agree, depth that one surface does not explain has been found a place all the same.
    rough = (rms <= _MAX_RMS_OF_RELIEF * threshold and alike >= _USUAL_AGREEMENT) or (
        relief.found and explained and alike >= _CLEAR_AGREEMENT
    )
    return [Message(f"{text}: the ground is rough", code="relief") if rough else _failure(text)]


def _relief(paths: Sequence[str], alignment: Alignment) -> list[Message]:
    """Errors that neighbouring matches have in common, and the pair of images where they are largest."""
    if not alignment.relief.found:
        return []
    worst = max((fit for fit in alignment.links if fit.used), key=lambda fit: fit.rms)
    images = (paths[worst.image1], paths[worst.image2])
    first, second = names_of(images)
    text = f"{alignment.relief.explanation}; most of all between {first} and {second} ({worst.rms:.1f} pixels)"
    return [Message(text, images, code="parallax" if alignment.on_sphere else "relief")]


def _shape(paths: Sequence[str], alignment: Alignment) -> list[Message]:
    """A shape of the whole that the overlaps do not hold, and the image that may be off the most."""
    shape = alignment.shape
    if shape is None:
        return []
    image = paths[shape.image]
    if alignment.focal is None:
        # Chains of free homographies bend with whatever is not modelled, a curved wall for one.
        text = (
            "global accuracy unknown: the images do not come from one camera with one focal length, or what they show "
            "is not flat; each has a homography of its own, and their errors add up from image to image"
        )
        return [Message(text, (image,), code="shape")]
    if not shape.doubtful:
        return []
    size = f"about {math.hypot(shape.shift, shape.shift_std):.0f} pixels in the whole, though its overlaps agree"
    if shape.shown:
        text = f"may be off by {size}: the errors have a pattern that was not modelled, most likely {shape.cause}"
    else:
        remedy = "more rows of images" if alignment.distortion_std == 0.0 else "the lens, or more rows of images"
        text = f"may be off by {size}: the images cannot exclude {shape.cause}; give {remedy}"
    return [Message(text, (image,), code="shape")]


def _usual_agreement(checked: Sequence[CheckedLink]) -> float:
    """How much alike images look where most pairs put them, [0, 1]; 0 where there is nothing to see."""
    shares = [link.agreement.share for link in checked if link.agreement.cells >= _MIN_CELLS]
    return float(np.median(shares)) if shares else 0.0


def _pattern(ambiguous: Mapping[Pair, Message], checked: Sequence[CheckedLink]) -> list[Message]:
    """A pattern that repeats itself over so many pairs that leaving some of them out proves nothing."""
    if len(ambiguous) <= _MAX_AMBIGUITY * len(checked):
        return []
    return [_failure(f"{len(ambiguous)} of {len(checked)} pairs fit as well elsewhere (a repeated pattern?)")]


def _outvoted(
    paths: Sequence[str], pairs: Sequence[Pair], ambiguous: Container[Pair] = (), *, seams: bool = True
) -> list[Message]:
    """Suspicious pairs on which nothing depends: a warning of those that fit badly, one of those that fit twice."""
    result = []
    for twice, what in ((False, "badly"), (True, "as well elsewhere (a repeated pattern?)")):
        own = [pair for pair in pairs if (pair in ambiguous) == twice]
        if own:
            named = shortened([" and ".join(names_of([paths[i], paths[j]])) for i, j in own])
            fit = (
                f"one pair fits {what}, and little depends on it"
                if len(own) == 1
                else (f"{len(own)} pairs fit {what}, and little depends on them")
            )
            text = f"{fit}: {named}"
            images = tuple(paths[k] for k in sorted({k for pair in own for k in pair}))
            text += "; look at the seams between them" if seams else ""
            result.append(Message(text, images, "detail", code="doubtful-seam"))
    return result


def _mixed(paths: Sequence[str], registration: Registration) -> list[Message]:
    """Two lenses whose images were not separated: it is not clear which are whose, or each has one image only."""
    mixed = registration.mixed
    if mixed is None or mixed.certain:
        return []
    own, others = ([path for path, s in zip(paths, mixed.second, strict=True) if s == k] for k in (True, False))
    return [
        _failure(
            f"two lenses or zooms are mixed: {shortened(names_of(own))} (λ about {mixed.distortion[1]:.3f}) and "
            f"{shortened(names_of(others))} ({mixed.distortion[0]:.3f}); stitch those of each on their own"
        )
    ]


def _two_left(paths: Sequence[str], registration: Registration) -> list[Message]:
    """A warning where a third image, taken for one of another lens, is all that told a curved wall from a plane."""
    used = registration.alignment.used
    if registration.mixed is None or used.sum() != 2:
        return []
    kept = tuple(path for path, own in zip(paths, used, strict=True) if own)
    text = (
        f"{' and '.join(names_of(kept))} fit without the images of another lens, as any two do; if all are of one "
        "lens, the scene is no plane, and these are off in the whole; add images of this lens"
    )
    return [Message(text, kept, code="mixed-lenses")]


def _decisive(suspicions: Mapping[Pair, Message], used: Sequence[LinkFit], count: int) -> list[Pair]:
    """The suspicious pairs without which the images fall apart; those of the others are held by better ones."""
    sound = [fit for fit in used if (fit.image1, fit.image2) not in suspicions]
    parts = connected_components(count, [fit.image1 for fit in sound], [fit.image2 for fit in sound])
    part = {image: number for number, images in enumerate(parts) for image in images}
    return [(i, j) for i, j in suspicions if part[i] != part[j]]


def _of_pair(paths: Sequence[str], link: LinkFit, text: str, code: str, severity: Severity = "failure") -> Message:
    """A message on two images; ``text`` follows their names."""
    both = paths[link.image1], paths[link.image2]
    return Message(f"{' and '.join(names_of(both))}{text}", both, severity, code)


def _unlike(paths: Sequence[str], checked: Sequence[CheckedLink], least: float) -> dict[Pair, Message]:
    """Images that were put together and do not look alike there."""
    return {
        link.pair: _of_pair(
            paths,
            link.fit,
            f" do not look alike where they are put together ({link.agreement.confirming} of {link.agreement.cells} "
            "places agree)",
            "unlike",
        )
        for link in checked
        if link.agreement.cells >= _MIN_CELLS and link.agreement.share < least
    }


def _of_the_rival(
    paths: Sequence[str], checked: Sequence[CheckedLink], compared: Contest | None
) -> dict[Pair, Message]:
    """Images that may be held together by what moves differently from the plane; none where that holds all of them."""
    doubtful = frozenset[Pair]() if compared is None or compared.lost else compared.doubtful
    return {
        link.pair: _of_pair(
            paths,
            link.fit,
            " may be held together by what moves differently from the plane (a vehicle?)",
            "second-motion",
        )
        for link in checked
        if link.pair in doubtful
    }


def _ambiguous(paths: Sequence[str], checked: Sequence[CheckedLink]) -> dict[Pair, Message]:
    """Images of a repeated pattern, of which nobody can say by how many periods they are apart."""
    return {
        link.pair: _of_pair(
            paths,
            link.fit,
            f" fit as well elsewhere, {link.ambiguity.shift:.0%} of an image away (a repeated pattern?); "
            "take images that share something unique",
            "ambiguous",
        )
        for link in checked
        if link.ambiguity.ambiguous and not link.unique
    }


def _settled(paths: Sequence[str], checked: Sequence[CheckedLink]) -> list[Message]:
    """A repeated pattern in which what is unique decided, and the pair that has the least support besides."""
    settled = [link for link in checked if link.unique]
    if not settled:
        return []
    least = min(settled, key=lambda link: link.agreement.share)
    images = (paths[least.fit.image1], paths[least.fit.image2])
    first, second = names_of(images)
    text = (
        "the images show a repeated pattern; what is unique in them (dirt, a mark, an object) decided where they "
        f"lie; look at the seams, that between {first} and {second} first"
    )
    return [Message(text, images, code="repeated-pattern")]


def _little_alike(paths: Sequence[str], checked: Sequence[CheckedLink]) -> list[Message]:
    """Images that look less alike than most where they are put together."""
    return [
        _of_pair(
            paths,
            link.fit,
            f": only {link.agreement.confirming} of {link.agreement.cells} places look alike; "
            "look at the seam between them",
            "doubtful-seam",
            "warning",
        )
        for link in checked
        if link.agreement.cells >= _MIN_CELLS and link.agreement.share < _DOUBTFUL_AGREEMENT
    ]
