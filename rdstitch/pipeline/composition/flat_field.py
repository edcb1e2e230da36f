"""The flat field of images of one camera: read from a file, or estimated from what all of them have in common."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from rdstitch.errors import InputError
from rdstitch.inputs.source import Source
from rdstitch.io.flat_field import read_flat_field
from rdstitch.results.messages import Message

NO_FLAT_FIELD = Message(
    "the images show no illumination that all have in common, and samples stay as they are",
    severity="note",
    code="flat-field",
)


def check_one_size(sources: Sequence[Source]) -> None:
    """Refuse images of several sizes."""
    w1, h1 = sources[0].camera.image_size
    other = next((source for source in sources if source.camera.image_size != (w1, h1)), None)
    if other is not None:
        w2, h2 = other.camera.image_size
        raise InputError(f"{other.path}: has {w2} x {h2} pixels, the images before it have {w1} x {h1}; leave it out")


def with_flat_field(sources: Sequence[Source], wanted: str | Path) -> tuple[list[Source], list[Message]]:
    """The images, to be read with flat-field correction; and messages on it."""
    from rdstitch.stage.estimate_flat_field import FlatFieldUnknown, estimate_illumination  # for tiles only

    if wanted == "off":
        return list(sources), []
    if wanted != "auto":
        pixels = sources[0].read().pixels
        channels = 1 if pixels.ndim == 2 else pixels.shape[2]
        field = read_flat_field(wanted, sources[0].camera.image_size, channels)
        return [replace(source, flat_field=field) for source in sources], []
    shown = estimate_illumination(lambda index: sources[index].read().pixels, len(sources))
    if shown is FlatFieldUnknown.FEW_TILES:
        text = f"{len(sources)} images are too few to show their flat field, and samples stay as they are"
        return list(sources), [Message(text, severity="note", code="flat-field")]
    if shown is FlatFieldUnknown.UNSURE:
        return list(sources), [NO_FLAT_FIELD]
    dark = ", ".join("not shown" if d is None else f"{d.level:.0f} ± {d.std:.0f}" for d in shown.dark)
    text = f"flat field: {shown.shading:.0%} less light where it is darkest, ± {shown.error:.1%}; dark level {dark}"
    return [replace(source, flat_field=shown.field) for source in sources], [Message(text, severity="note")]
