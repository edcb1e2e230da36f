"""What the rules find: data that repairs and messages are made from."""

from collections.abc import Mapping
from dataclasses import dataclass, field

from rdstitch.messages import Severity


@dataclass(frozen=True)
class Finding:
    """One thing that a rule found."""

    kind: str  # a key of :data:`rdstitch.verification.messages.TEXTS`
    images: tuple[int, ...] = ()  # indices of the images that it concerns; empty where it concerns the whole
    # as of :class:`rdstitch.messages.Message`. A failure of one image or of a pair may be mended without these; one of
    # the whole, or of more images, may not
    severity: Severity = "failure"
    values: Mapping[str, object] = field(default_factory=dict)  # what was measured: sizes, shares and counts, by name

    @property
    def fails(self) -> bool:
        """Whether the result cannot be relied on."""
        return self.severity == "failure"
