"""What may be wrong with the images themselves, as far as their headers and masks show."""

from collections.abc import Sequence

from rdstitch.inputs.source import Source
from rdstitch.messages import MAX_NAMED, Message, shortened

_FOCAL_SPREAD = 1.03
"""Ratio of focal lengths in EXIF from which on the lens was zoomed; they are rounded to about one per cent."""


def doubtful_inputs(sources: Sequence[Source]) -> list[Message]:
    """Warnings on images of several cameras or zoom settings, and on images without a mask among others."""
    return [*_several_cameras(sources), *_unmasked(sources)]


def _unmasked(sources: Sequence[Source]) -> list[Message]:
    """Images without a mask among others that have one: perhaps a name is misspelt."""
    without = [source for source in sources if source.mask is None]
    if not 0 < len(without) < len(sources):
        return []
    text = f"{len(without)} of {len(sources)} images have no mask: {shortened([source.name for source in without])}"
    return [Message(text)]


def _several_cameras(sources: Sequence[Source]) -> list[Message]:
    """Images whose headers say that they come from another camera, or were zoomed."""
    known = [source for source in sources if source.metadata.model or source.metadata.serial]
    bodies: dict[str, list[str]] = {}
    for source in known:
        m = source.metadata
        bodies.setdefault(" ".join(filter(None, (m.make, m.model, m.serial))), []).append(source.name)
    if len(bodies) > 1:
        commonest = sorted(bodies.items(), key=lambda body: -len(body[1]))[:MAX_NAMED]
        listed = "; ".join(f"{body} ({len(names)}: {shortened(names)})" for body, names in commonest)
        text = f"the images come from {len(bodies)} cameras: {listed}; stitch those of each on their own"
        return [Message(text, code="mixed-lenses")]
    focal = {s.name: s.metadata.focal_px / max(s.metadata.size) for s in known if s.metadata.focal_px is not None}
    if focal and max(focal.values()) > _FOCAL_SPREAD * min(focal.values()):
        near, far = min(focal, key=lambda name: focal[name]), max(focal, key=lambda name: focal[name])
        return [
            Message(
                f"the lens was zoomed between the images, by up to {focal[far] / focal[near]:.2f} "
                f"(between {near} and {far}); stitch those of one zoom on their own",
                code="mixed-lenses",
            )
        ]
    return []
