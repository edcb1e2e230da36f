"""What the rules find: data that repairs and messages are made from."""

from collections.abc import Mapping
from dataclasses import field

from rdstitch.frozen import dataclass
from rdstitch.messages import Severity


@dataclass(frozen=True)
class Finding:
    """One thing that a rule found.

    Attributes
    ----------
    kind : str
        A key of :data:`rdstitch.verification.messages.TEXTS`.
    images : tuple of int
        Indices of the images that it concerns; empty where it concerns the whole.
    severity : str
        As of :class:`rdstitch.messages.Message`. A failure of one image or of a pair may be mended without these; one
        of the whole, or of more images, may not.
    values : mapping
        What was measured: sizes, shares and counts, by name.
    """

    kind: str
    images: tuple[int, ...] = ()
    severity: Severity = "failure"
    values: Mapping[str, object] = field(default_factory=dict)

    @property
    def fails(self) -> bool:
        """Whether the result cannot be relied on."""
        return self.severity == "failure"
