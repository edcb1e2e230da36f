"""Tiles taken on a stage whose places are roughly known: read positions, correlate overlaps, adjust all places."""

from rdstitch.options.tile_options import TileOptions
from rdstitch.stage.grid import TileGrid
from rdstitch.stage.register_tiles import TileRegistration, register_tiles

__all__ = ["TileGrid", "TileOptions", "TileRegistration", "register_tiles"]
