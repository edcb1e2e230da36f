"""Images for the tiles, prefetched, decoded once, in bounded memory: those for which there is no room wait on disk."""

from collections import OrderedDict
from collections.abc import Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from threading import Lock

from rdstitch.compositing.source_images import ImageOnDisk, ImageReader, LoadedImage
from rdstitch.system.temporary_folder import TemporaryFolder


class ImageCache:
    """Images, prepared for resampling, in at most ``limit`` bytes (though always one in memory).

    ``shrinks`` are image pixels per output pixel. Images used longest ago go to a temporary file when there are more,
    where one can be written. ``ahead``: a thread of its own reads them before they are used.
    """

    def __init__(self, reader: ImageReader, shrinks: Sequence[float], limit: int, *, ahead: bool = False) -> None:
        self._reader, self._shrinks, self.limit = reader, shrinks, limit
        self._ahead = ThreadPoolExecutor(1) if ahead else None
        self._held: OrderedDict[int, LoadedImage] = OrderedDict()
        self._on_disk: dict[int, ImageOnDisk] = {}
        self._folder: TemporaryFolder | None = None
        self._wanted = set(range(len(shrinks)))
        # One image is read at a time; meanwhile those that are held can be had.
        self._lock, self._reading = Lock(), Lock()

    def part(self, images: Sequence[int], limit: int) -> "ImageCache":
        """Make an empty one for some of the images, which reads nothing ahead."""
        return ImageCache(self._reader.part(images), [self._shrinks[index] for index in images], limit)

    def __reduce__(self) -> tuple[type["ImageCache"], tuple[ImageReader, Sequence[float], int]]:
        """Other processes get an empty one, which reads nothing ahead."""
        return ImageCache, (self._reader, self._shrinks, self.limit)

    def masked(self, index: int) -> bool:
        """Whether an image has transparent parts."""
        return self._reader.masked(index)

    def expect(self, wanted: set[int]) -> None:
        """Forget all images but these; another one that is requested after all is read again."""
        with self._lock:
            for index in self._wanted - wanted:
                self._held.pop(index, None)
                if (on_disk := self._on_disk.pop(index, None)) is not None:
                    on_disk.remove()
            self._wanted = set(wanted)

    def get(self, index: int) -> LoadedImage:
        """Give image ``index``, read unless it is kept; callable from several threads."""
        if (kept := self._find(index)) is not None:
            return kept
        with self._reading:
            # Another thread may have read it in the meantime.
            return self._find(index) or self._read(index)

    def prefetch(self, indices: Iterable[int]) -> None:
        """Read the images that come next, in this order, as far as there is room."""
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
            if index not in self._wanted or index in self._held or index in self._on_disk:
                return
            with self._lock:
                room = self.limit - self._nbytes()
            if self._reader.nbytes(index, self._shrinks[index]) <= room:
                self._read(index)

    def _read(self, index: int) -> LoadedImage:
        """Read an image and hold it; those used longest ago go to disk where there is no room. One thread at a time."""
        loaded = self._reader.prepared(index, self._shrinks[index])
        while (oldest := self._oldest_beyond(self.limit - loaded.nbytes)) is not None:
            on_disk = self._written(*oldest)  # without the lock, which every ``get`` needs
            with self._lock:
                still_wanted = self._held.pop(oldest[0], None) is not None
                if on_disk is not None and still_wanted:
                    self._on_disk[oldest[0]] = on_disk
                elif on_disk is not None:
                    on_disk.remove()
        with self._lock:
            self._wanted.add(index)
            self._held[index] = loaded
        return loaded

    def _oldest_beyond(self, room: int) -> tuple[int, LoadedImage] | None:
        """The image used longest ago, where those that are held take more than there is room for."""
        with self._lock:
            return next(iter(self._held.items())) if self._held and self._nbytes() > room else None

    def _written(self, index: int, image: LoadedImage) -> ImageOnDisk | None:
        with suppress(OSError):
            self._folder = self._folder or TemporaryFolder()
            return ImageOnDisk.write(image, self._folder.path / str(index))
        return None

    def _nbytes(self) -> int:
        """Memory in use; call with the lock held."""
        return sum(image.nbytes for image in self._held.values())

    def _find(self, index: int) -> LoadedImage | None:
        with self._lock:
            if (held := self._held.get(index)) is not None:
                self._held.move_to_end(index)
                return held
            on_disk = self._on_disk.get(index)
            # What is mapped can be read when its file is gone.
            return None if on_disk is None else on_disk.mapped()
