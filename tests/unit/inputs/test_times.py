"""Times belong to what was named, whatever of it is left out."""

from collections.abc import Callable
from pathlib import Path

import pytest

from rdstitch.errors import InputError
from rdstitch.inputs.attitudes import with_attitudes
from rdstitch.inputs.frame import Frame
from rdstitch.inputs.odometry import read_odometry
from rdstitch.inputs.times import with_times


def times(folder: Path, count: int) -> Path:
    file = folder / "times.txt"
    file.write_text("".join(f"{100 + k}\n" for k in range(count)), encoding="utf-8")
    return file


def test_one_time_a_line_is_for_each_file_in_order(tmp_path: Path) -> None:
    frames = [Frame(Path(f"f{k}.png")) for k in range(5)]
    assert [frame.timestamp for frame in with_times(frames, times(tmp_path, 5))] == [100, 101, 102, 103, 104]
    for count in (4, 6, 80):
        with pytest.raises(InputError, match=f"has {count} times for 5 images"):
            with_times(frames, times(tmp_path, count))
    assert with_times([], times(tmp_path, 5)) == []


@pytest.mark.parametrize(
    ("numbers", "counts"), [((0, 2, 4), (5, 6)), ((0, 1, 2), (3,)), ((0, 3, 4), (5, 9)), ((5,), (6, 9)), ((0,), (1, 9))]
)
def test_of_a_video_they_are_for_all_frames(tmp_path: Path, numbers: tuple[int, ...], counts: tuple[int, ...]) -> None:
    frames = [Frame(Path(f"v_{k}.png"), k) for k in numbers]
    for count in counts:
        timed = with_times(frames, times(tmp_path, count))
        assert [frame.timestamp for frame in timed] == [100 + k for k in numbers]
    for count in (numbers[-1], *([counts[-1] + 1] if numbers[1:2] in ((1,), (2,)) else [])):
        with pytest.raises(InputError, match="times"):
            with_times(frames, times(tmp_path, count))


def test_two_videos_have_one_time_after_the_other(tmp_path: Path) -> None:
    frames = [Frame(Path(f"{name}/v_{k}.png"), k) for name in "ab" for k in range(2)]
    assert [frame.timestamp for frame in with_times(frames, times(tmp_path, 4))] == [100, 101, 102, 103]


def test_a_list_has_one_time_of_each_name(tmp_path: Path) -> None:
    file = tmp_path / "list.txt"
    file.write_text("# time name\n1.5 rgb/a b.png\n2.5\trgb/c.png\n", encoding="utf-8")
    assert [frame.timestamp for frame in with_times([Frame(Path("c.png")), Frame(Path("a b.png"))], file)] == [2.5, 1.5]
    with pytest.raises(InputError, match=r"d\.png"):
        with_times([Frame(Path("d.png"))], file)
    file.write_text("1.5 a.png\n2.5 a.png\n", encoding="utf-8")
    with pytest.raises(InputError, match=r"line 2: a\.png is here twice"):
        with_times([Frame(Path("a.png"))], file)


@pytest.mark.parametrize("unit", [1e3, 1e9])
def test_times_in_smaller_units_are_not_taken_for_seconds(tmp_path: Path, unit: float) -> None:
    file, moments = tmp_path / "times.txt", [f"{(1.7e9 + k) * unit:.0f}" for k in range(2)]

    def refused(read: Callable[[], object], text: str) -> None:
        file.write_text(text.format(*moments), encoding="utf-8")
        with pytest.raises(InputError, match=rf"{moments[0]}; is it in nanoseconds\?"):
            read()

    frames = [Frame(Path(f"{name}.png")) for name in "ab"]
    for text in ("{}\n{}\n", "{} a.png\n{} b.png\n", "timestamp,name\n{},a.png\n{},b.png\n"):
        refused(lambda: with_times(frames, file), text)
    for text in ("{} 0 0 0 0 0 0 1\n{} 1 0 0 0 0 0 1\n", "timestamp,x,y,yaw\n{},0,0,0\n{},1,0,0\n"):
        refused(lambda: read_odometry(file), text)
    refused(lambda: with_attitudes([], file), "timestamp,psi,theta\n{},0,0\n{},1,0\n")
