"""``--exclude`` and ``--include-only`` choose images by name or pattern."""

from pathlib import Path

import pytest

from rdstitch.errors import ArgumentError
from rdstitch.inputs.frame import Frame
from rdstitch.inputs.selection import selected

FRAMES = [Frame(Path("flight") / name, index) for index, name in enumerate(("a1.jpg", "a2.jpg", "b1.jpg", "b[2].jpg"))]


def _names(exclude: tuple[str, ...] = (), include_only: tuple[str, ...] = ()) -> list[str]:
    return [frame.path.name for frame in selected(FRAMES, exclude, include_only)]


@pytest.mark.parametrize(
    ("exclude", "include_only", "left"),
    [
        ((), (), ["a1.jpg", "a2.jpg", "b1.jpg", "b[2].jpg"]),
        (("a1.jpg",), (), ["a2.jpg", "b1.jpg", "b[2].jpg"]),
        (("a*", "b1.jpg"), (), ["b[2].jpg"]),
        (("flight/a?.jpg",), (), ["b1.jpg", "b[2].jpg"]),
        ((), ("a*", "b1*"), ["a1.jpg", "a2.jpg", "b1.jpg"]),
        (("a1*",), ("a*",), ["a2.jpg"]),
        (("b[2].jpg",), (), ["a1.jpg", "a2.jpg", "b1.jpg"]),
    ],
)
def test_images_are_chosen_by_name(exclude: tuple[str, ...], include_only: tuple[str, ...], left: list[str]) -> None:
    assert _names(exclude, include_only) == left


@pytest.mark.parametrize("option", ["exclude", "include-only"])
def test_a_name_that_is_none_is_refused(option: str) -> None:
    wanted = (("c.jpg",), ()) if option == "exclude" else ((), ("c.jpg",))
    with pytest.raises(ArgumentError, match=f"--{option} c.jpg: none of the 4 images"):
        selected(FRAMES, *wanted)
