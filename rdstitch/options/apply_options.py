"""Options of composing again by a saved registration."""

from dataclasses import dataclass

from rdstitch.choices import MatchBy
from rdstitch.options.option import documented, option
from rdstitch.options.shared_options import ArrayChannels, Every, FlatField, Mask, RunOptions


@documented
@dataclass(frozen=True)
class ApplyOptions(RunOptions):
    """Options of :func:`rdstitch.apply`; the command line has the same names and defaults.

    Which image takes whose place says ``match``: "name", the one of the same file name, of the same name before the
    suffix, or of the same part that varies (V07_RED.jpg, V07_NIR.jpg); "order", the one at the same position of equally
    many; "auto", by name, else the one that was taken at the same time, else at the same position.
    """

    match: MatchBy = option(
        "auto", "Assign images by name (suffix and band may differ), by order, or (auto) by name, time or GPS position."
    )
    flat_field: FlatField = "off"
    every: Every = 1
    mask: Mask = None
    channel_order: ArrayChannels = "bgr"
