"""Images kept between stages that look at them one after the other, as many as fit."""

from collections.abc import Hashable
from threading import Lock

from rdstitch.io.read import DecodedImage

_CAPACITY = 32 * 2**20


class DecodedImageCache:
    """Keeps images until they are taken; those for which there is no room are not kept.

    It saves time and never changes a result.
    """

    def __init__(self, room: int = _CAPACITY) -> None:
        self._capacity = self._room = room
        self._held: dict[Hashable, DecodedImage] = {}
        self._lock = Lock()

    def put(self, key: Hashable, image: DecodedImage) -> None:
        """Keep an image if there is room for it."""
        with self._lock:
            if key not in self._held and image.nbytes <= self._room:
                self._room -= image.nbytes
                self._held[key] = image

    def take(self, key: Hashable) -> DecodedImage | None:
        """Have an image back, if it was kept."""
        with self._lock:
            image = self._held.pop(key, None)
            if image is not None:
                self._room += image.nbytes
            return image

    def clear(self) -> None:
        """Let go of all that is left."""
        with self._lock:
            self._held.clear()
            self._room = self._capacity

    def __reduce__(self) -> tuple[type["DecodedImageCache"], tuple[int]]:
        """Copies and other processes get an empty one."""
        return DecodedImageCache, (self._capacity,)
