"""What an examination finds, as data and in words."""

from dataclasses import asdict, dataclass
from typing import Any


@dataclass(frozen=True)
class Examination:
    """What to expect of a run.

    Attributes
    ----------
    pictures : int
        That can be read.
    unreadable : tuple of str
        Every other one, with the reason.
    sizes : tuple of (str, int)
        "width x height" and how many pictures have it, commonest first.
    cameras : tuple of (str, int)
        Make, model and serial number by EXIF, and how many pictures; "unknown" where it says nothing.
    focal : str
        What is known of the focal length.
    blurred, dark, burnt : tuple of str
        Names of pictures that are much less sharp than the others, that are dark, and that are burnt out.
    alone : tuple of str
        Names of pictures that seem to overlap with no other one that was compared.
    groups : int
        Groups of pictures that seem to hang together.
    overlap : float or None
        Median share of a picture that its best partner shows too; None where no pair was found.
    megapixels : float
        Of all pictures together.
    memory_bytes : int
        Expected at the peak of ``mosaic``, roughly.
    seconds : float
        Expected time of ``mosaic``, roughly, on this machine.
    advice : tuple of str
        What to change, most important first; empty where nothing is amiss.
    """

    pictures: int
    unreadable: tuple[str, ...]
    sizes: tuple[tuple[str, int], ...]
    cameras: tuple[tuple[str, int], ...]
    focal: str
    blurred: tuple[str, ...]
    dark: tuple[str, ...]
    burnt: tuple[str, ...]
    alone: tuple[str, ...]
    groups: int
    overlap: float | None
    megapixels: float
    memory_bytes: int
    seconds: float
    advice: tuple[str, ...]

    def as_dict(self) -> dict[str, Any]:
        """For JSON."""
        return asdict(self)

    def as_text(self) -> str:
        """For people, one line for each thing, advice at the end."""
        overlap = "none found" if self.overlap is None else f"about {self.overlap:.0%} with the best partner"
        lines = [
            f"pictures:   {self.pictures}" + (f", and {len(self.unreadable)} unreadable" if self.unreadable else ""),
            f"sizes:      {_counted(self.sizes)}",
            f"cameras:    {_counted(self.cameras)}",
            f"focal:      {self.focal}",
            f"sharpness:  {_few(self.blurred, 'blurred', 'nothing blurred')}",
            f"exposure:   {_few(self.dark, 'dark', 'nothing dark')}; "
            f"{_few(self.burnt, 'burnt out', 'nothing burnt out')}",
            f"overlap:    {overlap}; {_few(self.alone, 'without a partner', 'every picture has a partner')}; "
            f"{self.groups} group" + "s" * (self.groups != 1),
            f"effort:     about {_memory(self.memory_bytes)} of memory, {_time(self.seconds)} for a mosaic",
        ]
        return "\n".join([*lines, *(f"advice:     {item}" for item in self.advice or ["none: go ahead"])]) + "\n"


def _counted(items: tuple[tuple[str, int], ...]) -> str:
    return "; ".join(f"{name} ({count})" for name, count in items) or "none"


def _few(names: tuple[str, ...], what: str, none: str) -> str:
    """The first names of a list, and how many there are."""
    if not names:
        return none
    return f"{len(names)} {what}: {', '.join(names[:3])}" + ", …" * (len(names) > 3)


def _memory(size: int) -> str:
    return f"{size / 2**30:.1f} GB" if size >= 2**30 else f"{max(1, round(size / 2**20))} MB"


def _time(seconds: float) -> str:
    return f"{seconds / 60:.0f} min" if seconds >= 120 else f"{max(1, round(seconds))} s"
