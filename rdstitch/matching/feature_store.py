"""Features and matches of a whole set, on disk: between stages, processes and machines travel their names."""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Self

import numpy as np
from numpy.typing import NDArray

from rdstitch.arrays import FloatArray
from rdstitch.features import Correspondences, Features, PackedFeatures
from rdstitch.geometry.camera import Camera
from rdstitch.system.cache import Cache, InMemory, Stored

Size = tuple[int, int]


@dataclass(frozen=True, eq=False)
class StoredFeatures:
    """Features of one image, read when they are needed."""

    stored: Stored[PackedFeatures]  # in pixels of the size of the image
    count: int  # number of features that are stored
    # width and height of the image in whose pixels they are wanted; None: as they are stored
    image_size: Size | None = None
    chosen: NDArray[np.intp] | None = None  # (N,), intp: those that are wanted, in their order; None: all
    # keypoints that the image shows at its working size, see :class:`rdstitch.features.Features`
    detected_count: int = 0
    low_contrast: bool = False

    @classmethod
    def of(cls, features: Features) -> Self:
        """Features that stay in memory."""
        return cls.at(InMemory(PackedFeatures.pack(features)))

    @classmethod
    def at(cls, stored: Stored[PackedFeatures]) -> Self:
        """Features wherever they lie; they are read once."""
        features = stored.load().features
        detected_count = len(features) if features.detected_count is None else features.detected_count
        return cls(stored, len(features), detected_count=detected_count, low_contrast=features.low_contrast)

    def __len__(self) -> int:
        """Number of features."""
        return self.count if self.chosen is None else len(self.chosen)

    def load(self) -> Features:
        """Read the features; InputError when they have vanished."""
        packed = self.stored.load()
        features = (packed if self.chosen is None else packed.take(self.chosen)).unpack()
        before, size = features.image_size, self.image_size
        if before is None or size is None or before == size:
            return features
        points, scale = (
            _rescaled(features.points, before, size),
            features.scale * (Camera(size).scale / Camera(before).scale),
        )
        return replace(features, points=points, scale=scale, image_size=size)

    def take(self, index: NDArray[np.intp]) -> Self:
        """The features of the images of these indices."""
        return replace(self, chosen=index if self.chosen is None else self.chosen[index])

    def key(self, cache: Cache) -> str:
        """What stands for them in the inputs of later results; empty without a cache."""
        return cache.digest((self.stored.key, self.image_size, self.chosen))


@dataclass(frozen=True, eq=False)
class FeatureStore:
    """Features of the images of a set; an item is read when it is asked for."""

    items: tuple[StoredFeatures, ...]

    @classmethod
    def of(cls, features: Iterable[Features]) -> Self:
        """Features that stay in memory."""
        return cls(tuple(map(StoredFeatures.of, features)))

    def __len__(self) -> int:
        """Number of images."""
        return len(self.items)

    def __iter__(self) -> Iterator[Features]:
        """The features of all images, one after another."""
        return (item.load() for item in self.items)

    def __getitem__(self, index: int) -> Features:
        """The features of an image."""
        return self.items[index].load()

    @property
    def counts(self) -> NDArray[np.intp]:
        """Number of features of each image, (N,); nothing is read for it."""
        return np.array([len(item) for item in self.items], dtype=np.intp)

    def at_sizes(self, sizes: Sequence[Size]) -> Self:
        """The features in pixels of the images at other sizes, (width, height) of each."""
        resized = (replace(item, image_size=size) for item, size in zip(self.items, sizes, strict=True))
        return replace(self, items=tuple(resized))

    def strongest(self, most: int) -> Self:
        """At most so many features of each image, the strongest."""
        return replace(self, items=tuple(item.take(np.arange(min(most, len(item)))) for item in self.items))


@dataclass(frozen=True, eq=False)
class StoredMatches:
    """Putative matches of one pair, read when they are needed."""

    stored: Stored[Correspondences]
    count: int  # number of matches
    # width and height of the two images in whose pixels they are stored, and of those in whose they are wanted
    sizes: tuple[Size, Size, Size, Size] | None = None

    @classmethod
    def of(cls, matches: Correspondences) -> Self:
        """Matches that stay in memory."""
        return cls(InMemory(matches), len(matches))

    def __len__(self) -> int:
        """Number of matches."""
        return self.count

    def load(self) -> Correspondences:
        """Read the matches; InputError when they have vanished."""
        matches = self.stored.load()
        if self.sizes is None:
            return matches
        before1, before2, after1, after2 = self.sizes
        return replace(
            matches,
            points1=_rescaled(matches.points1, before1, after1),
            points2=_rescaled(matches.points2, before2, after2),
        )

    def resized(self, before: tuple[Size, Size], after: tuple[Size, Size]) -> Self:
        """The matches in pixels of images of another size."""
        return replace(self, sizes=(*before, *after))

    def key(self, cache: Cache) -> str:
        """What stands for them in the inputs of later results; empty without a cache."""
        return cache.digest((self.stored.key, self.sizes))


def _rescaled(points: FloatArray, before: Size, after: Size) -> FloatArray:
    """Points (N, 2) of one size in pixels of another: the same in half diagonals from the centre of the image."""
    return Camera(after).denormalize(Camera(before).normalize(points))
