"""How long each stage took."""

from collections.abc import Sequence

from rdstitch.report.svg import BLUE, drawing, element, label, section

_WIDTH, _ROW, _LEFT = 640.0, 22.0, 190.0


def timings(stages: Sequence[tuple[str, float]]) -> str:
    """A bar for each stage, in their order."""
    if not stages:
        return section("Timings", "They were not measured.")
    total = sum(seconds for _, seconds in stages)
    longest = max(max(seconds for _, seconds in stages), 1e-9)
    parts = []
    for row, (name, seconds) in enumerate(stages):
        y, length = row * _ROW, seconds / longest * (_WIDTH - _LEFT - 90.0)
        parts.append(label(_LEFT - 8, y + 15, name, text_anchor="end"))
        parts.append(element("rect", x=_LEFT, y=y + 3, width=length, height=_ROW - 6, fill=BLUE))
        parts.append(label(_LEFT + length + 6, y + 15, f"{seconds:.2f} s"))
    return section(
        "Timings", f"{total:.1f} s on the clock in all.", drawing(_WIDTH, len(stages) * _ROW, parts, "timings")
    )
