"""Tiles taken on a stage whose places are roughly known: read positions, correlate overlaps, adjust all places."""

from rdstitch.stage.grid import TileGrid
from rdstitch.stage.options import TileOptions
from rdstitch.stage.register import TileRegistration, register_tiles

__all__ = ["TileGrid", "TileOptions", "TileRegistration", "register_tiles"]
