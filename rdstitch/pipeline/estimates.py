"""What estimation may give and no camera can be: the pictures are at fault, not the arguments."""

from collections.abc import Iterator
from contextlib import contextmanager

from rdstitch.errors import ImpossibleCameraError, RegistrationError


@contextmanager
def impossible_estimates_fail() -> Iterator[None]:
    """An estimated camera that cannot be is a failed registration; a block, or a decorator of a stage.

    Raises
    ------
    RegistrationError
    """
    try:
        yield
    except ImpossibleCameraError as error:
        raise RegistrationError(
            f"no reliable result: the pictures agree best on a lens that cannot be ({error}); "
            "give the lens with --camera or --lambda, or take pictures that overlap more"
        ) from error
