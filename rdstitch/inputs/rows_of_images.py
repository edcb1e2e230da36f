"""Images by the names in rows of a table: the one whose path ends like the name, in any case.

Files in two folders may have one name, as of drones, whose numbers begin anew in each folder. A row is about the image
that has most of its name in common, from the file's name towards the first folder. Of images of one name, which are
called by their folders, the folders must agree too, as far as the row has any.
"""

from collections.abc import Iterable, Sequence
from itertools import takewhile
from pathlib import Path
from typing import Protocol

from rdstitch.errors import InputError
from rdstitch.inputs.image_folders import place_of
from rdstitch.inputs.tables import Row, name_parts
from rdstitch.results.messages import shortened
from rdstitch.system.file_access import canonical_name, without_query


class NamedFile(Protocol):
    """An image: what it is called, and its file."""

    @property
    def name(self) -> str: ...
    @property
    def path(self) -> Path: ...


def _in_common(place: Sequence[str], written: Sequence[str]) -> tuple[int, int]:
    """Parts that two names have in common, from the end: in any case, and exactly."""
    pairs = list(zip(reversed(place), reversed(written), strict=False))
    alike = takewhile(lambda pair: pair[0].casefold() == pair[1].casefold(), pairs)
    return len(list(alike)), len(list(takewhile(lambda pair: pair[0] == pair[1], pairs)))


class ImagesByName:
    """Images, to be found by names in tables."""

    def __init__(self, images: Sequence[NamedFile]) -> None:
        self._images = images
        # By the file's name in small letters, then by place, at which one file may be several times.
        self.by_file_name: dict[str, dict[tuple[str, ...], list[int]]] = {}
        for index, image in enumerate(images):
            *folders, _ = map(canonical_name, place_of(without_query(image.path)).parts)
            place = (*folders, image.name.rpartition("/")[2])
            self.by_file_name.setdefault(place[-1].casefold(), {}).setdefault(place, []).append(index)

    def find(self, name: str, where: str) -> tuple[list[int], tuple[int, int]]:
        """Indices of the image of this name, none where there is none, and how much they have in common."""
        written, best, same_names = name_parts(name), (1, 0), list[list[int]]()
        for place, indices in self.by_file_name.get(written[-1].casefold(), {}).items() if written else ():
            same, called = _in_common(place, written), self._images[indices[0]].name.split("/")
            if same >= best and same[0] >= min(len(called), len(written)):
                same_names = [*same_names, indices] if same == best else [indices]
                best = same
        if len(same_names) > 1:
            names = shortened([self._images[indices[0]].name for indices in same_names])
            raise InputError(f"{where}: {written[-1]} could be any of {names}; write it with its folder")
        return (same_names[0] if same_names else []), best


class RowsByImage:
    """Rows of which each is about one image."""

    def __init__(self, rows: Iterable[Row]) -> None:
        self._alike: dict[str, list[Row]] = {}
        for row in rows:
            self._alike.setdefault(row.image.casefold(), []).append(row)

    def of(self, images: Sequence[NamedFile]) -> list[Row | None]:
        """The row of each image, None where it has none."""
        names, best = ImagesByName(images), dict[int, tuple[tuple[int, int], list[Row]]]()
        for row in (row for name in names.by_file_name for row in self._alike.get(name, ())):
            indices, same = names.find(row.values["name"], row.where)
            for index in indices:
                before, rows = best.get(index, (same, []))
                if same >= before:
                    best[index] = same, [*rows, row] if same == before else [row]
        for _, rows in best.values():
            if len(rows) > 1:
                raise InputError(f"{rows[1].where}: {rows[1].image} is here twice; remove one, or write their folders")
        return [best[index][1][0] if index in best else None for index in range(len(images))]

    def needed(self, images: Sequence[NamedFile], file: str | Path, wanted: str) -> list[Row]:
        """The row of each image; an error asks for what is ``wanted`` of one that has none in the file."""
        rows = []
        for image, row in zip(images, self.of(images), strict=True):
            if row is None:
                raise InputError(f"{file}: has no line for {image.name}; add one with its {wanted}")
            rows.append(row)
        return rows
