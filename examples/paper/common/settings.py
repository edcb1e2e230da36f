"""How much work a figure may do, and where the real images are."""

import enum
from dataclasses import dataclass
from pathlib import Path

_SUFFIXES = (".jpg", ".jpeg", ".png", ".tif", ".tiff")


class Effort(enum.Enum):
    """TINY for tests, SMALL for a look (the default), FULL for the paper's counts."""

    TINY = enum.auto()
    SMALL = enum.auto()
    FULL = enum.auto()


@dataclass(frozen=True)
class Settings:
    """What every figure is given.

    ``peer_python``: Python that has the package stitching, which brings an OpenCV of its own; the one that runs if not
    given.
    """

    effort: Effort
    images: Path  # folder of the real sequences (``garfield_red``, ``copr``); figures do without those that are absent
    peer_python: str | None = None
    hpatches: Path | None = None  # folder of HPatches' sequences

    def count(self, tiny: int, small: int, full: int) -> int:
        """The one of three counts that the effort allows."""
        return {Effort.TINY: tiny, Effort.SMALL: small, Effort.FULL: full}[self.effort]

    def real_sequence(self, name: str) -> list[Path]:
        """Files of a real sequence in the order of their names; none where it is absent."""
        folder = self.images / name
        if not folder.is_dir():
            return []
        return sorted(path for path in folder.iterdir() if path.suffix.lower() in _SUFFIXES)
