"""How recipes report their progress, and how long each of their stages took."""

import time
from collections.abc import Callable

Progress = Callable[[str, int, int], None]
"""Called with the name of a stage, the number of steps done, and their total."""


FractionProgress = Callable[[float], None]
"""Called with the fraction of the work that is done, 0 to 1."""


def silent(*_done: object) -> None:
    """A progress of either kind that nobody watches."""


class StageTimer:
    """A progress that passes everything on, and records how long each stage took."""

    def __init__(self, progress: Progress = silent) -> None:
        self._progress = progress
        self._seconds: dict[str, float] = {}
        self._stage = "reading headers"
        self._since = time.perf_counter()

    def __call__(self, stage: str, done: int, total: int) -> None:
        if stage != self._stage:
            self._close()
            self._stage = stage
        self._progress(stage, done, total)

    @property
    def stages(self) -> tuple[tuple[str, float], ...]:
        """Name and seconds of every stage, in the order of their beginnings; the last one lasts until now."""
        self._close()
        return tuple(self._seconds.items())

    def _close(self) -> None:
        now = time.perf_counter()
        self._seconds[self._stage] = self._seconds.get(self._stage, 0.0) + now - self._since
        self._since = now
