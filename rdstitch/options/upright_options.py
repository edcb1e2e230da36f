"""How the output is turned between registration and canvas."""

from dataclasses import dataclass
from typing import ClassVar, Literal

from rdstitch.errors import ArgumentError
from rdstitch.options.option import Contradiction, Options, option

Segment = tuple[float, float, float, float]
Corners = tuple[float, float, float, float, float, float, float, float]

_TURN = "rectangle, straighten and level each turn the output; give one of them"


@dataclass(frozen=True)
class UprightOptions(Options):
    """How the output is turned."""

    contradictions: ClassVar[tuple[Contradiction, ...]] = (
        Contradiction(("rectangle",), ("straighten", "level"), _TURN),
        Contradiction(("straighten",), ("level",), _TURN),
    )
    yaw: float = option(0.0, "Turn the view of a panorama to the right, degrees, before it is projected.", "DEG")
    pitch: float = option(0.0, "Turn the view of a panorama up, degrees, before it is projected.", "DEG")
    roll: float = option(0.0, "Turn the view of a panorama clockwise, degrees, before it is projected.", "DEG")
    rectangle: Corners | None = option(
        None,
        "Four corners, pixels of the reference image as it is read, clockwise: they become an upright rectangle "
        "of its true aspect ratio, the first one its top left corner.",
        "X1,Y1,…,X4,Y4",
    )
    straighten: Literal["off", "auto"] | tuple[Segment, ...] = option(
        "off",
        "Make horizontal and vertical edges of the scene so in the output. auto: edges detected in the images; "
        "LINES: 'x1,y1,x2,y2;…', ends in pixels of the reference image as it is read.",
        "off|auto|LINES",
    )
    level: bool = option(False, "Level the output by gravity (XMP, --attitude), otherwise by most images.")

    def __post_init__(self) -> None:
        super().__post_init__()
        if not isinstance(self.straighten, str) and any(line[:2] == line[2:] for line in self.straighten):
            raise ArgumentError("straighten: a line needs two different ends")

    @property
    def measured(self) -> bool:
        """Whether places in the reference image are given."""
        return self.rectangle is not None or not isinstance(self.straighten, str)

    @property
    def upright(self) -> bool:
        """Whether something in the scene shall be upright, whatever else the frame of the output would be."""
        return self.measured or self.straighten == "auto" or self.level
