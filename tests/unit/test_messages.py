"""Messages as the user reads them."""

from rdstitch.messages import Message, left_out, told_once


def test_images_left_out_for_one_reason_are_named_together() -> None:
    blurred, alone = Message("is blurred", ("b/1.jpg",)), "no overlap"
    first, last = left_out("a/1.jpg", alone), left_out("a/3.jpg", alone)
    told = told_once([blurred, first, left_out("a/2.jpg", "in block 2"), last, blurred, first])
    assert list(map(str, told)) == [
        "1.jpg: is blurred",
        "left out a/1.jpg, 3.jpg: no overlap [left-out]",
        "left out a/2.jpg: in block 2 [left-out]",
        "1.jpg: is blurred",
    ]


def test_the_folder_is_named_where_it_changes() -> None:
    (message,) = told_once([left_out(path, "no overlap") for path in ("a/1.jpg", "a/2.jpg", "b/1.jpg")])
    assert str(message) == "left out a/1.jpg, 2.jpg, b/1.jpg: no overlap [left-out]"


def test_the_temporary_folder_of_a_video_is_not_named() -> None:
    assert str(left_out("/tmp/rdstitch-x1.part/drive_0003.jpg", "is blurred")).startswith("left out drive_0003.jpg: ")
