"""Tiles taken on a stage whose places are roughly known: read positions, correlate overlaps, adjust all places."""

from rdstitch.stage.grid import TileGrid
from rdstitch.stage.pair_candidates import SearchPlan
from rdstitch.stage.register_tiles import TileRegistration, register_tiles

__all__ = ["SearchPlan", "TileGrid", "TileRegistration", "register_tiles"]
