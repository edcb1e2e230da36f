"""Pictures kept between stages that look at them one after the other, as many as fit."""

from collections.abc import Hashable
from threading import Lock

from rdstitch.io.read import Picture

_ROOM = 64 * 2**20


class Shelf:
    """Keeps pictures until they are taken; those for which there is no room are not kept.

    It saves time and never changes a result.

    Parameters
    ----------
    room : int
        Bytes.
    """

    def __init__(self, room: int = _ROOM) -> None:
        self._room = room
        self._held: dict[Hashable, Picture] = {}
        self._lock = Lock()

    def put(self, key: Hashable, picture: Picture) -> None:
        """Keep a picture if there is room for it."""
        with self._lock:
            if key not in self._held and _bytes(picture) <= self._room:
                self._room -= _bytes(picture)
                self._held[key] = picture

    def take(self, key: Hashable) -> Picture | None:
        """Have a picture back, if it was kept."""
        with self._lock:
            picture = self._held.pop(key, None)
            if picture is not None:
                self._room += _bytes(picture)
            return picture

    def clear(self) -> None:
        """Let go of all that is left."""
        with self._lock:
            self._room += sum(map(_bytes, self._held.values()))
            self._held.clear()


NO_SHELF = Shelf(room=0)
"""Keeps nothing."""


def _bytes(picture: Picture) -> int:
    """Memory that a picture takes."""
    return picture.pixels.nbytes + (0 if picture.alpha is None else picture.alpha.nbytes)
