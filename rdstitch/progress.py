"""How recipes report their progress."""

from collections.abc import Callable

Progress = Callable[[str, int, int], None]
"""Called with the name of a stage, the number of steps done, and their total."""


def silent(stage: str, done: int, total: int) -> None:
    """A progress that nobody watches."""
