"""Stage: check a registration; images that fail are left out by name, and the rest is aligned again."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass

from rdstitch.alignment.motion_models import MODELS
from rdstitch.alignment.result import links_by_image
from rdstitch.choices import ModelName
from rdstitch.errors import PartialResultError
from rdstitch.inputs.input_guard import InputGuard
from rdstitch.pipeline.registration.aligner import Aligner
from rdstitch.pipeline.registration.realign import Rejected, aligner_of, left_out_images, plane_of_most, without
from rdstitch.pipeline.registration.working_size import at_full_size
from rdstitch.pipeline.run import Run
from rdstitch.results.messages import merge_by_reason
from rdstitch.results.registration import Registration
from rdstitch.verification.evidence import ResultEvidence
from rdstitch.verification.findings import Finding, Scope, messages_of
from rdstitch.verification.verdict import RefusedError, judge

_MAX_ROUNDS = 20  # times that something is left out; each takes one adjustment


@dataclass(frozen=True)
class _Checked:
    """A registration, and what its checks found."""

    registration: Registration
    findings: tuple[Finding, ...]

    @property
    def failures(self) -> list[Finding]:
        return [finding for finding in self.findings if finding.fails]

    @property
    def fails_as_whole(self) -> bool:
        """Whether there is a failure that no image or pair is to blame for."""
        return any(finding.kind.scope is Scope.WHOLE for finding in self.failures)

    def with_messages(self) -> Registration:
        """The registration with its findings as messages."""
        return self.registration.with_messages(messages_of(self.findings, self.registration))


def accept(registration: Registration, run: Run) -> Registration:
    """The registration of the images that pass all checks, with messages, in pixels of the working size."""
    options, purpose = run.options, run.purpose
    aligner = aligner_of(registration, run)
    undamaged = None if options.force else _without_damage(registration, aligner, run.guard)
    if undamaged is not None and _is_simpler(undamaged.alignment.model, registration.alignment.model):
        registration, undamaged = undamaged, None

    def check(candidate: Registration) -> _Checked:
        evidence = ResultEvidence(candidate, options.threshold, options.threads, aligner.cache, purpose)
        return _Checked(candidate, judge(evidence))

    first = check(registration)
    tried = [first]
    repairs = iter(()) if options.force else _repairs(first, check, undamaged, aligner, options.threads)
    while tried[-1].failures and (repaired := next(repairs, None)) is not None:
        tried.append(repaired)
    # If no repair succeeds, report the failures of the first check, or of the last one if they concern the whole.
    last = tried[-1]
    accepted = (last if not last.failures or last.fails_as_whole else first).with_messages()
    if accepted.failures and not options.force:
        raise RefusedError(at_full_size(accepted))
    if options.strict and accepted.left_out:
        raise PartialResultError("; ".join(map(str, merge_by_reason(accepted.left_out))))
    return accepted


def _repairs(
    first: _Checked,
    check: Callable[[Registration], _Checked],
    undamaged: Registration | None,
    aligner: Aligner,
    threads: int,
) -> Iterator[_Checked]:
    """Repairs of a failing registration: without damaged files, by the plane of most images, without what fails."""
    if undamaged is not None and not (checked := check(undamaged)).failures:
        yield checked
    start = first
    plane = None if aligner.options.purpose.lens_only else plane_of_most(first.registration, aligner, threads)
    if plane is not None and not (checked := check(plane)).fails_as_whole:
        yield (start := checked)
    current, rejected = start, dict[tuple[int, ...], str]()
    for _ in range(_MAX_ROUNDS):
        if current.fails_as_whole:
            return
        rejected |= _worst(current)
        rest = without(start.registration, rejected, aligner)
        # Where as many images fail as pass, nobody can say which of them are right.
        if rest is None or rest.alignment.used.sum() <= len(left_out_images(rejected)):
            return
        yield (current := check(rest))


def _without_damage(registration: Registration, aligner: Aligner, guard: InputGuard) -> Registration | None:
    """The registration without damaged files; None if none is used, or too few others are left.

    Flipped bits shift a part of an image: by a few pixels, that looks as if the camera had tilted, and all tilt then;
    by more, as if something moved.
    """
    used = registration.alignment.used
    damaged = [k for k, source in enumerate(registration.sources) if source.path in guard.damaged and used[k]]
    if not damaged:
        return None
    reason = "is damaged, and all others fit better without it; copy it again from its source"
    rest = without(registration, {(k,): reason for k in damaged}, aligner)
    return rest if rest is not None and 2 * rest.alignment.used.sum() > used.sum() else None


def _is_simpler(model: ModelName, former: ModelName) -> bool:
    """Whether a motion in the plane has less freedom than a former one."""
    by_freedom = [name for name, each in MODELS.items() if not each.on_sphere]
    return {model, former} <= set(by_freedom) and by_freedom.index(model) < by_freedom.index(former)


def _worst(checked: _Checked) -> Rejected:
    """The worst failing images, no two of them linked, since a bad image spoils its neighbours; else failing pairs."""
    registration, failures = checked.registration, checked.failures
    single = {finding.images[0]: finding for finding in failures if finding.kind.scope is Scope.IMAGE}
    if not single:
        pairs = [finding for finding in failures if finding.kind.scope is Scope.PAIR]
        said = zip(pairs, messages_of(pairs, registration), strict=True)
        return {finding.images: message.text for finding, message in said}
    links_of = links_by_image(registration.alignment.holding)

    def agreement(image: int) -> float:
        """Fraction of its matches that agree with the alignment of all; 1 without any."""
        fits = links_of.get(image, [])
        return sum(fit.inliers for fit in fits) / max(sum(fit.count for fit in fits), 1) if fits else 1.0

    chosen = dict[tuple[int, ...], str]()
    neighbours: set[int] = set()
    for image in sorted(single, key=lambda k: (agreement(k), k)):
        if image not in neighbours:
            chosen[image,] = messages_of([single[image]], registration)[0].text
            neighbours |= {k for fit in links_of.get(image, []) for k in fit.images}
    return chosen
