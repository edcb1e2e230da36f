"""What other programs read: georeferences and drawings."""
