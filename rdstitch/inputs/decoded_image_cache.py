"""Images kept between stages that look at them one after the other, as many as fit."""

from collections.abc import Hashable
from threading import Lock

from rdstitch.io.read import DecodedImage

_CAPACITY = 32 * 2**20  # bytes: some 18 images of working size in three channels; unmeasured


class DecodedImageCache:
    """Keeps images until they are taken, within so many bytes; those that do not fit are not kept.

    It saves time and never changes a result.
    """

    def __init__(self, capacity: int = _CAPACITY) -> None:
        self._capacity = self._free_bytes = capacity
        self._held: dict[Hashable, DecodedImage] = {}
        self._lock = Lock()

    def put(self, key: Hashable, image: DecodedImage) -> None:
        """Keep an image if it fits."""
        with self._lock:
            if key not in self._held and image.nbytes <= self._free_bytes:
                self._free_bytes -= image.nbytes
                self._held[key] = image

    def take(self, key: Hashable) -> DecodedImage | None:
        """Take an image out, if it was kept."""
        with self._lock:
            image = self._held.pop(key, None)
            if image is not None:
                self._free_bytes += image.nbytes
            return image

    def clear(self) -> None:
        """Drop all images."""
        with self._lock:
            self._held.clear()
            self._free_bytes = self._capacity

    def __reduce__(self) -> tuple[type["DecodedImageCache"], tuple[int]]:
        """Copies and other processes get an empty one."""
        return DecodedImageCache, (self._capacity,)
