"""The grid of a map that an output is made on: that of another file, or of an extent."""

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from rdstitch.errors import InputError
from rdstitch.geometry.crs import Crs, NotMetricError
from rdstitch.georeferencing.georeference import Georeference
from rdstitch.io.opening import check_readable, decoding
from rdstitch.system.file_access import open_regular
from rdstitch.system.late_imports import tifffile

_IS_POINT = 2  # GTRasterTypeGeoKey
_SIMILAR = 1e-6  # relative: rounding of numbers in files


@dataclass(frozen=True)
class MapGrid:
    """Pixels on a map."""

    size: tuple[int, int]  # width and height
    place: Georeference

    def within(self, extent: tuple[float, float, float, float]) -> "MapGrid":
        """The pixels of the same grid that hold an extent: west, south, east and north, m on the map."""
        west, south, east, north = extent
        corners = np.array([west + 1j * north, east + 1j * north, east + 1j * south, west + 1j * south])
        pixels = (corners - self.place.origin) / self.place.scale  # x - i y of centres
        # Edges of pixels lie half a pixel off; what lies on one but for rounding is on it.
        low = np.floor(np.array([pixels.real.min(), -pixels.imag.max()]) + 0.5 + _SIMILAR)
        high = np.ceil(np.array([pixels.real.max(), -pixels.imag.min()]) + 0.5 - _SIMILAR)
        width, height = np.maximum(high - low, 1).astype(int).tolist()
        change = np.eye(3)
        change[:2, 2] = -low
        return MapGrid((width, height), self.place.after(change))


def grid_of_extent(crs: Crs, extent: tuple[float, float, float, float], pixel: float) -> MapGrid:
    """North-up pixels of a size, m on the map, from the north-west corner of an extent."""
    west, south, east, north = extent
    size = (math.ceil((east - west) / pixel - _SIMILAR), math.ceil((north - south) / pixel - _SIMILAR))
    return MapGrid(size, Georeference(crs, complex(pixel), complex(west + pixel / 2, north - pixel / 2)))


def read_grid(file: str | Path) -> MapGrid:
    """The grid of a GeoTIFF file whose coordinate system has a code."""
    path = Path(file)
    check_readable(path)
    with decoding(path), open_regular(path) as stream, tifffile.TiffFile(stream, name=str(path)) as tiff:
        page = tiff.pages.first
        size, tags = (int(page.imagewidth), int(page.imagelength)), page.geotiff_tags or {}
        epsg = int(tags.get("ProjectedCSTypeGeoKey", 0))
        matrix = np.zeros((2, 3))
        if "ModelTransformation" in tags:
            matrix = np.array(tags["ModelTransformation"], dtype=np.float64).reshape(4, 4)[:2, [0, 1, 3]]
        elif "ModelPixelScale" in tags and "ModelTiepoint" in tags:
            (sx, sy), (i, j, _, x, y) = tags["ModelPixelScale"][:2], np.ravel(tags["ModelTiepoint"])[:5]
            matrix = np.array([[sx, 0.0, x - i * sx], [0.0, -sy, y + j * sy]])
    scale = complex(matrix[0, 0], matrix[0, 1])
    square = abs(scale) > 0.0 and abs(matrix[1, 0] - scale.imag) + abs(matrix[1, 1] + scale.real) < _SIMILAR * abs(
        scale
    )
    if not (0 < epsg < 32767 and square):
        raise InputError(f"{file}: is not a GeoTIFF with square pixels in a coordinate system that has an EPSG code")
    try:
        crs = Crs(epsg)
    except NotMetricError as error:
        raise InputError(f"{file}: {error}") from error
    origin = complex(matrix[0, 2], matrix[1, 2])
    if tags.get("GTRasterTypeGeoKey") != _IS_POINT:  # counted from the corner of the first pixel
        origin += scale * (0.5 - 0.5j)
    return MapGrid(size, Georeference(crs, scale, origin))
