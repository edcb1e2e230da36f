"""Tables as users have them: every notation of numbers, names of every kind, and what is refused."""

import re
from pathlib import Path

import pytest

from rdstitch.errors import InputError
from rdstitch.inputs.find import find_images
from rdstitch.inputs.frame import Frame
from rdstitch.inputs.rows_of_images import RowsByImage
from rdstitch.inputs.tables import Row, csv_rows, json_rows

COLUMNS = {"name": "name file image", "x": "x easting", "y": "y northing", "um": "xum"}


def _rows(text: str) -> list[Row]:
    return csv_rows(text, "t.csv", COLUMNS, ("name,x,y", "name,um"), {"x": "m", "y": "mm"})


@pytest.mark.parametrize(
    ("cells", "x"),
    [
        (("580,015.975", "1.5"), 580015.975),
        (("580.015,975", "1,5"), 580015.975),
        (("580'015.975", "1"), 580015.975),
        (("580 015,975", "1"), 580015.975),
        # Shown by the other number.
        (("580,015", "6,246,117"), 580015.0),
        (("580,015", "12,25"), 580.015),
        (("580.015", "12,25"), 580015.0),
        (("580.015", "12.25"), 580.015),
        (("0,123", "1"), 0.123),
        (("-1.5e3", "1"), -1500.0),
        (("+.5", "1"), 0.5),
    ],
)
def test_notations_of_numbers(cells: tuple[str, str], x: float) -> None:
    for delimiter in ",;\t":
        (row,) = _rows(delimiter.join(("name", "x", "y")) + "\n" + delimiter.join(("a", *(f'"{c}"' for c in cells))))
        assert row.number("x") == pytest.approx(x, rel=1e-15)


def test_headings_quotes_comments_and_paths() -> None:
    """A comment may hold the heading, a name any character, and the number of a line is that in the file."""
    first, second, third = _rows(
        '# Made by hand\r\n#  File name ; Image; EXIF:Easting [m];y\r\n\r\n;C:\\two words\\a;"b".jpg;1;2\r\n'.replace(
            'a;"b".jpg', "a b.jpg"
        )
        + ';"folder/c;""d"".jpg";3;\r\n# no row\r\n;./e.jpg;nan;4;\r\n'
    )
    assert [row.image for row in (first, second, third)] == ["a b.jpg", 'c;"d".jpg', "e.jpg"]
    assert (first.number("x"), first.number("y"), second.number("y"), third.number("x")) == (1.0, 2.0, None, None)
    assert [row.where for row in (first, second, third)] == ["t.csv: line 4", "t.csv: line 5", "t.csv: line 7"]
    assert _rows("name,x [µm]\na,5\n")[0].number("um") == 5.0


@pytest.mark.parametrize("first", ["sep=;", "SEP=;\r"])
def test_the_line_by_which_excel_tells_the_delimiter_is_no_heading(first: str) -> None:
    (row,) = _rows(f"{first}\nname;x;y\na.jpg;48,5;11,25\n")
    assert (row.image, row.number("x"), row.where) == ("a.jpg", 48.5, "t.csv: line 3")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "t.csv: its first line names no columns like name,x,y or name,um"),
        ("name,x\na,1\n", "names no columns like"),
        ("name,x (ft),y\na,1,2\n", "t.csv: the column 'x (ft)' has a unit that is not known here; give it in m"),
        ("name,x (mm),y\na,1,2\n", "t.csv: the column 'x (mm)' has a unit that is not known here; give it in m"),
        ("name,x1,y1,x2,y2\na,1,2,3,4\n", "names no columns like"),
        ("name,x,easting,y\na,1,1.0,2\na,1,3,2\n", "line 3: has two numbers for x, 1 and 3; remove one of the columns"),
        ("name,x,y\n\n", "t.csv: has no rows below its heading"),
        ("name,x,y\n\na,48,8582,2,2945\n", "t.csv: line 3: has 5 fields, but there are 3 columns"),
        ('name,x,y\na,"1,2\n', "t.csv: line 2: is not CSV"),
        ("n\0a\0m\0e\0", "t.csv: is not UTF-8 text"),
        ("name,x,y\n,1,2\n", "t.csv: line 2: has no name"),
        ("name,x,y\nb/a,1,2\nc/a,1,2\n", "t.csv: line 3: a is here twice; remove one"),
        ("name,x,y\na,1e999,2\n", "t.csv: line 2: expected a number for x, not '1e999'"),
        ("name,x,y\na,1 m,2\n", "t.csv: line 2: expected a number for x, not '1 m'"),
        ("name,x,y\na,,2\n", "t.csv: line 2: has no number for x"),
        ('name,x,y\na,"580,015",2\n', "t.csv: line 2: '580,015' could be two numbers; write it without a comma"),
    ],
)
def test_what_is_wrong_is_named(text: str, message: str) -> None:
    with pytest.raises(InputError, match=re.escape(message)):
        [row.needed("x") for row in RowsByImage(_rows(text)).of([Frame(Path("a"))]) if row is not None]


TWO = ["100/x.png", "101/x.png"]  # every drone begins its numbers anew in a new folder


@pytest.mark.parametrize(
    ("images", "rows", "found"),
    [
        (TWO, ["/data/100/x.png", "./101/x.png"], [0, 1]),
        (TWO, ["F:\\DCIM\\101\\X.PNG", "100/x.png"], [1, 0]),
        (TWO, ["101/x.png"], [None, 0]),
        (TWO, ["102/x.png", "100/x.png"], [1, None]),
        (TWO, ["x.png"], "x.png could be any of 100/x.png, 101/x.png; write it with its folder"),
        (["1/left/x.png", "2/left/x.png"], ["left/x.png"], "could be any of"),
        (["1/left/x.png", "2/left/x.png"], ["2/left/x.png", "left/y.png"], [None, 0]),
        # One image, and a table of more, or of a folder that was moved.
        (["101/x.png"], ["100/x.png", "101/x.png"], [1]),
        (["101/x.png"], ["100/x.png"], [0]),
        (["101/x.png"], ["100/x.png", "102/x.png"], "line 3: x.png is here twice; remove one"),
        (["a/x.png", "a/X.png"], ["X.png", "x.png"], [1, 0]),
        (["a/x.png", "a/../a/x.png"], ["x.png"], [0, 0]),
    ],
)
def test_a_row_is_about_the_image_whose_path_ends_like_its_name(
    tmp_path: Path, images: list[str], rows: list[str], found: list[int | None] | str
) -> None:
    for image in images:
        (tmp_path / image).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / image).touch()
    frames = find_images([tmp_path / image for image in images]).frames
    table = RowsByImage(_rows("name,x,y\n" + "".join(f"{name},{k},0\n" for k, name in enumerate(rows))))
    if isinstance(found, str):
        with pytest.raises(InputError, match=re.escape(found)):
            table.of(frames)
    else:
        assert [row and row.number("x") for row in table.of(frames)] == found


def test_zero_in_json_is_a_number() -> None:
    (row,) = json_rows('[{"name": "a", "x": 0, "y": null}]', "p.json", COLUMNS, "a list")
    assert (row.number("x"), row.number("y")) == (0.0, None)
    with pytest.raises(InputError, match=r"p\.json: expected a list of objects"):
        json_rows('{"a": 1}', "p.json", COLUMNS, "a list of objects")


def test_numbers_within_a_text() -> None:
    (row,) = _rows('name,x,y\na,"48 deg 51\' 29.60"" N",1\n')
    assert row.numbers_within("x") == [48.0, 51.0, 29.6]
