"""What the user reads of a stage whose axes are not as they were given."""

from collections.abc import Mapping, Sequence

from rdstitch.results.messages import Message
from rdstitch.stage.axes import MeasuredAxis


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


def neighbours_contradicted(source: str, names: Sequence[str], count: int, held: int) -> Message:
    """Where so many pairs of ``held``, such as that of these names, lie otherwise than the grid says."""
    pairs = f"{count} of {held} overlaps, as that of {' and '.join(names)}, are not where it has them"
    advice = "look at the order of the tiles, and the columns of numbered ones"
    return Message(f"{source} contradicted: {pairs}; {advice}", code="grid-as-shown")
