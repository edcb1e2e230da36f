"""Which pixels the output has: its projection, size, extent and place on the Earth."""

from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any, ClassVar, Literal, Self

from rdstitch.choices import ProjectionName
from rdstitch.errors import ArgumentError
from rdstitch.options.option import Contradiction, Range, option, reads
from rdstitch.options.upright_options import UprightOptions


@dataclass(frozen=True)
class CanvasOptions(UprightOptions):
    """Which pixels the output has: images of the same places, composed with the same of these, lie on each other."""

    contradictions: ClassVar[tuple[Contradiction, ...]] = (
        *UprightOptions.contradictions,
        Contradiction(("gsd",), ("scale",), "scale and gsd both say how large the output is; leave one of them out"),
        Contradiction(
            ("like",),
            ("gsd", "epsg", "scale", "rotate"),
            "like says the size of pixels and the map; leave out gsd, crs, scale and rotate",
        ),
        Contradiction(
            ("like", "extent"),
            ("crop", "max_size"),
            "like and extent say how large the output is; leave out crop and max_size",
        ),
    )
    crop: Literal["none", "auto"] = option(
        "none",
        "Crop to --rectangle, otherwise to the largest rectangle without holes, where that keeps a fair part.",
        flag="--crop/--no-crop",
    )
    projection: ProjectionName = option("auto", "Projection of images taken by turning on the spot.")
    scale: float = option(
        1.0,
        "Scale of the output; 1 keeps the resolution of the reference image, one of the largest.",
        within=Range(least=1e-6, most=1e6),
    )
    max_size: int | None = option(
        None, "Longest side of the output, pixels; --scale is reduced to fit.", within=Range(least=1)
    )
    max_stretch: float = option(
        3.0, "Leave out what an oblique image shows N times coarser than the reference image.", within=Range(above=1.0)
    )
    rotate: float = option(0.0, "Turn the output clockwise, degrees; north is then not turned up.", "DEG")
    north_up: bool = option(
        True,
        "Turn north up where three images or more have a GPS position that fits (the default), or never.",
        flag="--north-up/--no-north-up",
    )
    gsd: float | None = option(
        None, "Ground sample distance, metres; instead of --scale.", "M", within=Range(above=0.0)
    )
    epsg: int | None = option(
        None,
        "Coordinate system of the map, and of x and y in --positions; otherwise UTM (UPS near the poles) on WGS "
        "84. All but these need pyproj.",
        "EPSG:N",
        "--crs",
        within=Range(above=0, below=2**16),
    )
    like: str | Path | None = reads("Grid of the output: coordinate system, pixels and extent of this GeoTIFF file.")
    extent: tuple[float, float, float, float] | None = option(
        None,
        "Extent of the output on the map, metres: on the pixels of --like, else from the north-west corner on.",
        "W,S,E,N",
    )
    georeference: Literal["auto", "force", "off"] = option(
        "auto",
        "Place the output where positions or control points agree with the images, also where these contradict "
        "them (force), or never.",
    )

    def overridden(self, **given: Any) -> Self:
        """The same with other options; what is given takes the place of all that says the same in another way."""
        defaults = {each.name: each.default for each in fields(self)}
        # What turns nothing, crops nothing, or is left open contradicts nothing; scale=1 and straighten="off" do.
        scalars = {name: value for name, value in given.items() if isinstance(value, str | int | float | None)}
        stated = given.keys() - {name for name, value in scalars.items() if value in (None, "none", 0.0)}
        replaced = {other for name in stated for each in self.contradictions for other in each.against(name)}
        if {"scale", "gsd"} & stated:
            replaced.add("max_size")  # it would reduce them
        if given.get("georeference") == "off":
            replaced |= {"gsd", "like", "extent"}
        elif self.georeference == "off" and {"gsd", "like", "extent"} & stated:
            replaced.add("georeference")
        changed: dict[str, Any] = {name: defaults[name] for name in replaced} | given
        new = replace(self, **changed)
        is_of_other_map = (new.like, new.epsg) != (self.like, self.epsg)
        return replace(new, extent=None) if is_of_other_map and "extent" not in given else new

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.like is not None:
            object.__setattr__(self, "like", str(self.like))  # as the sidecar has it
        if self.extent is not None and not (self.extent[0] < self.extent[2] and self.extent[1] < self.extent[3]):
            raise ArgumentError(f"extent must be west, south, east and north, not {self.extent}")
