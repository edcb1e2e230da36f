"""Images for the tiles, prefetched, decoded once, in bounded memory: those for which there is no room wait on disk.

Most of an image is often hidden by its neighbours: where room is short, only the part that will be requested is kept.
"""

from collections import OrderedDict
from collections.abc import Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from threading import Lock

from rdstitch.compositing.boxes import Box, encloses
from rdstitch.compositing.source_images import NOTHING, ImageOnDisk, ImageReader, LoadedImage
from rdstitch.stored import TemporaryFolder


class ImageCache:
    """Images, or parts of them, prepared for resampling, in at most ``limit`` bytes (though always one in memory).

    Parameters
    ----------
    shrinks : sequence of float
        Image pixels per output pixel.
    limit : int
        Bytes of memory; those used longest ago go to a temporary file when there are more, where one can be written.
    ahead : bool
        Read images ahead of their use, in a thread of its own.
    """

    def __init__(self, reader: ImageReader, shrinks: Sequence[float], limit: int, *, ahead: bool = False) -> None:
        self._reader, self._shrinks, self._limit = reader, shrinks, limit
        self._ahead = ThreadPoolExecutor(1) if ahead else None
        self._held: OrderedDict[int, LoadedImage] = OrderedDict()
        self._on_disk: dict[int, ImageOnDisk] = {}
        self._folder: TemporaryFolder | None = None
        self._expected: list[Box | None] = [None] * len(shrinks)
        self._surprising: set[int] = set()
        # One image is read at a time; meanwhile those that are held can be had.
        self._lock, self._reading = Lock(), Lock()

    def part(self, images: Sequence[int], limit: int) -> "ImageCache":
        """An empty one for some of the images, which reads nothing ahead."""
        return ImageCache(self._reader.part(images), [self._shrinks[index] for index in images], limit)

    def __reduce__(self) -> tuple[type["ImageCache"], tuple[ImageReader, Sequence[float], int]]:
        """Other processes get an empty one, which reads nothing ahead."""
        return ImageCache, (self._reader, self._shrinks, self._limit)

    @property
    def limit(self) -> int:
        """Bytes of memory."""
        return self._limit

    def masked(self, index: int) -> bool:
        """Whether an image has transparent parts."""
        return self._reader.masked(index)

    def expect(self, parts: Sequence[Box]) -> None:
        """Keep no more of each image than the part that will be requested from now on, where room is short.

        An image of which more is requested after all is read again, and from then on kept whole.
        """
        with self._lock:
            for index, part in enumerate(parts):
                if index not in self._surprising:
                    self._expected[index] = part
                    if part == NOTHING:
                        self._drop(index)

    def get(self, index: int, part: Box) -> LoadedImage:
        """A part of image ``index``, read unless it is kept; callable from several threads."""
        if (kept := self._find(index, part)) is not None:
            return kept
        with self._reading:
            # Another thread may have read it in the meantime.
            if (kept := self._find(index, part)) is not None:
                return kept
            with self._lock:
                self._drop(index)
                expected = self._expected[index]
                if expected is not None and not encloses(expected, part):
                    self._surprising.add(index)
                    self._expected[index] = expected = None
            return self._read(index, expected)

    def prefetch(self, indices: Iterable[int]) -> None:
        """Prefetch the images that come next, in this order, as far as there is room."""
        if self._ahead is None:
            return
        for index in indices:
            # Who requests an image that cannot be read gets the error.
            self._ahead.submit(self._read_ahead, index)

    def close(self) -> None:
        """Read nothing ahead any more, and forget what is on disk."""
        if self._ahead is not None:
            self._ahead.shutdown(cancel_futures=True)
            self._ahead = None
        with self._lock:
            self._on_disk, self._folder = {}, None

    def _read_ahead(self, index: int) -> None:
        """Read an image, unless it is kept or others would have to go for it."""
        with self._reading:
            expected = self._expected[index]
            if index in self._held or index in self._on_disk or expected == NOTHING:
                return
            if self._make_room(self._reader.nbytes(index, self._shrinks[index])):
                self._read(index, expected)

    def _read(self, index: int, part: Box | None) -> LoadedImage:
        """Read a part of an image and hold it; those used longest ago go to disk where there is no room."""
        loaded = self._reader.prepared(index, self._shrinks[index])
        if part is not None:
            loaded = loaded.cut(part)
        self._make_room(loaded.nbytes)
        with self._lock:
            while self._held and self._nbytes() + loaded.nbytes > self._limit:
                self._move_to_disk(*self._held.popitem(last=False))
            self._held[index] = loaded
        return loaded

    def _make_room(self, nbytes: int) -> bool:
        """Drop what will not be requested of the images held, if need be; whether there is room for so much then."""
        with self._lock:
            room, indices = self._limit - self._nbytes(), list(self._held)
        for index in indices if nbytes > room else ():
            self._cut(index)
        with self._lock:
            return nbytes <= self._limit - self._nbytes()

    def _cut(self, index: int) -> None:
        """Drop what will not be requested of an image that is held."""
        with self._lock:
            image, expected = self._held.get(index), self._expected[index]
        if image is None or expected is None:
            return
        # No part at all is expected of one that was being read when it was done with.
        image = None if expected == NOTHING else image.cut(expected)
        with self._lock:
            if image is None:
                self._drop(index)
            elif index in self._held:
                self._held[index] = image

    def _move_to_disk(self, index: int, image: LoadedImage) -> None:
        """Keep an image in a file, unless none can be written; call with the lock held."""
        with suppress(OSError):
            self._folder = self._folder or TemporaryFolder()
            self._on_disk[index] = ImageOnDisk.write(image, self._folder.path / str(index))

    def _drop(self, index: int) -> None:
        """Forget an image; call with the lock held."""
        self._held.pop(index, None)
        if (on_disk := self._on_disk.pop(index, None)) is not None:
            on_disk.remove()

    def _nbytes(self) -> int:
        """Memory in use; call with the lock held."""
        return sum(image.nbytes for image in self._held.values())

    def _find(self, index: int, part: Box) -> LoadedImage | None:
        """An image that is kept."""
        with self._lock:
            if (held := self._held.get(index)) is not None:
                self._held.move_to_end(index)
                return held if held.holds(part) else None
            on_disk = self._on_disk.get(index)
            # What is mapped can be read when its file is gone.
            mapped = None if on_disk is None else on_disk.mapped()
        return mapped.cut(part, copy=True) if mapped is not None and mapped.holds(part) else None
