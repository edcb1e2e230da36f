"""How images are put together."""

from dataclasses import dataclass
from typing import Literal

from rdstitch.errors import ArgumentError
from rdstitch.options.canvas_options import CanvasOptions
from rdstitch.options.option import Range, Unit, documented, option

ExposureMethod = Literal["auto", "none", "exif", "gain", "blocks", "balanced"]
Interpolation = Literal["linear", "cubic", "lanczos"]


@documented
@dataclass(frozen=True)
class CompositeOptions(CanvasOptions):
    """Options of the compositor and its canvas; the command line has the same names and defaults."""

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
    quality: int = option(95, "Quality of JPEG and WebP, 1 to 100.", "Q", within=Range(least=1, most=100))
    max_memory: int | None = option(
        None,
        "Memory for compositing, as 800M; otherwise a quarter of what is available, at least 400M.",
        "SIZE",
        within=Range(least=2**20),
        unit=Unit.BYTES,
    )
    interpolation: Interpolation = option("cubic", "Interpolation kernel.")
    background: int = option(
        0, "Grey level of uncovered pixels in JPEG and .dzi.", "GREY", within=Range(least=0, most=255)
    )
    bands: int | None = option(
        None,
        "Bands of multiband; the widest transition is about 2**bands pixels. None: by the size of the images.",
        within=Range(least=1, most=8),
        flag=None,
    )
    tile_size: int | None = option(
        None,
        "Side of the square tiles that the canvas is worked on in, pixels, a multiple of 256; None: 512 where "
        "memory allows. It does not change the result.",
        within=Range(least=256),
        flag=None,
    )
    workers: int | None = option(
        None,
        "Tiles that are worked on at one time; None: one per processor, up to 4. It does not change the result.",
        within=Range(least=1),
        flag=None,
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.tile_size is not None and self.tile_size % 256:
            raise ArgumentError(f"tile_size must be a multiple of 256, not {self.tile_size}")
