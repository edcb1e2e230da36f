"""What all stages of one run have in common."""

from concurrent.futures import Executor
from pathlib import Path

from rdstitch.choices import Purpose
from rdstitch.executors import open_executor
from rdstitch.inputs.input_guard import InputGuard
from rdstitch.options.files_beside import NOTHING_BESIDE, FilesBeside
from rdstitch.options.stitch_options import StitchOptions
from rdstitch.system.dataclasses import dataclass, field
from rdstitch.system.progress import StageTimer


@dataclass(frozen=True)
class Run:
    """What the user decided, where results go, and what is noticed meanwhile."""

    options: StitchOptions
    output: str | Path | None = None  # image to write; None for one in memory
    beside: FilesBeside = NOTHING_BESIDE
    progress: StageTimer = field(default_factory=StageTimer)  # it knows how long each stage took, for the report
    purpose: Purpose = Purpose.MOSAIC
    guard: InputGuard = field(default_factory=InputGuard)  # what all who read the input files notice of them

    def executor(self, images: int) -> Executor:
        """Where the tasks of so many images are computed; to be used in a ``with`` block."""
        options = self.options
        return open_executor(options.threads, images, scheduler=options.scheduler, store=options.cache)
