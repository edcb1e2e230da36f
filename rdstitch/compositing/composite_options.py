"""How images are put together."""

import math
from dataclasses import dataclass, fields
from typing import Literal, get_args, get_origin, get_type_hints

from rdstitch.choices import ProjectionName
from rdstitch.compositing.upright_options import UprightOptions
from rdstitch.errors import ArgumentError

ExposureMethod = Literal["auto", "none", "exif", "gain", "blocks", "balanced"]
Seam = Literal["none", "voronoi", "graphcut"]
Blend = Literal["none", "feather", "multiband"]
Crop = Literal["none", "auto"]
Interpolation = Literal["linear", "cubic", "lanczos"]


@dataclass(frozen=True)
class CompositeOptions(UprightOptions):
    """Options of the compositor, and of how the output is turned; the command line has the same names and defaults.

    Attributes
    ----------
    exposure : str
        "auto": "exif" for one band of 16 bits, which multispectral cameras write, else "balanced". "exif" makes samples
        those of one exposure by what the camera wrote down, and looks at no overlap.
        Gain compensation. "gain" makes the whole comparable, with one factor per image and channel and one vignetting
        for all; "blocks" adds a smooth field per image where one is asked for; "balanced" does the same, but keeps
        regions near the brightness of their own images where they would be burnt out; "none" is for people who measure.
    seam : str
        Where one image ends and the next begins: "graphcut" goes round what differs between them (parallax,
        people), "voronoi" where their borders are equally far, "none" leaves it to the blending.
    blend : str
        "multiband" hides the seam over a width that suits each size of detail, "feather" averages over a
        strip along the seam (without seams: over the whole overlap), "none" cuts.
    crop : str
        "none"; "auto" cuts to ``rectangle``, or without one to the largest upright rectangle without holes, where that
        keeps a fair part of the output.
    projection : str
        How images taken by turning on the spot are laid out: "plane", "cylinder", "sphere" (equirectangular),
        "mercator", "panini", "stereographic", or "auto": the plane up to a view of 90 degrees, the cylinder for what
        is wide and low, the sphere for the rest. Images of a plane stay on it.
    scale : float
        Factor to the size of the output; 1 keeps the resolution of the reference image, or the median one, at its
        centre.
    max_size : int, optional
        Longest side of the output, pixels; None: as ``scale`` makes it.
    quality : int
        Quality of JPEG and WebP, 1 to 100.
    max_stretch : float
        What an image shows so many times coarser than the reference image is not drawn.
    rotate : float
        Degrees that the output is turned clockwise; other than 0, north is not turned up.
    north_up : bool
        Turn north up where the output is georeferenced.
    gsd : float, optional
        Metres on the map that a pixel takes, instead of ``scale``; the output must be georeferenced.
    epsg : int, optional
        Code of the map's coordinate system; None: UTM (UPS near the poles) on WGS 84. Others need the extra ``crs``.
    like : path, optional
        GeoTIFF file whose grid the output has: coordinate system, pixels and extent.
    extent : tuple of 4 floats, optional
        West, south, east and north of the output, metres on the map; on the pixels of ``like``, else from the
        north-west corner on.
    georeference : str
        "auto" places the output where positions or control points agree with the images, "force" also where these
        contradict them, "off" never.
    max_memory : int, optional
        Bytes that the compositor may hold in images and tiles; None: a quarter of the memory that is
        available, at least 400 MB, or more where the canvas needs it.
    interpolation : str
        Kernel of the one resampling: "linear", "cubic" or "lanczos".
    background : int
        Grey of what no image covers, in formats without transparency: 0 black, 255 white.
    bands : int, optional
        Bands of "multiband"; the widest transition is about 2**bands pixels. None: by the size of the images.
    tile_size : int, optional
        Side of the square tiles that the canvas is worked on in, pixels, a multiple of 256; None: 512 where
        memory allows. It does not change the result.
    workers : int, optional
        Tiles that are worked on at one time; None: one per processor, up to 4. It does not change the result.

    Raises
    ------
    ArgumentError
        When a value is not one of those listed.
    """

    exposure: ExposureMethod = "auto"
    seam: Seam = "graphcut"
    blend: Blend = "multiband"
    crop: Crop = "none"
    projection: ProjectionName = "auto"
    scale: float = 1.0
    max_size: int | None = None
    quality: int = 95
    max_stretch: float = 3.0
    rotate: float = 0.0
    north_up: bool = True
    gsd: float | None = None
    epsg: int | None = None
    like: str | None = None
    extent: tuple[float, float, float, float] | None = None
    georeference: Literal["auto", "force", "off"] = "auto"
    max_memory: int | None = None
    interpolation: Interpolation = "cubic"
    background: int = 0
    bands: int | None = None
    tile_size: int | None = None
    workers: int | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        hints = get_type_hints(type(self))
        for option in fields(self):
            allowed = get_args(hints[option.name])
            value = getattr(self, option.name)
            if get_origin(hints[option.name]) is Literal and value not in allowed:
                raise ArgumentError(f"{option.name} must be one of {', '.join(allowed)}, not '{value}'")
        if not 1e-6 <= self.scale <= 1e6:
            raise ArgumentError(f"scale must lie between 1e-6 and 1e6, not {self.scale}")
        if self.max_size is not None and self.max_size < 1:
            raise ArgumentError(f"max_size must be at least 1, not {self.max_size}")
        if not 1 <= self.quality <= 100:
            raise ArgumentError(f"quality must be from 1 to 100, not {self.quality}")
        if not self.max_stretch > 1:
            raise ArgumentError(f"max_stretch must be greater than 1, not {self.max_stretch}")
        if not math.isfinite(self.rotate):
            raise ArgumentError(f"rotate must be an angle in degrees, not {self.rotate}")
        if self.gsd is not None and not 0.0 < self.gsd < math.inf:
            raise ArgumentError(f"gsd must be metres, more than 0, not {self.gsd}")
        if self.gsd is not None and self.scale != 1.0:
            raise ArgumentError("scale and gsd both say how large the output is; leave one of them out")
        if self.like is not None and (self.gsd, self.epsg, self.scale, self.rotate) != (None, None, 1.0, 0.0):
            raise ArgumentError("like says the size of pixels and the map; leave out gsd, crs, scale and rotate")
        if (self.like or self.extent) and (self.crop != "none" or self.max_size is not None):
            raise ArgumentError("like and extent say how large the output is; leave out crop and max_size")
        if self.extent is not None and not (
            len(self.extent) == 4 and self.extent[0] < self.extent[2] and self.extent[1] < self.extent[3]
        ):
            raise ArgumentError(f"extent must be west, south, east and north, not {self.extent}")
        if self.max_memory is not None and self.max_memory <= 0:
            raise ArgumentError(f"max_memory must be positive, not {self.max_memory}")
        if not 0 <= self.background <= 255:
            raise ArgumentError(f"background must be a grey from 0 to 255, not {self.background}")
        if self.bands is not None and not 1 <= self.bands <= 8:
            raise ArgumentError(f"bands must be from 1 to 8, not {self.bands}")
        if self.workers is not None and self.workers < 1:
            raise ArgumentError(f"workers must be at least 1, not {self.workers}")
        if self.tile_size is not None and (self.tile_size < 256 or self.tile_size % 256):
            raise ArgumentError(f"tile_size must be a multiple of 256, not {self.tile_size}")
