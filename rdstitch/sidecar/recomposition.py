"""What composing again by a saved registration gives."""

from collections.abc import Mapping
from dataclasses import dataclass

from rdstitch.inputs.source import Source
from rdstitch.results.messages import Message
from rdstitch.results.stitch_result import OutputImage
from rdstitch.sidecar.read import SavedRegistration
from rdstitch.sidecar.records import MatchedBy


@dataclass(frozen=True, repr=False, kw_only=True)
class Recomposition(OutputImage):
    """An image made from a saved registration; also as :class:`rdstitch.results.stitch_result.OutputImage` has it.

    Attributes
    ----------
    saved : SavedRegistration
    sources : tuple of Source or None
        For each image of the registration the one that took its place, with its camera; None where there is none.
    matched : str
        "name", "time", "position" or "order".
    left_out : dict of int to Message
        Images that the registration used and that are not in the output, by their number, with the reason.
    messages : tuple of Message
        What the user should know of the compositing, and of the sidecar.
    """

    saved: SavedRegistration
    sources: tuple[Source | None, ...]
    matched: MatchedBy
    left_out: Mapping[int, Message]
    messages: tuple[Message, ...] = ()

    @property
    def summary(self) -> str:
        """What was made, and of how many images, in one line."""
        used = sum(source is not None for source in self.sources)
        return f"{super().summary}, {used} of {used + len(self.left_out)} images"
