"""What the user reads of a stage: axes that are not as they were given, and the illumination of its tiles."""

from collections.abc import Mapping

from rdstitch.results.messages import Message
from rdstitch.stage.axes import MeasuredAxis
from rdstitch.stage.estimate_flat_field import Illumination


def axes_contradicted(source: str, axes: Mapping[int, MeasuredAxis]) -> Message:
    """Where tiles show other axes of their grid, 0 for columns and 1 for rows, than its source says."""
    differences, overlaps = [], []
    for k, axis in axes.items():
        along = 1 - k if axis.swapped else k
        if axis.swapped:
            differences.append(f"{('columns', 'rows')[k]} lie {'below' if along else 'beside'} each other")
        if axis.mirrored:
            differences.append(f"the next {('column', 'row')[k]} is {('left', 'above')[along]}")
        overlaps.append(f"{100.0 * axis.overlap:.1f}")
    shown = f"{', '.join([*differences, ''])}neighbours overlap by {' and '.join(overlaps)} %"
    return Message(f"{source} contradicted: {shown}", code="grid-as-shown")


def flat_field_estimated(shown: Illumination) -> Message:
    """How uneven the light is, and the dark level of each channel."""
    dark = ", ".join(f"{d.level:.0f} ± {d.std:.0f}" if d is not None else "not shown" for d in shown.dark)
    text = f"flat field: {shown.shading:.0%} less light where it is darkest, ± {shown.error:.1%}; dark level {dark}"
    return Message(text, severity="note")
