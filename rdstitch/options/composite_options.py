"""How images are put together."""

from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any, ClassVar, Literal, Self

from rdstitch.choices import ProjectionName
from rdstitch.errors import ArgumentError
from rdstitch.options.option import Contradiction, documented, option
from rdstitch.options.upright_options import UprightOptions

ExposureMethod = Literal["auto", "none", "exif", "gain", "blocks", "balanced"]
Interpolation = Literal["linear", "cubic", "lanczos"]


def _is_scalar(value: Any) -> bool:
    return value is None or isinstance(value, str | int | float)


@documented
@dataclass(frozen=True)
class CompositeOptions(UprightOptions):
    """Options of the compositor, and of how the output is turned; the command line has the same names and defaults."""

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
    exposure: ExposureMethod = option(
        "auto",
        "Brightness: exif normalises by time, ISO and aperture, for measurements; gain makes all images comparable "
        "(one factor per image, one vignetting); blocks adds a smooth field per image where needed; balanced also "
        "keeps what is bright near its own images' brightness; auto: exif for one band of 16 bits, else balanced.",
    )
    seam: Literal["none", "voronoi", "graphcut"] = option(
        "graphcut", "Seam finder: around differences, midway, or none."
    )
    blend: Literal["none", "feather", "multiband"] = option("multiband", "Blender; none: hard edges, for measurements.")
    crop: Literal["none", "auto"] = option(
        "none",
        "Crop to --rectangle, otherwise to the largest rectangle without holes, where that keeps a fair part.",
        flag="--crop/--no-crop",
        pixels=True,
    )
    projection: ProjectionName = option("auto", "Projection of images taken by turning on the spot.", pixels=True)
    scale: float = option(
        1.0,
        "Scale of the output; 1 keeps the resolution of the reference image, one of the largest.",
        least=1e-6,
        most=1e6,
        pixels=True,
    )
    max_size: int | None = option(
        None, "Longest side of the output, pixels; --scale is reduced to fit.", least=1, pixels=True
    )
    quality: int = option(95, "Quality of JPEG and WebP, 1 to 100.", "Q", least=1, most=100)
    max_stretch: float = option(
        3.0, "Leave out what an oblique image shows N times coarser than the reference image.", above=1.0, pixels=True
    )
    rotate: float = option(0.0, "Turn the output clockwise, degrees; north is then not turned up.", "DEG", pixels=True)
    north_up: bool = option(
        True,
        "Turn north up where three images or more have a GPS position that fits.",
        flag="--north-up/--no-north-up",
        default="north up",
        pixels=True,
    )
    gsd: float | None = option(None, "Ground sample distance, metres; instead of --scale.", "M", above=0.0, pixels=True)
    epsg: int | None = option(
        None,
        "Coordinate system of the map, and of x and y in --positions; otherwise UTM (UPS near the poles) on WGS "
        "84. All but these need pyproj.",
        "EPSG:N",
        "--crs",
        above=0,
        below=2**16,
        pixels=True,
    )
    like: str | Path | None = option(
        None,
        "Grid of the output: coordinate system, pixels and extent of this GeoTIFF file.",
        "FILE",
        reads=True,
        pixels=True,
    )
    extent: tuple[float, float, float, float] | None = option(
        None,
        "Extent of the output on the map, metres: on the pixels of --like, else from the north-west corner on.",
        "W,S,E,N",
        pixels=True,
    )
    georeference: Literal["auto", "force", "off"] = option(
        "auto",
        "Place the output where positions or control points agree with the images, also where these contradict "
        "them (force), or never.",
        pixels=True,
    )
    max_memory: int | None = option(
        None,
        "Memory for compositing, as 800M; otherwise a quarter of what is available, at least 400M.",
        "SIZE",
        least=2**20,
        unit="bytes",
    )
    interpolation: Interpolation = option("cubic", "Interpolation kernel.")
    background: int = option(0, "Grey level of uncovered pixels in JPEG and .dzi.", "GREY", least=0, most=255)
    bands: int | None = option(
        None,
        "Bands of multiband; the widest transition is about 2**bands pixels. None: by the size of the images.",
        least=1,
        most=8,
        command_line=False,
    )
    tile_size: int | None = option(
        None,
        "Side of the square tiles that the canvas is worked on in, pixels, a multiple of 256; None: 512 where "
        "memory allows. It does not change the result.",
        least=256,
        command_line=False,
    )
    workers: int | None = option(
        None,
        "Tiles that are worked on at one time; None: one per processor, up to 4. It does not change the result.",
        least=1,
        command_line=False,
    )

    def overridden(self, **given: Any) -> Self:
        """The same with other options; what is given takes the place of all that says the same in another way."""
        defaults = {each.name: each.default for each in fields(self)}
        # What turns nothing, crops nothing, or is left open contradicts nothing; scale=1 and straighten="off" do.
        stated = [name for name, value in given.items() if not (_is_scalar(value) and value in (None, "none", 0.0))]
        replaced = {other for name in stated for each in self.contradictions for other in each.against(name)}
        if {"scale", "gsd"} & given.keys():
            replaced.add("max_size")  # it would reduce them
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
        if self.tile_size is not None and self.tile_size % 256:
            raise ArgumentError(f"tile_size must be a multiple of 256, not {self.tile_size}")
