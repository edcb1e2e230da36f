"""The picture that came out."""

from rdstitch.report.svg import element, section
from rdstitch.report.thumbnails import of_mosaic
from rdstitch.stitch_result import StitchResult

_SIDE = 1200


def mosaic(result: StitchResult) -> str:
    """A thumbnail of the output."""
    picture = of_mosaic(result, _SIDE)
    if picture is None:
        return section("Mosaic", "No picture was written.")
    name = "" if result.output is None else f"{result.output.name}, "
    return section(
        "Mosaic", "{}{} x {} px.".format(name, *result.canvas.size), element("img", src=picture, alt="the mosaic")
    )
